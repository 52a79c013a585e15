"""Mesh files for other programs: GLB, USD, OBJ, PLY, STL, in world units.

GLB and OBJ have y up, as the one demands and most readers of the other expect; USD says which way is up and, as PLY and
STL, has Blender's z up.

Colours: textures are sRGB everywhere. Vertex colours are linear in GLB (glTF 2.0, 3.9.2, 3.7.2.1) and USD, and sRGB in
PLY and OBJ, where readers show the numbers as they are.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import SimpleMaterial

from ..data.scene import View
from ..files import atomic_path
from .features import Features
from .formats import TEXTURED, USD, Y_UP
from .gltf import write_glb
from .parts import Part, Texture, make_part
from .surface import Surface


def write_surface(
    path: Path,
    surface: Surface,
    features: Features,
    split: str,
    texture: Texture | None = None,
    views: Sequence[View] = (),
) -> list[Path]:
    """Write a mesh file in the format of its suffix.

    Args:
        split: "classes" or "instances" make one object of each, in one GLB or USD, or in one file each, which then has
            the name in its own; "none": one object.
        texture: goes into GLB, OBJ and USD. views: cameras, for USD.
    Returns:
        the files written.
    Raises:
        DiskError: a file cannot be written.
    """
    kind = path.suffix.lower()
    if kind in USD:
        from .usd import write_usd  # the library takes its time to load

        return write_usd(path, surface, features, split, texture, views)
    if kind in Y_UP:
        surface = y_up(surface)
    shown = texture if kind in TEXTURED else None
    parts = {
        name: make_part(surface, features, shown, chosen, kind == ".glb")
        for name, chosen in features.groups(split).items()
    }
    if kind == ".glb":
        write_glb(path, parts, features.rows)
        return [path]
    if split == "none":
        return _write_one(path, parts["mesh"], features)
    written = []
    for name, part in parts.items():
        plain = re.sub(r"[^\w.-]+", "_", name)  # class names may hold what file names may not
        written += _write_one(path.with_name(f"{path.stem}_{plain}{path.suffix}"), part, features)
    return written


def y_up(surface: Surface) -> Surface:
    """The surface turned so that its z axis becomes y."""
    turned = {
        name: getattr(surface, name)[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
        for name in ("vertices", "normals")
    }
    return replace(surface, **turned)


def _write_one(path: Path, part: Part, features: Features) -> list[Path]:
    kind = path.suffix.lower()
    if kind == ".obj":
        return _write_obj(path, part, features)
    mesh = trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, process=False)
    if kind == ".stl":
        return _write(path, export_stl(mesh))
    mesh.visual = ColorVisuals(mesh, vertex_colors=part.colors)
    mesh.vertex_attributes["class_id"] = part.class_id.astype(np.int32)
    rows = features.rows
    mesh.face_attributes["face_class"] = np.array([row.class_id for row in rows], np.uint32)[part.face_feature]
    if any(row.instance for row in rows):
        mesh.face_attributes["face_instance"] = np.array([row.instance for row in rows], np.uint32)[part.face_feature]
    return _write(path, export_ply(mesh, vertex_normal=True))


def _write_obj(path: Path, part: Part, features: Features) -> list[Path]:
    """An OBJ with a group for each feature, and its material and texture beside it."""
    # Several objects may lie in one folder, or be brought into one scene: all of their names are their own. White
    # space ends a name for many readers.
    name = _word(path.stem)
    look: dict[str, Any] = {"vertex_colors": part.colors}
    if part.image is not None:
        white, black = [255, 255, 255, 255], [0, 0, 0, 255]
        image = Image.fromarray(part.image)
        material = SimpleMaterial(image=image, ambient=white, diffuse=white, specular=black, name=name)
        look = {"visual": TextureVisuals(uv=part.uv, material=material)}
    order = np.argsort(part.face_feature, kind="stable")
    mesh = trimesh.Trimesh(part.vertices, part.faces[order], vertex_normals=part.normals, process=False, **look)
    text, extra = export_obj(mesh, include_normals=True, return_texture=True, mtl_name=f"{name}.mtl")
    # trimesh writes faces one after the other and knows no groups.
    head, *faces = text.rstrip("\n").split("\nf ")
    ordered = part.face_feature[order]
    starts = [0, *(np.flatnonzero(np.diff(ordered)) + 1).tolist(), len(faces)]
    lines = [head]
    for first, last in pairwise(starts):
        lines.append(f"g {_word(features.rows[ordered[first]].name)}")
        lines += [f"f {face}" for face in faces[first:last]]
    written = _write(path, "\n".join(lines) + "\n")
    for file, content in extra.items():
        written += _write(path.parent / file, content)
    return written


def _word(name: str) -> str:
    return re.sub(r"\s+", "_", name)


def _write(path: Path, content: Any) -> list[Path]:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    return [path]
