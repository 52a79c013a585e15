"""The verb `mesh`: the labelled surface, as arrays for Blender and as PLY, OBJ, GLB or STL for everybody else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..data.similarity import similarity_scale, transform_points
from ..errors import SettingError
from ..files import atomic_path
from ..params import MeshParams
from ..progress import Reporter
from ..project import load_project, load_scene, save_project
from ..train.run import load_trained
from .extract import Surface, extract

FORMATS = (".ply", ".obj", ".glb", ".stl")


def mesh(params: MeshParams, report: Reporter) -> dict[str, Any]:
    """Extract the surface of a run and write it to exports/<run>/ (and to `out`), in world units.

    Returns:
        {"vertices", "faces", "watertight", "classes": {name: {"faces", "area"}}, "files"}
    Raises:
        SettingError: unknown format. ProjectError, TrainingError, DiskError.
    """
    folder = Path(params.project)
    if params.out is not None and params.out.suffix.lower() not in FORMATS:
        raise SettingError(f"{params.out}: meshes are written as {', '.join(FORMATS)}.", "Choose one of these endings.")
    project, scene = load_project(folder), load_scene(folder)
    trained = load_trained(folder, params.run)
    surface = extract(
        trained.model,
        params.resolution,
        np.full(3, -1.0),
        np.full(3, 1.0),
        trained.info.class_ids if trained.model.field.classes else [],
        report,
        params.faces,
    )
    surface = to_world(surface, trained.info.box(project).world_from_box)
    target = folder / "exports" / params.run
    with atomic_path(target / "mesh.npz") as temporary, open(temporary, "wb") as file:
        np.savez(file, **vars(surface))
    names = {c.id: c.name for c in scene.classes}
    colors = {c.id: c.color for c in scene.classes}
    files = [target / "mesh.npz"]
    report.stage("Writing")
    for path in [target / "mesh.ply", *([params.out] if params.out else [])]:
        files += write_surface(path, surface, names, colors, params.split == "classes" and path == params.out)
    result = {
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "watertight": bool(as_trimesh(surface).is_watertight),
        "classes": class_table(surface, names),
        "files": [str(path) for path in files],
    }
    project.record("mesh", params.model_dump(mode="json"), result)
    save_project(folder, project)
    return result


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


def as_trimesh(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        surface.vertices, surface.faces, vertex_colors=surface.colors, vertex_normals=surface.normals, process=False
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


def write_surface(
    path: Path,
    surface: Surface,
    names: dict[int, str],
    colors: dict[int, tuple[float, float, float]],
    split: bool,
) -> list[Path]:
    """Write a mesh file in the format of its suffix; `split` writes one object a class (GLB) or one file a class."""
    if not split:
        with atomic_path(path) as temporary:
            if path.suffix.lower() == ".ply":
                mesh = as_trimesh(surface)
                mesh.vertex_attributes["class_id"] = surface.class_id.astype(np.int32)
                temporary.write_bytes(mesh.export(file_type="ply", vertex_normal=True))
            else:
                as_trimesh(surface).export(temporary, file_type=path.suffix[1:].lower())
        return [path]
    parts = {
        names.get(int(c), str(c)): as_trimesh(surface).submesh([np.flatnonzero(surface.face_class == c)], append=True)
        for c in np.unique(surface.face_class)
    }
    if path.suffix.lower() == ".glb":
        with atomic_path(path) as temporary:
            trimesh.Scene(parts).export(temporary, file_type="glb")
        return [path]
    written = []
    for name, part in parts.items():
        target = path.with_name(f"{path.stem}_{name}{path.suffix}")
        with atomic_path(target) as temporary:
            part.export(temporary, file_type=path.suffix[1:].lower())
        written.append(target)
    return written
