"""Mesh files for other programs: GLB, USD, OBJ, PLY, STL, in world units.

GLB and OBJ have y up, as the one demands and most readers of the other expect; USD says which way is up and, as PLY and
STL, has Blender's z up.

Colours: textures are sRGB everywhere. Vertex colours are linear in GLB (glTF 2.0, 3.9.2, 3.7.2.1) and USD, and sRGB in
PLY and OBJ, where readers show the numbers as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data.scene import View
from ..files import atomic_path
from ..images.encode import png_bytes
from ..images.names import file_names
from ..progress import go_on
from ..project.label_revision import label_facts
from .features import Features
from .formats import TEXTURED, USD, Y_UP
from .obj import write_obj
from .parts import Part, Texture, make_part
from .surface import Surface


def write_surface(
    path: Path,
    surface: Surface,
    features: Features,
    split: str,
    texture: Texture | None = None,
    views: Sequence[View] = (),
    check: Callable[[], None] = go_on,
) -> list[Path]:
    """Write a mesh file in the format of its suffix.

    Args:
        split: "classes" or "instances" make one object of each, in one GLB or USD, or in one file each, which then has
            the name in its own; "none": one object.
        texture: goes into GLB, OBJ and USD. views: cameras, for USD. check: called every second or so, may raise.
    Returns:
        the files written.
    Raises:
        DiskError: a file cannot be written.
    """
    kind = path.suffix.lower()
    png = png_bytes(texture.image, check) if texture is not None and kind in (*TEXTURED, *USD) else None
    if kind in USD:
        from .usd import write_usd  # the library takes its time to load

        return write_usd(path, surface, features, split, texture, png, views, check)
    if kind in Y_UP:
        surface = y_up(surface)
    shown = texture if kind in TEXTURED else None
    parts: dict[str, Part] = {}
    for name, chosen in features.groups(split).items():
        check()
        parts[name] = make_part(surface, features, shown, chosen, kind == ".glb")
    if kind == ".glb":
        from .gltf import write_glb

        write_glb(path, parts, features, png, check)
        return [path]
    if split == "none":
        return _write_one(path, parts["mesh"], features, png, check)
    written = []
    for plain, part in zip(file_names(list(parts)), parts.values()):
        written += _write_one(path.with_name(f"{path.stem}_{plain}{path.suffix}"), part, features, png, check)
    return written


def y_up(surface: Surface) -> Surface:
    """The surface turned so that its z axis becomes y."""
    turned = {
        name: getattr(surface, name)[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
        for name in ("vertices", "normals")
    }
    return replace(surface, **turned)


def _write_one(path: Path, part: Part, features: Features, png: bytes | None, check: Callable[[], None]) -> list[Path]:
    check()
    kind = path.suffix.lower()
    if kind == ".obj":
        return write_obj(path, part, features, png, check)
    import trimesh
    from trimesh.exchange.ply import export_ply
    from trimesh.exchange.stl import export_stl
    from trimesh.visual import ColorVisuals

    mesh = trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, process=False)
    if kind == ".stl":
        return _write(path, export_stl(mesh))
    mesh.visual = ColorVisuals(mesh, vertex_colors=part.colors)
    mesh.vertex_attributes["class_id"] = part.class_id.astype(np.int32)
    rows = features.rows
    mesh.face_attributes["face_class"] = np.array([row.class_id for row in rows], np.uint32)[part.face_feature]
    if any(row.instance for row in rows):
        mesh.face_attributes["face_instance"] = np.array([row.instance for row in rows], np.uint32)[part.face_feature]
    return _write(path, with_comments(export_ply(mesh, vertex_normal=True), label_facts(features.label_revision)))


def with_comments(ply: bytes, facts: dict[str, int]) -> bytes:
    """A PLY file with facts as comments of its header."""
    told = "".join(f"comment {name} {value}\n" for name, value in facts.items())
    return ply.replace(b"\nelement ", f"\n{told}element ".encode(), 1)


def _write(path: Path, content: Any) -> list[Path]:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    return [path]
