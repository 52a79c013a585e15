"""What a report says in tables, so that another person can repeat and check a reconstruction: photographs with hashes,
calibration, poses, settings, versions, accuracy, measures."""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from .. import __version__
from ..data.load import load_scene
from ..data.scene import Scene
from ..measure.wording import decimals, interval, significant
from ..project.runs import INFO, holdout_of, photos_of, run_folder
from ..project.schema import Poses, Project
from ..project.store import load_poses, load_project
from ..verdict import worst

LIBRARIES = ("torch", "numpy", "warp-lang", "pycolmap", "OpenImageIO", "scikit-image", "scipy", "trimesh", "xatlas")
POSES_REPORT = "poses/report.json"
JUDGEMENT = "Is the capture good?"


@dataclass(frozen=True)
class Section:
    """A titled table: text above it, names of its columns (none: the first column names the rows), rows of text."""

    title: str
    columns: list[str]
    rows: list[list[str]]
    text: str = ""


def results_of(project: Project, run: str) -> dict[str, Any]:
    """The last result of each verb, of the run where it has one, as `reconstruct` would give them."""
    found: dict[str, Any] = {}
    for step in project.provenance:
        if step.settings.get("run", run) == run:
            found[step.verb] = step.result
    return found


def sections(folder: Path, run: str, results: dict[str, Any], measures: dict[str, Any] | None = None) -> list[Section]:
    """All tables of a report, those with something in them.

    Args:
        results: of the verbs by name; that of `evaluate` names its tables. measures: of the mesh as `measure` left them, if there are any.
    Raises:
        ProjectError: the project has no poses, or a file of it is damaged.
    """
    project, poses, scene = load_project(folder), load_poses(folder), load_scene(folder, holdout_of(folder, run))
    scene = scene.unseen_by(photos_of(folder, run))
    details = _poses_details(folder)
    evaluation = results.get("evaluate") or {}
    measures = measures or {}
    made = [
        _judgement(results, evaluation),
        _summary(project, poses, results, evaluation),
        _measured([measures["whole"]] if "whole" in measures else [], measures, "Whole surface: area and volume"),
        _measured(measures.get("classes", []), measures, "Classes: areas and volumes"),
        _measured(measures.get("instances", []), measures, "Instances: areas and volumes"),
        _distances(measures),
        _accuracy(evaluation),
        _calibration(poses),
        _cameras(project, scene, details),
        _photographs(project, scene),
        _left_out(project),
        _settings(folder, run),
        _steps(project),
        _versions(),
    ]
    return [section for section in made if section.rows]


def _judgement(results: dict[str, Any], evaluation: dict[str, Any]) -> Section:
    """Whether the capture is good, why not, and what to photograph next."""
    stages = {
        "poses": results.get("poses"),
        "train": results.get("train"),
        "evaluate": evaluation,
        "mesh": results.get("mesh"),
    }
    judged = {verb: (result or {}).get("verdict") for verb, result in stages.items()}
    if not any(judged.values()):
        return Section(JUDGEMENT, [], [])
    whole = worst(judged)
    level = {"good": "Yes.", "weak": "In part.", "failed": "No."}[whole["level"]]
    word = "but" if whole["level"] == "good" else "because"
    rows = [["in short", level], *([word, reason] for reason in whole["reasons"])]
    told = evaluation.get("advice") or []
    rows += [["next", text] for text in told]
    if not told and evaluation and not whole["reasons"]:  # else these say what to do
        rows.append(["next", "Nothing: more photos would change little."])
    text = f"By poses, training, {compared(evaluation)} and mesh, as far as these were made."
    return Section(JUDGEMENT, [], rows, text)


def compared(evaluation: dict[str, Any], things: str = "photos") -> str:
    """Which photos, or other `things` made of them, an evaluation is of."""
    return f"{'training' if evaluation.get('split') == 'train' else 'held-out'} {things}"


def titled(words: str, evaluation: dict[str, Any]) -> str:
    """Words as a heading, which says where it was the baked field that was evaluated."""
    return f"{words[0].upper()}{words[1:]}{', baked field' if evaluation.get('baked') else ''}"


