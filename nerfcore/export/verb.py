"""The verb `export`: what was made of a capture, in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..blender.package import stale
from ..data.load import load_scene
from ..errors import SettingError
from ..mesh.features import features_of
from ..mesh.files import write_surface
from ..mesh.formats import USD
from ..mesh.instances import read_instances
from ..mesh.stored import load_surface, mesh_folder
from ..params import ExportParams
from ..progress import Reporter
from ..project.runs import holdout_of
from ..project.store import load_project, record_step
from ..render.baked import load_baked
from ..render.run import load_info, load_trained

SUFFIXES = {
    "glb": (".glb",),
    "obj": (".obj",),
    "ply": (".ply",),
    "stl": (".stl",),
    "usd": USD,
    "onnx": (".onnx",),
    "voxels": (".npz",),
    "splats": (".ply",),
    "vdb": (".vdb",),
}
OF_THE_FIELD = ("onnx", "voxels", "splats", "vdb")


def export(params: ExportParams, report: Reporter) -> dict[str, Any]:
    """Write one format to `out`, or to exports/<run>/<project>.<suffix>.

    Meshes (glb, usd, obj, ply, stl) are the last one that the verb `mesh` extracted; usd has the cameras as well; onnx is the trained field itself as a function, voxels its values on a regular grid; splats is the baked field, as .ply and beside it as .glb; vdb is the baked field as a volume.

    Returns:
        {"files": [paths], "to": format, "grids": names, of vdb}
    Raises:
        SettingError: the file has another ending. ProjectError: there is no mesh or no trained run.
        DiskError: a file cannot be written.
    """
    folder = Path(params.project).absolute()
    project = load_project(folder)
    suffixes = SUFFIXES[params.to]
    name = f"{folder.name}-splats" if params.to == "splats" else folder.name  # the mesh ends in .ply as well
    out = params.out or folder / "exports" / params.run / f"{name}{suffixes[0]}"
    if out.suffix.lower() not in suffixes:
        raise SettingError(f"{out}: {params.to} files end in {' or '.join(suffixes)}.", "Choose one of these endings.")
    if params.to not in OF_THE_FIELD:
        for warning in stale(folder, params.run, pictures=False):
            report.warn(warning)
    result: dict[str, Any] = {"to": params.to}
    if params.to == "onnx":
        from .field_graph import write_onnx  # the library takes its time to load

        report.stage("Writing the field")
        write_onnx(out, load_trained(folder, params.run), project)
        files = [out]
    elif params.to == "voxels":
        from .voxels import write_voxels

        write_voxels(out, load_trained(folder, params.run), project, params.resolution, report)
        files = [out]
    elif params.to == "splats":
        from .splats import write_splats

        info = load_info(folder, params.run)
        baked = load_baked(folder, params.run, info)
        files = write_splats(out, baked, info.box(project), info.class_ids if baked.classes else [], report)
    elif params.to == "vdb":
        from .volume import write_volume

        info = load_info(folder, params.run)
        names = {entry.id: entry.name for entry in project.classes}
        baked = load_baked(folder, params.run, info)
        classes = [names.get(number, f"class {number}") for number in info.class_ids] if baked.classes else []
        result["grids"] = write_volume(out, baked, info.box(project), classes, report)
        files = [out]
    else:
        report.stage("Writing")
        surface, texture = load_surface(folder, params.run)
        instances = read_instances(mesh_folder(folder, params.run))
        features = features_of(surface, project.classes, project.ignore_id, instances)
        views = load_scene(folder, holdout_of(folder, params.run)).views if params.to == "usd" else []
        files = write_surface(out, surface, features, params.split, texture, views)
    result["files"] = [str(path) for path in files]
    record_step(folder, "export", params.model_dump(mode="json"), result)
    return result
