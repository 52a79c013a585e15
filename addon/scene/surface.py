"""Fills Blender's meshes in small steps, so that the window stays alive between them.

Values go into the mesh's attributes as they are: through the older accessors (`polygons.foreach_set("material_index")`
and the like) Blender converts one value at a time, fifty times slower.
"""

from __future__ import annotations

from collections.abc import Iterator

import bpy
import numpy as np

from .materials import COLOR_ATTRIBUTE
from .mesh_data import MeshData

CLASS_ATTRIBUTE, VERTEX_CLASS_ATTRIBUTE = "class_id", "vertex_class_id"
UV_MAP = "UVMap"


def fill_surface(mesh: bpy.types.Mesh, data: MeshData) -> Iterator[None]:
    """Fill an empty mesh that no object shows yet; a step of each array."""
    faces = len(data.material)
    mesh.vertices.add(len(data.vertices))
    mesh.edges.add(len(data.edges))
    mesh.loops.add(3 * faces)
    mesh.polygons.add(faces)
    yield
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * faces, 3, dtype=np.int32))
    yield
    _set(mesh, "position", "vector", data.vertices)
    _set(mesh, ".edge_verts", "value", data.edges)
    yield
    _set(mesh, ".corner_vert", "value", data.corners)
    _set(mesh, ".corner_edge", "value", data.corner_edges)
    yield
    for name, domain, values in (
        (CLASS_ATTRIBUTE, "FACE", data.face_class),
        (VERTEX_CLASS_ATTRIBUTE, "POINT", data.vertex_class),
        ("material_index", "FACE", data.material),
    ):
        mesh.attributes.new(name, "INT", domain)
        _set(mesh, name, "value", values)
    yield
    set_colors(mesh, data.colors)
    yield
    if data.uv is not None:
        mesh.uv_layers.new(name=UV_MAP)
        yield
        _set(mesh, UV_MAP, "vector", data.uv)
        yield
    mesh.update()


def fill_points(mesh: bpy.types.Mesh, xyz: np.ndarray, colors: np.ndarray) -> None:
    """Fill an empty mesh with loose vertices (N, 3) in colours (N, 4), sRGB in [0, 1]."""
    mesh.vertices.add(len(xyz))
    _set(mesh, "position", "vector", np.ascontiguousarray(xyz, np.float32))
    set_colors(mesh, colors)
    mesh.update()


def set_colors(mesh: bpy.types.Mesh, colors: np.ndarray) -> None:
    """Write vertex colours (V, 4) float32 sRGB into the mesh's colour attribute."""
    attribute = mesh.color_attributes.new(COLOR_ATTRIBUTE, "BYTE_COLOR", "POINT")
    attribute.data.foreach_set("color_srgb", colors.ravel())
    mesh.color_attributes.active_color = attribute
    mesh.color_attributes.render_color_index = mesh.color_attributes.find(COLOR_ATTRIBUTE)


def _set(mesh: bpy.types.Mesh, attribute: str, field: str, values: np.ndarray) -> None:
    # By name each time: a new attribute may move those that exist in memory.
    if len(values):
        mesh.attributes[attribute].data.foreach_set(field, values.ravel())
