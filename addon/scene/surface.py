"""The surface: objects whose meshes are filled in small steps, so that the window stays alive between them.

Values go into the mesh's attributes as they are: through the older accessors (`polygons.foreach_set("material_index")`
and the like) Blender converts one value at a time, fifty times slower.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from ..roles import ROLE
from .edited import WRITTEN, Steps, mesh_fingerprint
from .look import (
    CLASS_COLOR_ATTRIBUTE,
    COLOR_ATTRIBUTE,
    CONFIDENCE_ATTRIBUTE,
    SHOWN_ATTRIBUTE,
    add_viewport_colors,
)
from .materials import make_material
from .mesh_data import MeshData, Part, measured_of, slot_classes
from .owned import Owned
from .package import Package
from .slices import Held

CLASS_ATTRIBUTE, VERTEX_CLASS_ATTRIBUTE = "class_id", "vertex_class_id"
INSTANCE_ATTRIBUTE = "instance_id"
UNSEEN_ATTRIBUTE = "unseen"  # faces that close gaps, or a watertight surface
RELATIONS = "relations"  # custom property of the objects of instances
INSTANCE_NAMES = "instances"  # custom property of the objects: names by the numbers of the attribute
LABEL_REVISION = "label_revision"  # custom property of the objects: of the marks that classes are from
UV_MAP = "UVMap"
# Custom properties, in `unit`² and `unit`³: the value and the ends of its 95 % interval.
MEASURED = tuple(f"{name}{end}" for name in ("area", "volume") for end in ("", "_low", "_high"))
UNIT = "unit"
STEP = (0.9, "mesh")


def surface(owned: Owned, package: Package, part: Part, groups: Callable[[], tuple[Any, Any]]) -> Steps:
    """One object of the surface, its materials colored through the shader group, the solid viewport through the
    geometry-nodes group that `groups` finds; returns it."""
    held = Held(bpy.data.meshes, bpy.data.meshes.new(part.name))
    yield from fill_surface(held, part.data)
    for entry in slot_classes(package):
        is_class = entry["id"] != package.ignore_id
        material = make_material(owned.owner, entry["name"], entry["color"], groups()[0], is_class)
        describe(material, measured_of(package, "classes", entry["id"]), package.measures)
        held().materials.append(material)
    fingerprint = yield from mesh_fingerprint(held)
    held()[WRITTEN] = fingerprint
    item = yield from owned.with_mesh(part.role, part.name, held, part.group)
    add_viewport_colors(item, groups()[1])
    item[INSTANCE_NAMES] = {str(entry["id"]): entry["name"] for entry in package.instances}
    describe(item, part.measured, package.measures)
    if package.label_revision is not None:
        item[LABEL_REVISION] = package.label_revision
    elif LABEL_REVISION in item:
        del item[LABEL_REVISION]
    relate(item, {entry["id"]: entry["name"] for entry in package.instances}, package.relations)
    return item


def relate(item: bpy.types.Object, names: dict[int, str], relations: list[dict[str, Any]]) -> None:
    """Note how an instance stands to others as a custom property of its object: {"on": "table.001", …}."""
    role = str(item.get(ROLE, ""))
    own = int(role.partition(":")[2]) if role.startswith("instance:") else None
    told: dict[str, list[str]] = {}
    for entry in relations:
        if entry["subject"] == own:
            told.setdefault(entry["relation"], []).append(names.get(entry["object"], str(entry["object"])))
    if told:
        item[RELATIONS] = {kind: ", ".join(others) for kind, others in told.items()}
    elif RELATIONS in item:
        del item[RELATIONS]


def describe(item: Any, measured: dict[str, Any], measures: dict[str, Any]) -> None:
    """Note what was measured of a class or instance, with the ends of its 95 % intervals, as custom properties of its
    object or material."""
    for name in MEASURED:
        value = measured.get(name)
        if value is not None:
            item[name] = float(value)
        elif name in item:
            del item[name]
    if measured:
        item[UNIT] = str(measures.get("unit", ""))
    elif UNIT in item:
        del item[UNIT]


def fill_surface(held: Held, data: MeshData) -> Steps:
    """Fill an empty mesh that no object shows yet; a step of each array."""
    mesh, faces = held(), len(data.material)
    mesh.vertices.add(len(data.vertices))
    mesh.edges.add(len(data.edges))
    mesh.loops.add(3 * faces)
    mesh.polygons.add(faces)
    yield STEP
    held().polygons.foreach_set("loop_start", np.arange(0, 3 * faces, 3, dtype=np.int32))
    yield STEP
    set_values(held(), "position", "vector", data.vertices)
    set_values(held(), ".edge_verts", "value", data.edges)
    yield STEP
    set_values(held(), ".corner_vert", "value", data.corners)
    set_values(held(), ".corner_edge", "value", data.corner_edges)
    yield STEP
    mesh = held()
    for name, domain, values in (
        (CLASS_ATTRIBUTE, "FACE", data.face_class),
        (INSTANCE_ATTRIBUTE, "FACE", data.face_instance),
        (VERTEX_CLASS_ATTRIBUTE, "POINT", data.vertex_class),
        ("material_index", "FACE", data.material),
    ):
        mesh.attributes.new(name, "INT", domain)
        set_values(mesh, name, "value", values)
    yield STEP
    if data.unseen is not None:
        held().attributes.new(UNSEEN_ATTRIBUTE, "BOOLEAN", "FACE")
        set_values(held(), UNSEEN_ATTRIBUTE, "value", data.unseen)
        yield STEP
    mesh = held()
    mesh.attributes.new(CONFIDENCE_ATTRIBUTE, "FLOAT", "POINT")
    set_values(mesh, CONFIDENCE_ATTRIBUTE, "value", data.confidence)
    for name, domain, colors in (
        (CLASS_COLOR_ATTRIBUTE, "FACE", data.face_colors),
        (SHOWN_ATTRIBUTE, "CORNER", data.colors[data.corners]),
    ):
        yield STEP
        mesh = held()
        mesh.attributes.new(name, "BYTE_COLOR", domain)
        set_values(mesh, name, "color_srgb", colors)
    yield STEP
    mesh = held()
    set_colors(mesh, data.colors)
    mesh.color_attributes.active_color_name = SHOWN_ATTRIBUTE
    yield STEP
    if data.uv is not None:
        held().uv_layers.new(name=UV_MAP)
        yield STEP
        set_values(held(), UV_MAP, "vector", data.uv)
        yield STEP
    held().update()


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
