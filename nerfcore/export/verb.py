"""The verb `export`: what was made of a capture, in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..blender.package import stale, write_package
from ..blender.process import write_in_blender
from ..data.load import load_scene
from ..errors import SettingError
from ..mesh.files import write_surface
from ..mesh.stored import load_surface
from ..params import ExportParams
from ..progress import Reporter
from ..project.runs import holdout_of
from ..project.store import load_project, record_step
from ..render.run import load_trained

SUFFIXES = {
    "glb": (".glb",),
    "obj": (".obj",),
    "ply": (".ply",),
    "stl": (".stl",),
    "usd": (".usdc", ".usda", ".usd", ".usdz"),
    "onnx": (".onnx",),
    "voxels": (".npz",),
}


def export(params: ExportParams, report: Reporter) -> dict[str, Any]:
    """Write one format to `out`, or to exports/<run>/<project>.<suffix>.

    Meshes (glb, obj, ply, stl) are the last one that the verb `mesh` extracted; usd has the cameras and the sparse
    points as well; onnx is the trained field itself as a function, voxels its values on a regular grid.

    Returns:
        {"files": [paths], "to": format}
    Raises:
        SettingError: the file has another ending. ProjectError: there is no mesh or no trained run.
        BlenderError: usd, and there is no Blender that can write it.
    """
    folder = Path(params.project).absolute()
    project = load_project(folder)
    suffixes = SUFFIXES[params.to]
    out = params.out or folder / "exports" / params.run / f"{folder.name}{suffixes[0]}"
    if out.suffix.lower() not in suffixes:
        raise SettingError(f"{out}: {params.to} files end in {' or '.join(suffixes)}.", "Choose one of these endings.")
    if params.to not in ("onnx", "voxels"):  # these are read from the field itself
        for warning in stale(folder, params.run, pictures=False):
            report.warn(warning)
    if params.to == "onnx":
        from .field_graph import write_onnx  # the library takes its time to load

        report.stage("Writing the field")
        write_onnx(out, load_trained(folder, params.run), project)
        files = [out]
    elif params.to == "voxels":
        from .voxels import write_voxels

        write_voxels(out, load_trained(folder, params.run), project, params.resolution, report)
        files = [out]
    elif params.to == "usd":
        files = [_write_usd(out, folder, params, report)]
    else:
        report.stage("Writing")
        surface, texture = load_surface(folder, params.run)
        names = {c.id: c.name for c in project.classes}
        files = write_surface(out, surface, names, params.split == "classes", texture)
    result = {"to": params.to, "files": [str(path) for path in files]}
    record_step(folder, "export", params.model_dump(mode="json"), result)
    return result


def _write_usd(out: Path, folder: Path, params: ExportParams, report: Reporter) -> Path:
    load_surface(folder, params.run)  # says so when there is none
    package = write_package(folder, params.run, load_scene(folder, holdout_of(folder, params.run)), folder.name, report)
    result = write_in_blender("usd", package, out, params.split == "classes", report)
    for warning in result["warnings"]:
        report.warn(warning)
    return out
