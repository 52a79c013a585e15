"""The verb `dataset`: any .blend photographed as a posed, labelled data set.

OUT/transforms.json   camera-to-world with OpenGL axes, in the scene's frame, in metres; intrinsics in pixels
OUT/images/*.png      RGB, or RGBA with alpha 0 where there is nothing
OUT/labels/*.png      class ids, 8 bits (16 where one is above 255), 0 where there is nothing; OUT/classes.json names them
OUT/depth/*.exr       float32 distance along the viewing axis in metres, 0 where there is nothing
"""

from __future__ import annotations

import hashlib
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import atomic_path, write_json
from ..images.encode import write_depth
from ..params import DatasetParams
from ..progress import Reporter
from .folder import claim_folder
from .process import run_in_blender

SETTINGS = "dataset.json"


def dataset(params: DatasetParams, report: Reporter) -> dict[str, Any]:
    """Photograph `params.blend`; a second run with the same settings takes only what is missing.

    Returns:
        {"folder", "images", "classes": [names], "seconds"}
    Raises:
        InputError: there is no such .blend, or the folder holds something else.
        BlenderError: Blender is missing or failed, or the scene cannot be photographed as asked.
    """
    started = time.monotonic()
    blend, out = params.blend.absolute(), params.out.absolute()
    if not blend.is_file():
        raise InputError(f"{blend} does not exist.", "Name a .blend file.")
    folders = ["images", *(["labels"] if params.labels != "none" else []), *(["depth"] if params.depth else [])]
    settings = params.model_dump(mode="json", exclude={"out", "blend"}) | {"sha256": _sha256(blend)}
    claim_folder(out, SETTINGS, settings, folders)
    raw, total = out / ".raw", params.views
    done = sorted(path.stem for path in (out / "images").glob("*.png"))
    finished, metre = len(done), 1.0

    def on_event(event: dict[str, Any]) -> None:
        nonlocal total, finished, metre
        if event.get("kind") == "plan":
            total, metre = event["views"], event["metre"]
        elif event.get("kind") == "view":
            _deliver(out, raw, event["name"], folders, metre)
            finished += 1
            report.progress(finished / total, f"{finished} of {total} photos")
            report.event("preview", path=str(out / "images" / f"{event['name']}.png"))

    request = {**params.model_dump(mode="json"), "blend": str(blend), "folder": str(raw), "done": done}
    try:
        described = run_in_blender("dataset", request, report, on_event)
    finally:
        shutil.rmtree(raw, ignore_errors=True)
    _describe(out, described, folders)
    if not described["denoised"]:
        report.warn("This Blender has no OpenImageDenoise: the photos are noisier than they could be.")
    return {
        "folder": str(out),
        "images": len(described["frames"]),
        "classes": list(described["classes"].values()),
        "seconds": round(time.monotonic() - started, 1),
    }


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _deliver(out: Path, raw: Path, name: str, folders: list[str], metre: float) -> None:
    """Move one view to its places, depths from the scene's units, of `metre` metres, to metres.

    The photo comes last: its presence says that the view is complete.
    """
    if "depth" in folders:
        source = raw / f"{name}.depth.npy"
        write_depth(out / "depth" / f"{name}.exr", np.load(source, allow_pickle=False) * np.float32(metre))
        source.unlink()
    for folder, suffix in (("labels", ".label.png"), ("images", ".png")):
        if folder in folders:
            with atomic_path(out / folder / f"{name}.png") as temporary:
                shutil.copyfile(raw / f"{name}{suffix}", temporary)
            (raw / f"{name}{suffix}").unlink()


def _describe(out: Path, described: dict[str, Any], folders: list[str]) -> None:
    frames = []
    for entry in described["frames"]:
        name = entry["name"]
        frame = {"file_path": f"images/{name}.png", "transform_matrix": entry["camera_to_world"], **entry["intrinsics"]}
        if "labels" in folders:
            frame["label_path"] = f"labels/{name}.png"
        if "depth" in folders:
            frame["depth_file_path"] = f"depth/{name}.exr"
        frames.append(frame)
    shared = described["frames"][0]["intrinsics"]
    if all(entry["intrinsics"] == shared for entry in described["frames"]):
        for frame in frames:
            for key in shared:
                del frame[key]
        head = {"camera_model": "PINHOLE", **shared}
    else:
        head = {"camera_model": "PINHOLE"}
    if described["classes"]:
        write_json(out / "classes.json", {"ignore_id": 0, "classes": described["classes"]})
    head["camera_convention"] = "OpenGL axes, z up, metres"
    unit = {"depth_unit_scale_factor": 1.0} if "depth" in folders else {}
    write_json(out / "transforms.json", {**head, **unit, "frames": frames})
