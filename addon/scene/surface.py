"""The surface: objects whose meshes are filled in small steps, so that the window stays alive between them.

Values go into the mesh's attributes as they are: through the older accessors (`polygons.foreach_set("material_index")`
and the like) Blender converts one value at a time, fifty times slower.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from .materials import COLOR_ATTRIBUTE, make_material
from .mesh_data import MeshData, Part, slot_classes
from .owned import Owned, Steps
from .package import Package

CLASS_ATTRIBUTE, VERTEX_CLASS_ATTRIBUTE = "class_id", "vertex_class_id"
UV_MAP = "UVMap"


def surface(owned: Owned, package: Package, root: bpy.types.Object, part: Part, group: Any) -> Steps:
    """One object of the surface, its materials colored through `group`; returns it."""
    mesh = bpy.data.meshes.new(part.name)
    for _ in fill_surface(mesh, part.data):
        yield 0.9, "mesh"
    for entry in slot_classes(package):
        mesh.materials.append(make_material(owned.owner, entry["name"], entry["color"], group))
    item = owned.with_mesh(part.role, part.name, mesh, root)
    item.matrix_parent_inverse = item.matrix_basis = Matrix.Identity(4)
    return item


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
    set_values(mesh, "position", "vector", data.vertices)
    set_values(mesh, ".edge_verts", "value", data.edges)
    yield
    set_values(mesh, ".corner_vert", "value", data.corners)
    set_values(mesh, ".corner_edge", "value", data.corner_edges)
    yield
    for name, domain, values in (
        (CLASS_ATTRIBUTE, "FACE", data.face_class),
        (VERTEX_CLASS_ATTRIBUTE, "POINT", data.vertex_class),
        ("material_index", "FACE", data.material),
    ):
        mesh.attributes.new(name, "INT", domain)
        set_values(mesh, name, "value", values)
    yield
    set_colors(mesh, data.colors)
    yield
    if data.uv is not None:
        mesh.uv_layers.new(name=UV_MAP)
        yield
        set_values(mesh, UV_MAP, "vector", data.uv)
        yield
    mesh.update()


def set_colors(mesh: bpy.types.Mesh, colors: np.ndarray) -> None:
    """Write vertex colours (V, 4) float32 sRGB into the mesh's colour attribute."""
    attribute = mesh.color_attributes.new(COLOR_ATTRIBUTE, "BYTE_COLOR", "POINT")
    attribute.data.foreach_set("color_srgb", colors.ravel())
    mesh.color_attributes.active_color = attribute
    mesh.color_attributes.render_color_index = mesh.color_attributes.find(COLOR_ATTRIBUTE)


def set_values(mesh: bpy.types.Mesh, attribute: str, field: str, values: np.ndarray) -> None:
    """Write the values of one attribute."""
    # By name each time: a new attribute may move those that exist in memory.
    if len(values):
        mesh.attributes[attribute].data.foreach_set(field, values.ravel())
