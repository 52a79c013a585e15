"""Whether what an earlier import made was changed since, by fingerprints stored with it; what was, becomes the user's own.

Nothing here is held over two slices: see slices.py.
"""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Iterable
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..roles import PROJECT, ROLE, UUID, Owner
from .slices import Held

CAMERA_PATH = "camera path"  # role of the animated camera
WRITTEN = "fieldwork_written"  # custom property: fingerprint of what was written
# Attribute type → field and type of its values. Others are known by their names.
FIELDS = {
    "FLOAT": ("value", np.float32, 1),
    "INT": ("value", np.int32, 1),
    "INT8": ("value", np.int32, 1),
    "BOOLEAN": ("value", np.bool_, 1),
    "FLOAT2": ("vector", np.float32, 2),
    "FLOAT_VECTOR": ("vector", np.float32, 3),
    "FLOAT_COLOR": ("color", np.float32, 4),
    "BYTE_COLOR": ("color", np.float32, 4),
}
# Blender's own attributes begin with a dot; most are passing states, such as what is selected. These are not.
LASTING = (".corner_vert", ".sculpt_mask", ".sculpt_face_set")
DRAWN = ("Shown", "class_color")  # follow from others
DIGITS = 6  # of numbers that Blender computes anew when a file is read

Steps = Generator[tuple[float, str], None, Any]  # yields the share that is done and what is next


def mesh_fingerprint(held: Held) -> Steps:
    """The geometry of a mesh with its attributes, a step for each of them."""
    digest = hashlib.blake2b(digest_size=16)
    mesh = held()
    names = [a.name for a in mesh.attributes if a.name not in DRAWN and (a.name[0] != "." or a.name in LASTING)]
    digest.update(repr((len(mesh.vertices), len(mesh.polygons), mesh.shape_keys is not None)).encode())
    for name in sorted(names):
        attribute = held().attributes.get(name)
        if attribute is None or not len(attribute.data):  # Edit Mode leaves empty ones
            continue
        digest.update(f"{name} {attribute.data_type} {attribute.domain}".encode())
        if attribute.data_type in FIELDS:
            field, kind, width = FIELDS[attribute.data_type]
            values = np.empty(len(attribute.data) * width, kind)
            attribute.data.foreach_get(field, values)
            digest.update(values)
        yield 0.95, name
    return digest.hexdigest()


def camera_fingerprint(item: bpy.types.Object) -> str:
    """Place and lens of a camera."""
    data = item.data
    numbers = [*item.location, *_rotation(item), *item.scale, data.lens, data.shift_x, data.shift_y, data.sensor_width]
    return _digest([item.rotation_mode, data.type, data.sensor_fit, *(f"{v:.{DIGITS}g}" for v in _positive(numbers))])


def keys_fingerprint(item: bpy.types.Object) -> str:
    """The keyframes of an object and its data."""
    keys = []
    for block in (item, item.data):
        for curve in _curves(block.animation_data):
            points = [f"{v:.{DIGITS}g}" for point in curve.keyframe_points for v in _positive(point.co)]
            keys += [curve.data_path, str(curve.array_index), *points]
    return _digest(keys)


def tree_fingerprint(tree: bpy.types.NodeTree) -> str:
    """The nodes of a tree, their values and links; not what drivers give, nor images and what else is linked to."""
    parts = []
    for node in sorted(tree.nodes, key=lambda node: node.name):
        values = [s.default_value for s in node.inputs if not s.is_linked and hasattr(s, "default_value")]
        numbers = [v for value in values for v in _numbers(value)]
        if node.type == "VALTORGB":
            numbers += [v for stop in node.color_ramp.elements for v in (stop.position, *stop.color)]
        parts.append(f"{node.bl_idname} {node.name} {[f'{v:.{DIGITS}g}' for v in _positive(numbers)]}")
    ends = [(a.from_node.name, a.from_socket.identifier, a.to_node.name, a.to_socket.identifier) for a in tree.links]
    return _digest([*parts, *map(str, sorted(ends))])


def _numbers(value: Any) -> Iterable[float]:
    if isinstance(value, (int, float)):
        return [value]
    return [] if isinstance(value, (str, bpy.types.ID)) or value is None else list(value)


def mesh_edited(held: Held, owner: Owner) -> Steps:
    """Whether a mesh is not as it was written, or is just being edited. One without a fingerprint may have been."""
    mesh = held()
    if mesh.is_editmode or any(slot is None or not owner.owns(slot) for slot in mesh.materials):
        return True
    return (yield from mesh_fingerprint(held)) != held().get(WRITTEN)


def surface_edited(item: bpy.types.Object, owner: Owner) -> Steps:
    """Whether an object has another mesh than was written, or work that would go with its vertices."""
    return hangs_on_vertices(item) or (yield from mesh_edited(Held(bpy.data.meshes, item.data), owner))


def hangs_on_vertices(item: bpy.types.Object) -> bool:
    """Whether an object has what another mesh could not keep: weights, or levels of sculpting."""
    sculpted = any(modifier.type == "MULTIRES" and modifier.total_levels for modifier in item.modifiers)
    return sculpted or len(item.vertex_groups) > 0


def camera_edited(item: bpy.types.Object) -> bool:
    """Whether a camera was moved, has another lens or, if it is the animated one, other keys than were written."""
    fingerprint = keys_fingerprint if item.get(ROLE) == CAMERA_PATH else camera_fingerprint
    return WRITTEN in item and item[WRITTEN] != fingerprint(item)


def object_changed(item: bpy.types.Object) -> bool:
    """Whether an object carries what the user gave it: a place, keys, constraints, modifiers or vertex groups of his own,
    or objects that hang on it."""
    modifiers = [m for m in item.modifiers if not m.name.startswith("Fieldwork ")]
    children = [child for child in item.children if ROLE not in child and "fieldwork_render" not in child]
    if item.type == "CAMERA":
        own = camera_edited(item) or (item.animation_data is not None and item[ROLE] != CAMERA_PATH)
    else:
        own = item.matrix_basis != Matrix.Identity(4) or item.animation_data is not None or hangs_on_vertices(item)
    return bool(own or item.constraints or modifiers or children)


def write_once(item: Any, name: str, value: float) -> None:
    """Set a number of a datablock, unless the user changed what was written last."""
    key = f"fieldwork_{name}"
    if key not in item or abs(item[key] - getattr(item, name)) <= 1e-5 * abs(item[key]):
        setattr(item, name, value)
        item[key] = value


def release(item: Any) -> None:
    """Leave an object or node tree to the user: no import takes it for one of its own any more."""
    for name in (ROLE, PROJECT, UUID):
        if name in item:
            del item[name]


def _rotation(item: bpy.types.Object) -> Iterable[float]:
    if item.rotation_mode == "QUATERNION":
        return item.rotation_quaternion
    return item.rotation_axis_angle if item.rotation_mode == "AXIS_ANGLE" else item.rotation_euler


def _curves(animation: bpy.types.AnimData | None) -> list[bpy.types.FCurve]:
    action = animation.action if animation else None
    if action is None:
        return []
    if hasattr(action, "fcurves"):
        return list(action.fcurves)
    # Blender 5: by layers, strips, and slots.
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def _positive(numbers: Iterable[float]) -> list[float]:
    """Numbers whose zeros have no sign."""
    return [round(number, DIGITS) + 0.0 for number in numbers]


def _digest(parts: Iterable[str]) -> str:
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