def _poses_details(folder: Path) -> dict[str, dict[str, Any]]:
    """What estimating the poses noted of each photo, by its name; nothing for imported poses."""
    try:
        images = json.loads((folder / POSES_REPORT).read_text(encoding="utf-8"))["images"]
        return {image["name"]: image for image in images}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _summary(project: Project, poses: Poses, results: dict[str, Any], evaluation: dict[str, Any]) -> Section:
    used = [image for image in project.images if image.status != "rejected"]
    train, mesh = results.get("train") or {}, results.get("mesh") or {}
    rows = [["Photos used", f"{len(used)}"], ["Registered", f"{len(poses.images)} of {len(used)}"]]
    error = poses.reprojection_px
    rows.append(
        ["Reprojection error", f"{error:.2f} px" if error is not None else f"not known: poses from {poses.source}"]
    )
    rows.append(["Scale", "metres" if project.frame.scale_known else "not known: lengths are in scene units"])
    images = titled(compared(evaluation, "images"), evaluation)
    rows.append([images, str(evaluation["images"]) if evaluation else "none"])
    if evaluation:
        rows += [
            ["PSNR", f"{evaluation['psnr']:.2f} dB"],
            ["SSIM", f"{evaluation['ssim']:.3f}"],
            ["LPIPS", "not measured"],
        ]
        miou = evaluation["miou"]
        rows.append(["mIoU", f"{miou:.3f}" if miou is not None else "no labels"])
        if evaluation.get("fps"):
            rows.append(["Frames a second, 800×800", f"{evaluation['fps']}"])
    if train:
        rows.append(["Field", f"{train.get('params_m')} M parameters, {train.get('steps')} steps"])
    if mesh:
        unit = "m" if project.frame.scale_known else "units"
        closed = "closed" if mesh["watertight"] else "open"
        guess = f", {100 * mesh['unseen']:.1f} % of the area a guess" if mesh.get("unseen") else ""
        rows.append(
            ["Mesh", f"{mesh['faces']} faces, {closed}, cells of {significant(mesh['voxel'], 4)} {unit}{guess}"]
        )
    return Section("Result", [], rows)


def _measured(rows: list[dict[str, Any]], measures: dict[str, Any], title: str) -> Section:
    metric = measures.get("unit") == "m"
    area, volume = ("m²", "m³") if metric else ("units²", "units³")
    scale = measures.get("scale") or {}

    def cells(row: dict[str, Any], name: str) -> list[str]:
        if row[name] is None:
            return ["open", ""]
        return list(interval(row[name], row[f"{name}_low"], row[f"{name}_high"]))

    # Measures of earlier versions do not say what is a guess.
    guesses = [row.get("area_guessed", 0.0) / max(row["area"], 1e-30) for row in rows]
    columns = ["name", f"area ({area})", "95 % interval", f"volume ({volume})", "95 % interval"]
    told = [[row["name"], *cells(row, "area"), *cells(row, "volume")] for row in rows]
    if any(guesses):
        columns.insert(3, "of it a guess")
        for line, guess in zip(told, guesses):
            line.insert(3, f"{100 * guess:.1f} %")
    return Section(
        title,
        columns,
        told,
        f"Relative standard uncertainty of the scale: {significant(scale.get('u_percent', 0))} % ({scale.get('source', '')})."
        if metric
        else "The scale is not known: sizes are in scene units.",
    )


def _distances(measures: dict[str, Any]) -> Section:
    metric, distances = measures.get("unit") == "m", measures.get("distances", [])
    # Measures of earlier versions have differences between scene units and metres.
    differences = [d["difference"] if metric else None for d in distances]
    # Tenths of a millimetre, and more where small things are measured more finely; low ends are never below 0.
    digits = [max(4, decimals(d["high"] - d["length"])) for d in distances]
    rows = [
        [
            d["name"],
            d["use"] or "measured only",
            f"{d['length']:.{places}f}",
            f"{d['low']:.{places}f} … {d['high']:.{places}f}",
            "" if d["known"] is None else f"{d['known']:.{places}f}",
            "" if difference is None else f"{1000 * difference:+.{places - 3}f} mm",
        ]
        for d, difference, places in zip(distances, differences, digits)
    ]
    text = "Distances marked “check” were not used for scaling."
    if not metric:
        text += " The scale is not known: nothing is held against metres."
    checks = [x for d, x in zip(distances, differences) if d["use"] == "check" and x is not None]
    if checks:
        spread = 1000 * float(np.sqrt(np.mean(np.square(checks))))
        text += f" Root mean square of their differences: {spread:.{max(digits) - 3}f} mm."
    columns = [
        "distance",
        "use",
        f"measured ({'m' if metric else 'units'})",
        "95 % interval",
        "known (m)",
        "difference",
    ]
    return Section("Control distances", columns, rows, text)


