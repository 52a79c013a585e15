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
from ..mesh.stored import (
    COARSE,
    LABEL_FIRST,
    MESH,
    load_class_map,
    load_surface,
    mesh_folder,
    mesh_label_revision,
    require_in_place,
)
from ..params import ExportParams
from ..progress import Reporter
from ..project.fingerprints import read_made
from ..project.label_revision import map_revision
from ..project.runs import INSTANCES, MESH_RECORD, holdout_of
from ..project.schema import Project
from ..project.store import load_project, record_step
from ..project.written import remove_former
from ..render.baked import load_baked
from ..render.run import load_info, load_trained

# Formats by what they are made of, with the endings of their files; those without an ending are folders.
OF_THE_MESH = {"glb": (".glb",), "obj": (".obj",), "ply": (".ply",), "stl": (".stl",), "usd": USD, "masks": ()}
OF_THE_CAMERAS = {"transforms": (".json",), "colmap": ()}
OF_THE_FIELD = {"onnx": (".onnx",), "voxels": (".npz",), "splats": (".ply",), "vdb": (".vdb",)}
SUFFIXES = OF_THE_MESH | OF_THE_CAMERAS | OF_THE_FIELD
NAMES = {"transforms": "transforms.json", "colmap": "colmap", "masks": "masks"}  # what is not called after the project
# Behind the project's name: the mesh is a .ply as well, and of a project called “mesh” it is stored as .npz.
ENDINGS = {"splats": "-splats", "voxels": "-voxels"}
OWN_FILES = (MESH, COARSE, MESH_RECORD, INSTANCES)  # in the folder of the mesh


def export(params: ExportParams, report: Reporter) -> dict[str, Any]:
    """Write one format to `out`, or to exports/<run>/<project>.<suffix>, with -voxels or -splats behind the project's name.

    Meshes (glb, usd, obj, ply, stl) are the last one that the verb `mesh` extracted, masks show its classes; usd has the
    cameras as well, transforms and colmap nothing else; onnx is the trained field itself as a function, voxels its values
    on a regular grid; splats is the baked field, as .ply and beside it as .glb; vdb is the baked field as a volume.

    Returns:
        {"files": [paths], "to": format, "grids": names, of vdb, "label_revision": of the marks that classes are from, or
        None}
    Raises:
        SettingError: the file has another ending or is the mesh's own, or the format has no words for a lens. ProjectError:
        there is no mesh, or the project was aligned anew since it was made; no trained run or no pose. DiskError: a file
        cannot be written.
    """
    folder = Path(params.project).absolute()
    project = load_project(folder)
    out = (params.out or folder / "exports" / params.run / _default_name(folder, params.to)).absolute()
    suffixes = SUFFIXES[params.to]
    if suffixes and out.suffix.lower() not in suffixes:
        raise SettingError(f"{out}: {params.to} files end in {' or '.join(suffixes)}.", "Choose one of these endings.")
    _require_no_own_file(out, folder, params.run)
    revision = label_revision(folder, project, params)
    result: dict[str, Any] = {"to": params.to, "label_revision": revision}
    if params.to in OF_THE_MESH:
        made = read_made(mesh_folder(folder, params.run) / MESH_RECORD)
        if made is not None:
            require_in_place(folder, made)
        for warning in stale(folder, params.run, pictures=False):
            report.warn(warning)
        files = _write_mesh(folder, project, params, out, revision, report)
    elif params.to in OF_THE_CAMERAS:
        from .cameras import write_colmap, write_transforms

        report.stage("Writing")
        scene = load_scene(folder, holdout_of(folder, params.run))
        metres = project.frame.scale_known
        if params.to == "colmap":
            files = write_colmap(out, scene)
        else:
            files = write_transforms(out, scene, metres, revision)
    else:
        files, more = _write_field(folder, project, params, out, report)
        result |= more
    remove_former(project, "export", out, files, params.to)
    result["files"] = [str(path) for path in files]
    record_step(folder, "export", {**params.model_dump(mode="json"), "out": str(out)}, result)
    return result


def _default_name(folder: Path, to: str) -> str:
    if to in NAMES:
        return NAMES[to]
    name = folder.name if folder.name != ".." else folder.resolve().name
    return f"{name}{ENDINGS.get(to, '')}{SUFFIXES[to][0]}"


def _require_no_own_file(out: Path, folder: Path, run: str) -> None:
    """Raise SettingError where the file would stand in the place of what the verb `mesh` stored."""
    if out.resolve() in {(mesh_folder(folder, run) / name).resolve() for name in OWN_FILES}:
        raise SettingError(f"{out} is a file that the mesh of the run consists of.", "Choose another name with --out.")


def label_revision(folder: Path, project: Project, params: ExportParams) -> int | None:
    """The revision of the marks that the classes of what is exported are from: of the mesh, of the field, or of the label
    maps of the photos; None where they are from none. Raises ProjectError."""
    if params.to in OF_THE_MESH:
        return mesh_label_revision(folder, params.run)
    if params.to in OF_THE_FIELD:
        return load_info(folder, params.run).label_revision
    return map_revision(project) if params.to == "transforms" else None


def _write_mesh(
    folder: Path, project: Project, params: ExportParams, out: Path, revision: int | None, report: Reporter
) -> list[Path]:
    report.stage("Writing")
    surface, texture = load_surface(folder, params.run)
    scene = load_scene(folder, holdout_of(folder, params.run)) if params.to in ("usd", "masks") else None
    if scene is not None and params.to == "masks":
        from .class_masks import write_masks

        if (surface.face_class == scene.ignore_id).all():
            told = "all masks are empty" if scene.classes else "no masks are written"
            report.warn(f"The mesh has no classes, so {told}. {LABEL_FIRST}")
        ids = load_class_map(folder, params.run) if texture is not None else None
        return write_masks(out, surface, ids, scene.views, scene.classes, report)
    instances = read_instances(mesh_folder(folder, params.run))
    features = features_of(surface, project.classes, project.ignore_id, instances, revision)
    views = scene.views if scene is not None else []
    return write_surface(out, surface, features, params.split, texture, views, report.check)


def _write_field(
    folder: Path, project: Project, params: ExportParams, out: Path, report: Reporter
) -> tuple[list[Path], dict[str, Any]]:
    """The files written, and what else the result says."""
    if params.to == "onnx":
        from .onnx_field import write_onnx  # the library takes its time to load

        report.stage("Writing the field")
        write_onnx(out, load_trained(folder, params.run), project)
        return [out], {}
    if params.to == "voxels":
        from .voxels import write_voxels

        write_voxels(out, load_trained(folder, params.run), project, params.resolution, report)
        return [out], {}
    info = load_info(folder, params.run)
    baked = load_baked(folder, params.run, info)
    if params.to == "splats":
        from .splats import write_splats

        ids = info.class_ids if baked.classes else []
        return write_splats(out, baked, info.box(project), ids, info.label_revision, report), {}
    from .volume import write_volume

    names = {entry.id: entry.name for entry in project.classes}
    classes = [names.get(number, f"class {number}") for number in info.class_ids] if baked.classes else []
    return [out], {"grids": write_volume(out, baked, info.box(project), classes, info.label_revision, report)}
