"""The verb `mesh`: the labelled surface, as arrays for Blender and as PLY, OBJ, GLB or STL for everybody else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.export import export_scene
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply
from trimesh.visual import TextureVisuals

from ..data.box import box_poses
from ..data.cameras import Camera
from ..data.scene import Scene
from ..data.similarity import similarity_scale, transform_points
from ..errors import SettingError
from ..files import atomic_path
from ..params import MeshParams
from ..progress import Reporter
from ..project import load_project, load_scene, save_project
from ..render.image import write_picture
from ..train.run import Trained, load_trained
from .extract import Surface, extract, shade
from .texture import Unwrapped, bake, unwrap

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
    with atomic_path(target / "mesh.npz") as temporary, open(temporary, "wb") as file:
        arrays = vars(surface) if texture is None else {**vars(surface), "uv": texture.corner_uv}
        np.savez(file, **arrays)
    names = {c.id: c.name for c in scene.classes}
    colors = {c.id: c.color for c in scene.classes}
    files = [target / "mesh.npz"]
    report.stage("Writing")
    if texture is None:
        (target / "texture.png").unlink(missing_ok=True)
    else:
        with atomic_path(target / "texture.png") as temporary:
            write_picture(temporary, texture.image)
        files.append(target / "texture.png")
    for path in [target / "mesh.ply", *([params.out] if params.out else [])]:
        files += write_surface(path, surface, names, colors, params.split == "classes" and path == params.out, texture)
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


def spread_views(scene: Scene, box_from_world: np.ndarray, most: int = 24) -> list[tuple[Camera, np.ndarray]]:
    """Up to `most` cameras with poses in the normalised frame, evenly chosen from the training views."""
    chosen = np.linspace(0, len(scene.train) - 1, min(most, len(scene.train))).round().astype(int)
    views = [scene.views[scene.train[i]] for i in chosen]
    return [(view.camera, pose) for view, pose in zip(views, box_poses(views, box_from_world))]


@dataclass(frozen=True)
class Texture:
    """A baked texture: image (S, S, 3) uint8, unwrapped mesh, corner_uv (F, 3, 2): UV of every face's corners."""

    image: np.ndarray
    unwrapped: Unwrapped

    @property
    def corner_uv(self) -> np.ndarray:
        return self.unwrapped.uv[self.unwrapped.faces]


def bake_texture(trained: Trained, surface: Surface, spacing: float, size: int, report: Reporter) -> Texture:
    """UVs and colours for a surface in the normalised frame."""
    report.stage("Unwrapping")
    unwrapped = unwrap(surface.vertices, surface.faces, size)
    report.stage("Baking the texture")

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return shade(trained.model, points, normals, [], spacing, Reporter())[0]

    return Texture(bake(surface.vertices, surface.normals, unwrapped, size, color, report), unwrapped)


def write_textured(path: Path, surface: Surface, texture: Texture, names: dict[int, str], split: bool) -> list[Path]:
    """GLB or OBJ with UVs and the picture; an OBJ's material and picture lie beside it."""
    from PIL import Image

    u = texture.unwrapped
    picture = Image.fromarray(texture.image)
    parts = {}
    for c in np.unique(surface.face_class) if split else [None]:
        chosen = u.faces if c is None else u.faces[surface.face_class == c]
        used, inverse = np.unique(chosen, return_inverse=True)
        parts["mesh" if c is None else names.get(int(c), str(c))] = trimesh.Trimesh(
            surface.vertices[u.source[used]],
            inverse.reshape(-1, 3),
            vertex_normals=surface.normals[u.source[used]],
            visual=TextureVisuals(uv=u.uv[used], image=picture),
            process=False,
        )
    kind = path.suffix[1:].lower()
    data, extra = export_scene(trimesh.Scene(parts), None, file_type="glb"), {}
    if kind == "obj":
        data, extra = export_obj(trimesh.Scene(parts), return_texture=True, mtl_name=f"{path.stem}.mtl")
    for target, content in {path: data, **{path.parent / name: value for name, value in extra.items()}}.items():
        with atomic_path(target) as temporary:
            temporary.write_bytes(content if isinstance(content, bytes) else content.encode())
    return [path, *(path.parent / name for name in extra)]


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
    texture: Texture | None = None,
) -> list[Path]:
    """Write a mesh file in the format of its suffix; `split` writes one object a class (GLB) or one file a class.

    GLB and OBJ carry the texture when there is one; PLY and STL have none.
    """
    if texture is not None and path.suffix.lower() in (".glb", ".obj"):
        return write_textured(path, surface, texture, names, split)
    if not split:
        with atomic_path(path) as temporary:
            if path.suffix.lower() == ".ply":
                mesh = as_trimesh(surface)
                mesh.vertex_attributes["class_id"] = surface.class_id.astype(np.int32)
                temporary.write_bytes(export_ply(mesh, vertex_normal=True))
            else:
                as_trimesh(surface).export(temporary, file_type=path.suffix[1:].lower())
        return [path]
    parts: dict[str, Any] = {
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
