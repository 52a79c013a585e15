"""The verb `blend`: a capture as a .blend, by a package for Blender and a Blender that reads it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ..data.load import class_inputs, load_scene, view_inputs
from ..files import atomic_path, copied
from ..params import BlendParams
from ..progress import Reporter
from ..project.fingerprints import Earlier, Fingerprint, array_digest, compare, digest, files_digest, stamps_digest
from ..project.runs import INSTANCES, MEASURES, holdout_of
from ..project.schema import ProvenanceStep
from ..project.store import load_poses, load_project, record_step
from .package import photo_renders, stale, write_package
from .process import check_blend, write_in_blender

STAMP = "stamp"  # of the file as it was written, in the record of the step


def blend(params: BlendParams, report: Reporter) -> dict[str, Any]:
    """Write the cameras, points and mesh of a project into `params.out`. What stood there is kept beside it where somebody
    changed it, see `keep_changed`.

    A file there that is not as this verb wrote it holds somebody's work: it is kept beside it as NAME.blend1, as Blender does.

    Returns:
        {"file", "objects": [names], "cameras", "points", "mesh": faces or null, "seconds", "warnings"}.
    Raises:
        SettingError: the output is not named *.blend.
        ProjectError: there are no poses.
        BlenderError: Blender is missing or failed.
    """
    started = time.monotonic()
    out = params.out.absolute()
    check_blend(out)
    folder = params.project.absolute()
    scene = load_scene(folder, holdout_of(folder, params.run))
    inputs = blend_inputs(params)
    package = write_package(folder, params.run, scene, folder.name, report, params.renders)
    warnings = stale(folder, params.run, params.renders)
    if not (package / "mesh.npz").is_file():
        warnings.append("There is no mesh yet: the .blend holds cameras and points only. Run `fieldwork mesh` first.")
    if not len(scene.points) and load_poses(folder).source == "sfm":  # poses of data sets often come without
        warnings.append("The project has no sparse points: its cameras come without them. Run `fieldwork poses` again.")
    kept = keep_changed(folder, out)
    if kept is not None:
        warnings.append(f"{out.name} was changed since it was written: that file is now {kept.name}.")
    result = write_in_blender(package, out, folder, params.split, report)
    for warning in [*warnings, *result.pop("warnings")]:
        report.warn(warning)
    done = {"file": str(out), **result, "seconds": round(time.monotonic() - started, 1)}
    record_step(folder, "blend", params.model_dump(mode="json"), {**done, STAMP: stamps_digest([out])}, inputs)
    return {**done, "warnings": report.warnings}


def blend_inputs(params: BlendParams) -> Fingerprint:
    """What a .blend depends on. Raises ProjectError."""
    folder = params.project.absolute()
    scene = load_scene(folder, holdout_of(folder, params.run))
    exports = folder / "exports" / params.run
    renders = photo_renders(folder, params.run, params.renders)
    pictures = sorted(renders.glob("*.png")) if renders.is_dir() else []
    return {
        "mesh": files_digest((name, exports / name) for name in ("mesh.npz", "texture.png", INSTANCES, MEASURES)),
        "renders": stamps_digest(pictures),
        "classes": class_inputs(scene),
        "sparse points": array_digest(scene.points.xyz, scene.points.rgb),
        "settings": digest([str(params.out.absolute()), params.run, params.split, scene.test]),
        **view_inputs(scene, list(range(len(scene.views))), files=True),
    }


def blended(params: BlendParams) -> Earlier:
    """The .blend that is there, if it shows the present mesh and photos: what was changed in it since stays."""
    return compare(last_written(params.project, params.out), blend_inputs(params), [params.out])


def last_written(folder: Path, out: Path) -> ProvenanceStep | None:
    """The step that last wrote the file; None where this project never did."""
    steps = load_project(folder).provenance
    file = str(out.absolute())
    return next((s for s in reversed(steps) if s.verb == "blend" and s.result.get("file") == file), None)


def keep_changed(folder: Path, out: Path) -> Path | None:
    """Copy a .blend that is not as this project wrote it, and so holds somebody's work, to NAME.blend1, where Blender keeps
    what it replaces; None where there is nothing to keep. Raises DiskError."""
    if not out.is_file():
        return None
    made = last_written(folder, out)
    if made is not None and made.result.get(STAMP) == stamps_digest([out]):
        return None
    kept = out.with_name(f"{out.name}1")
    with atomic_path(kept) as temporary:
        copied(out, temporary)
    return kept