def _accuracy(evaluation: dict[str, Any]) -> Section:
    rows = [[s["name"], f"{s['psnr']:.2f}", f"{s['ssim']:.3f}"] for s in evaluation.get("per_image", [])]
    seen = "" if evaluation.get("split") == "train" else " not"
    text = f"Renders compared with photos that were{seen} trained on."
    title = titled(f"accuracy on {compared(evaluation)}", evaluation)
    return Section(title, ["photo", "PSNR (dB)", "SSIM"], rows, text)


def _calibration(poses: Poses) -> Section:
    count = np.bincount([image.camera for image in poses.images], minlength=len(poses.cameras))
    rows = [
        [
            str(number),
            camera.model,
            f"{camera.width} × {camera.height}",
            f"{camera.fx:.2f}, {camera.fy:.2f}",
            f"{camera.cx:.2f}, {camera.cy:.2f}",
            ", ".join(f"{k:.5f}" for k in camera.distortion) or "none",
            str(count[number]),
        ]
        for number, camera in enumerate(poses.cameras)
    ]
    columns = ["lens", "model", "pixels", "fx, fy (px)", "cx, cy (px)", "distortion", "photos"]
    return Section("Calibration", columns, rows, "Distortion is k1, k2, p1, p2 in OpenCV's order.")


def _cameras(project: Project, scene: Scene, details: dict[str, dict[str, Any]]) -> Section:
    rows = []
    for number, view in enumerate(scene.views):
        known = details.get(view.name, {})
        place = view.camera_to_world[:3, 3]
        ahead = view.camera_to_world[:3, 2]
        rows.append(
            [
                view.name,
                ", ".join(f"{x:.3f}" for x in place),
                ", ".join(f"{x:.3f}" for x in ahead),
                str(known.get("points", "")),
                f"{known['error_px']:.2f}" if known.get("error_px") is not None else "",
                "held out" if number in scene.test else "trained on",
            ]
        )
    unit = "m" if project.frame.scale_known else "scene units"
    columns = ["photo", f"place ({unit})", "looks along", "points", "error (px)", "use"]
    return Section("Cameras", columns, rows, "In the aligned world, z up; the error is the mean reprojection error.")


def _photographs(project: Project, scene: Scene) -> Section:
    rows = [
        [i.name, PurePath(i.source).name or PurePath(i.file).name, f"{i.width} × {i.height}", i.sha256]
        for i in project.images
        if i.status == "ok"
    ]
    return Section("Photographs", ["name", "file", "pixels", "SHA-256 of the original"], rows)


def _left_out(project: Project) -> Section:
    rows = [[image.name, image.reason] for image in project.images if image.status != "ok"]
    return Section("Photos left out", ["name", "reason"], rows)


def _settings(folder: Path, run: str) -> Section:
    try:
        value = json.loads((run_folder(folder, run) / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return Section("Settings of the run", [], [])
    stages: dict[str, Any] = value.get("config") or {}
    rows = [["preset", str(value.get("preset")), ""]]
    accepted = value.get("accepted")
    if isinstance(accepted, dict):
        told = f"revision {accepted.get('revision')} of the marks, accepted {accepted.get('time')}"
        rows.append(["labels", told, ""])
    elif value.get("map_revision") is not None:
        rows.append(["labels", f"label maps of revision {value['map_revision']} of the marks", ""])
    for stage, settings in stages.items():
        if isinstance(settings, dict):
            rows += [
                [f"{stage}.{name}", json.dumps(setting, ensure_ascii=False), ""] for name, setting in settings.items()
            ]
    return Section("Settings of the run", ["setting", "value"], [row[:2] for row in rows])


def _steps(project: Project) -> Section:
    rows = []
    for step in project.provenance:
        given = {k: v for k, v in step.settings.items() if k not in ("project", "config") and v not in (None, {}, [])}
        text = ", ".join(f"{key}={_short(value)}" for key, value in given.items())
        rows.append([step.time, step.verb, step.version, text])
    return Section(
        "Steps", ["time", "verb", "version", "settings"], rows, "What was done to the project, oldest first."
    )


def _short(value: Any) -> str:
    """A setting as text; of paths the last part, which is what another person can tell it by."""
    if isinstance(value, str):
        return PurePath(value).name if PurePath(value).is_absolute() else value
    return json.dumps(value, ensure_ascii=False)


def _versions() -> Section:
    rows = [["Fieldwork", __version__], ["Python", platform.python_version()], ["System", platform.system()]]
    for name in LIBRARIES:
        try:
            rows.append([name, metadata.version(name)])
        except metadata.PackageNotFoundError:
            rows.append([name, "not installed"])
    return Section("Versions", [], rows, "Of the engine that wrote this report; each step names the one that did it.")
