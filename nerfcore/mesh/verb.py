"""The verb `mesh`: the labelled surface, as arrays for Blender and as PLY, OBJ, GLB or STL for everybody else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..data.load import class_inputs, load_scene, view_inputs
from ..files import atomic_path
from ..geometry.similarity import similarity_scale
from ..images.encode import write_picture
from ..params import MeshParams
from ..progress import Reporter
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, read_made, rounded, write_made
from ..project.runs import MESH_RECORD, checkpoint_id, state_id
from ..project.schema import step
from ..project.store import load_project, record_step, world_from_sfm
from ..render.run import load_info, load_trained
from .build import Built, build
from .files import Texture, check_format, write_surface
from .surface import class_table, is_watertight, to_world
from .texture import bake, unwrap
from .turntable import write_turntable


def mesh(params: MeshParams, report: Reporter) -> dict[str, Any]:
    """Extract the surface of a run and write it to exports/<run>/ (and to `out`), in world units.

    Returns:
        {"vertices", "faces", "watertight", "voxel": in world units, "classes": {name: {"faces", "area"}}, "files"}
    Raises:
        SettingError: unknown format or impossible region. ProjectError, TrainingError, DiskError.
    """
    folder = Path(params.project)
    if params.out is not None:
        check_format(params.out)
    project, trained = load_project(folder), load_trained(folder, params.run)
    scene = load_scene(folder, trained.info.holdout)
    inputs = mesh_inputs(params)
    built = build(trained, project, scene, params, report)
    target = folder / "exports" / params.run
    texture = None
    if params.texture is not None:
        texture = bake_texture(built, params.texture, report)
    world_from_box = trained.info.box(project).world_from_box
    surface = to_world(built.surface, world_from_box)
    report.stage("Writing")
    (target / MESH_RECORD).unlink(missing_ok=True)  # what it says is no longer true from here on
    with atomic_path(target / "mesh.npz") as temporary, open(temporary, "wb") as file:
        arrays = vars(surface) if texture is None else {**vars(surface), "uv": texture.corner_uv}
        np.savez(file, **arrays)
    names = {c.id: c.name for c in scene.classes}
    files = [target / "mesh.npz"]
    if texture is None:
        (target / "texture.png").unlink(missing_ok=True)
    else:
        with atomic_path(target / "texture.png") as temporary:
            write_picture(temporary, texture.image)
        files.append(target / "texture.png")
    for path in [target / "mesh.ply", *([params.out] if params.out else [])]:
        files += write_surface(path, surface, names, params.split == "classes" and path == params.out, texture)
    if params.turntable is not None:
        report.stage("Looking at it")
        files += write_turntable(params.turntable, surface, {c.id: c.color for c in scene.classes}, report)
    result = {
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "watertight": is_watertight(surface.faces),
        "voxel": built.region.voxel * similarity_scale(world_from_box),
        "classes": class_table(surface, names),
        "files": [str(path) for path in files],
    }
    settings = params.model_dump(mode="json")
    write_made(target / MESH_RECORD, step("mesh", settings, result, inputs, state_id(trained.state)))
    record_step(folder, "mesh", settings, result, inputs)
    return result


def mesh_inputs(params: MeshParams) -> Fingerprint:
    """What a mesh depends on. Raises ProjectError."""
    folder = Path(params.project)
    scene = load_scene(folder, load_info(folder, params.run).holdout)
    settings = params.model_dump(mode="json", exclude={"project", "run", "out"})
    out = str(params.out.absolute()) if params.out else None
    return {
        "trained field": checkpoint_id(folder, params.run),
        "alignment": digest(rounded(world_from_sfm(load_project(folder)))),
        "classes": class_inputs(scene),
        "settings": digest([settings, out]),
        "region": digest(None if scene.bounds is None else rounded(scene.bounds)),
        **view_inputs(scene, scene.train, files=True),
    }


def meshed(params: MeshParams) -> Earlier:
    """The mesh that is there, if it is of the present field and settings."""
    target = Path(params.project) / "exports" / params.run
    made = read_made(target / MESH_RECORD)
    if made is None:
        return Earlier()
    # The project may have been moved since; a file of the user's choice is where it was.
    known = [Path(file) for file in made.result.get("files", [])]
    files = [target / f.name if f.parent.parts[-2:] == target.parts[-2:] else f for f in known]
    made.result["files"] = [str(path) for path in files]
    return compare(made, mesh_inputs(params), files)


def bake_texture(built: Built, size: int, report: Reporter) -> Texture:
    """UVs and colours for a surface in the normalised frame."""
    surface = built.surface
    report.stage("Unwrapping")
    unwrapped = unwrap(surface.vertices, surface.faces, size)
    report.stage("Baking the texture")

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        report.check()
        return built.colors(points, normals, Reporter())

    return Texture(bake(surface.vertices, surface.normals, unwrapped, size, color, report), unwrapped)
