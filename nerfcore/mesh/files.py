"""Mesh files for other programs: PLY, OBJ, GLB, STL, in world units.

GLB and OBJ have y up, as the one demands and most readers of the other expect; PLY and STL have Blender's z up.

Colours: textures are sRGB everywhere. Vertex colours are linear in GLB, as glTF 2.0 (3.9.2, 3.7.2.1) has it, and sRGB
in PLY and OBJ, where readers show the numbers as they are.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from ..errors import SettingError
from ..files import atomic_path
from ..images.picture import srgb_to_linear
from .surface import Surface

FORMATS = (".ply", ".obj", ".glb", ".stl")
Y_UP = (".glb", ".obj")
TEXTURED = (".glb", ".obj")
# Exporters keep attributes with a leading underscore; this one becomes glTF's COLOR_0.
LINEAR_COLOR = "_linear_color"


@dataclass(frozen=True)
class Unwrapped:
    """A mesh whose vertices were split at UV seams: `source` (V,) original vertex, faces (F, 3), uv (V, 2) in [0, 1],
    v upwards."""

    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray


@dataclass(frozen=True)
class Texture:
    """A texture: image (S, S, 3) uint8 sRGB, and the mesh it belongs to."""

    image: np.ndarray
    unwrapped: Unwrapped


def texture_of(faces: np.ndarray, corner_uv: np.ndarray, image: np.ndarray) -> Texture:
    """The texture of a mesh by the UV (F, 3, 2) of its faces' (F, 3) corners: corners that agree share a vertex."""
    key = np.empty(faces.size, [("vertex", np.int64), ("u", np.float32), ("v", np.float32)])
    key["vertex"], key["u"], key["v"] = faces.reshape(-1), corner_uv[..., 0].reshape(-1), corner_uv[..., 1].reshape(-1)
    made, index = np.unique(key, return_inverse=True)
    uv = np.stack([made["u"], made["v"]], 1)
    return Texture(image, Unwrapped(made["vertex"], index.reshape(-1, 3).astype(np.int32), uv))


def check_format(path: Path) -> None:
    """Raise SettingError unless the ending of the file is one of `FORMATS`."""
    if path.suffix.lower() not in FORMATS:
        raise SettingError(f"{path}: meshes are written as {', '.join(FORMATS)}.", "Choose one of these endings.")


def write_surface(
    path: Path, surface: Surface, names: dict[int, str], split: bool, texture: Texture | None = None
) -> list[Path]:
    """Write a mesh file in the format of its suffix.

    `split` makes one object of each class: in one GLB, or in one file each, which then has the class in its name.
    GLB and OBJ carry the texture when there is one; PLY and STL have none. PLY and GLB know the class of each vertex.

    Returns:
        the files written.
    """
    kind = path.suffix.lower()
    if kind in Y_UP:
        surface = y_up(surface)
    parts = _parts(surface, names, texture if kind in TEXTURED else None, split)
    if kind == ".glb":
        return _write_glb(path, parts)
    if not split:
        return _write_one(path, parts["mesh"])
    written = []
    for name, part in parts.items():
        plain = re.sub(r"[^\w.-]+", "_", name)  # class names may hold what file names may not
        written += _write_one(path.with_name(f"{path.stem}_{plain}{path.suffix}"), part)
    return written


def y_up(surface: Surface) -> Surface:
    """The surface turned so that its z axis becomes y."""
    turned = {
        name: getattr(surface, name)[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
        for name in ("vertices", "normals")
    }
    return replace(surface, **turned)


def _parts(surface: Surface, names: dict[int, str], texture: Texture | None, split: bool) -> dict[str, Any]:
    """The surface as one mesh called "mesh", or as one for each class that occurs, by its name."""
    if not split:
        return {"mesh": _part(surface, texture, np.arange(len(surface.faces)))}
    classes = np.unique(surface.face_class).tolist()
    return {
        names.get(c, "void" if c == 0 else f"class {c}"): _part(
            surface, texture, np.flatnonzero(surface.face_class == c)
        )
        for c in classes
    }


def _part(surface: Surface, texture: Texture | None, chosen: np.ndarray) -> trimesh.Trimesh:
    """Some faces of the surface, with the vertices they use."""
    faces = (surface.faces if texture is None else texture.unwrapped.faces)[chosen]
    used, corners = np.unique(faces, return_inverse=True)
    source = used if texture is None else texture.unwrapped.source[used]
    look: dict[str, Any] = {"vertex_colors": surface.colors[source]}
    if texture is not None:
        image = SimpleMaterial(image=Image.fromarray(texture.image))
        look = {"visual": TextureVisuals(uv=texture.unwrapped.uv[used], material=image)}
    return trimesh.Trimesh(
        surface.vertices[source],
        corners.reshape(-1, 3),
        vertex_normals=surface.normals[source],
        vertex_attributes={"_class_id": surface.class_id[source].astype(np.float32)},
        process=False,
        **look,
    )


def _write_one(path: Path, part: trimesh.Trimesh) -> list[Path]:
    kind = path.suffix.lower()
    if kind == ".ply":
        part.vertex_attributes["class_id"] = part.vertex_attributes.pop("_class_id").astype(np.int32)
        return _write(path, export_ply(part, vertex_normal=True))
    if kind == ".stl":
        return _write(path, export_stl(part))
    if isinstance(part.visual, TextureVisuals):
        # Several objects may lie in one folder, or be brought into one scene: all of their names are their own. White
        # space ends a name for many readers.
        name = re.sub(r"\s+", "_", path.stem)
        white, black = [255, 255, 255, 255], [0, 0, 0, 255]
        part.visual.material = SimpleMaterial(
            image=part.visual.material.image, ambient=white, diffuse=white, specular=black, name=name
        )
        text, extra = export_obj(trimesh.Scene(part), return_texture=True, mtl_name=f"{name}.mtl")
    else:
        text, extra = export_obj(trimesh.Scene(part), return_texture=True)
    written = _write(path, text)
    for name, content in extra.items():
        written += _write(path.parent / name, content)
    return written


def _write_glb(path: Path, parts: dict[str, Any]) -> list[Path]:
    """One GLB of named meshes with a matt material: texture or vertex colour alone decide how they look."""
    for part in parts.values():
        matt: dict[str, Any] = {"baseColorFactor": [255, 255, 255, 255], "metallicFactor": 0.0, "roughnessFactor": 1.0}
        if isinstance(part.visual, TextureVisuals):
            part.visual.material = PBRMaterial(baseColorTexture=part.visual.material.image, **matt)
        else:
            # 16 bits: 8 bits of linear light would make dark colours alike.
            color = srgb_to_linear(part.visual.vertex_colors[:, :3] / 255)
            color = np.concatenate([color, np.ones_like(color[:, :1])], 1)
            part.vertex_attributes[LINEAR_COLOR] = (color * 65535 + 0.5).astype(np.uint16)
            part.visual = TextureVisuals(material=PBRMaterial(**matt))
    return _write(path, export_glb(trimesh.Scene(parts), tree_postprocessor=_name_colors))


def _name_colors(tree: dict[str, Any]) -> None:
    """Make our linear vertex colours glTF's."""
    for mesh in tree["meshes"]:
        attributes = mesh["primitives"][0]["attributes"]
        if LINEAR_COLOR in attributes:
            accessor = attributes["COLOR_0"] = attributes.pop(LINEAR_COLOR)
            tree["accessors"][accessor]["normalized"] = True


def _write(path: Path, content: Any) -> list[Path]:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    return [path]
