"""The verb `mesh`: the labelled surface, as arrays for Blender and as PLY, OBJ, GLB or STL for everybody else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..data.box import box_poses
from ..data.load import class_inputs, load_scene, view_inputs
from ..data.scene import Scene
from ..files import atomic_path
from ..geometry.cameras import Camera
from ..geometry.similarity import similarity_scale, transform_points
from ..images.encode import write_picture
from ..params import MeshParams
from ..progress import Reporter
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, read_made, rounded, write_made
from ..project.runs import MESH_RECORD, checkpoint_id, state_id
from ..project.schema import step
from ..project.store import load_project, record_step, world_from_sfm
from ..render.run import Trained, load_info, load_trained
from .extract import Surface, extract, shade
from .files import Texture, check_format, write_surface
from .texture import bake, unwrap


def mesh(params: MeshParams, report: Reporter) -> dict[str, Any]:
    """Extract the surface of a run and write it to exports/<run>/ (and to `out`), in world units.

    Returns:
        {"vertices", "faces", "watertight", "classes": {name: {"faces", "area"}}, "files"}
    Raises:
        SettingError: unknown format. ProjectError, TrainingError, DiskError.
    """
    folder = Path(params.project)
    if params.out is not None:
        check_format(params.out)
    project, trained = load_project(folder), load_trained(folder, params.run)
    scene = load_scene(folder, trained.info.holdout)
    inputs = mesh_inputs(params)
    surface, spacing = extract(
        trained.model,
        params.resolution,
        np.full(3, -1.0),
        np.full(3, 1.0),
        trained.info.class_ids if trained.model.field.classes else [],
        report,
        spread_views(scene, trained.info.box(project).box_from_world),
        params.faces,
    )
    target = folder / "exports" / params.run
    texture = None
    if params.texture is not None:
        texture = bake_texture(trained, surface, spacing, params.texture, report)
    surface = to_world(surface, trained.info.box(project).world_from_box)
    (target / MESH_RECORD).unlink(missing_ok=True)  # what it says is no longer true from here on
    with atomic_path(target / "mesh.npz") as temporary, open(temporary, "wb") as file:
        arrays = vars(surface) if texture is None else {**vars(surface), "uv": texture.corner_uv}
        np.savez(file, **arrays)
    names = {c.id: c.name for c in scene.classes}
    files = [target / "mesh.npz"]
    report.stage("Writing")
    if texture is None:
        (target / "texture.png").unlink(missing_ok=True)
    else:
        with atomic_path(target / "texture.png") as temporary:
            write_picture(temporary, texture.image)
        files.append(target / "texture.png")
    for path in [target / "mesh.ply", *([params.out] if params.out else [])]:
        files += write_surface(path, surface, names, params.split == "classes" and path == params.out, texture)
    result = {
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "watertight": bool(trimesh.Trimesh(surface.vertices, surface.faces, process=False).is_watertight),
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
        **view_inputs(scene, scene.train, files=False),
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


def spread_views(scene: Scene, box_from_world: np.ndarray, most: int = 24) -> list[tuple[Camera, np.ndarray]]:
    """Up to `most` cameras with poses in the normalised frame, evenly chosen from the training views."""
    chosen = np.linspace(0, len(scene.train) - 1, min(most, len(scene.train))).round().astype(int)
    views = [scene.views[scene.train[i]] for i in chosen]
    return [(view.camera, pose) for view, pose in zip(views, box_poses(views, box_from_world))]


def bake_texture(trained: Trained, surface: Surface, spacing: float, size: int, report: Reporter) -> Texture:
    """UVs and colours for a surface in the normalised frame."""
    report.stage("Unwrapping")
    unwrapped = unwrap(surface.vertices, surface.faces, size)
    report.stage("Baking the texture")

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return shade(trained.model, points, normals, [], spacing, Reporter())[0]

    return Texture(bake(surface.vertices, surface.normals, unwrapped, size, color, report), unwrapped)


def to_world(surface: Surface, world_from_box: np.ndarray) -> Surface:
    """The surface carried by a similarity (4, 4)."""
    rotation = world_from_box[:3, :3] / similarity_scale(world_from_box)
    return Surface(
        transform_points(world_from_box, surface.vertices).astype(np.float32),
        surface.faces,
        (surface.normals @ rotation.T).astype(np.float32),
        surface.colors,
        surface.class_id,
        surface.face_class,
    )


def class_table(surface: Surface, names: dict[int, str]) -> dict[str, dict[str, float]]:
    """Number of faces and area (world units²) of each class on the surface."""
    areas = trimesh.triangles.area(surface.vertices[surface.faces].astype(np.float64))
    return {
        names.get(int(c), str(c)): {
            "faces": int((surface.face_class == c).sum()),
            "area": round(float(areas[surface.face_class == c].sum()), 6),
        }
        for c in np.unique(surface.face_class)
    }
