"""What is known of one place of the surface: class, instance, confidence, and the photos that show it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import bpy
from mathutils import Vector

from ..roles import PROJECT, UUID, Owner
from .cameras import ASPECT, SIZE
from .lens import pinhole
from .look import CONFIDENCE_ATTRIBUTE
from .materials import label_of
from .surface import CLASS_ATTRIBUTE, INSTANCE_ATTRIBUTE, INSTANCE_NAMES, UNSEEN_ATTRIBUTE
from .visibility import is_surface

MOST_HITS = 32  # things before the surface, such as sparse points, that a ray goes through at most
FARTHEST = 1e9
CLEAR = 0.01  # of the distance to a camera: how far in front of the surface the view to it must begin to be free
GRAZING = 0.1  # cosine to the surface below which a photo shows too little of it


@dataclass(frozen=True)
class Shown:
    """A photo that shows a place: its camera in the scene, and pixels per unit of the scene there, across the surface."""

    camera: bpy.types.Object
    sharpness: float


@dataclass(frozen=True)
class Spot:
    """A place of the surface in the scene. `confidence` of its class in [0, 1]; `instance` is empty where it belongs to
    none; `guessed`: it closes a gap, or a surface that was to be watertight; `photos`, the sharpest first."""

    place: Vector
    class_id: int
    class_name: str
    instance: str
    confidence: float
    guessed: bool = False
    photos: list[Shown] = field(default_factory=list)


def spot_at(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, origin: Vector, direction: Vector) -> Spot | None:
    """What a ray from `origin` meets of a surface of Fieldwork first; None where it meets none, or one whose classes are not
    known: remeshed, in Edit Mode, or without its materials."""
    direction = direction.normalized()
    hit = _cast(scene, depsgraph, origin, direction, FARTHEST)
    if hit is None:
        return None
    place, normal, face, item = hit
    if normal.dot(direction) > 0:
        normal = -normal
    mesh = item.evaluated_get(depsgraph).data  # hidden classes are missing there
    corners = mesh.polygons[face].vertices
    class_id, number, unseen = (
        _value(mesh, name, face) for name in (CLASS_ATTRIBUTE, INSTANCE_ATTRIBUTE, UNSEEN_ATTRIBUTE)
    )
    sure = [_value(mesh, CONFIDENCE_ATTRIBUTE, v) for v in corners]
    index = mesh.polygons[face].material_index
    material = mesh.materials[index] if index < len(mesh.materials) else None
    if class_id is None or None in sure or material is None:
        return None
    return Spot(
        place,
        class_id,
        label_of(material),
        str(item.get(INSTANCE_NAMES, {}).get(str(number), number)) if number else "",
        sum(sure) / len(sure),
        bool(unseen),
        photos_of(scene, depsgraph, place, normal, Owner(str(item.get(PROJECT, "")), str(item.get(UUID, "")))),
    )


def _value(mesh: bpy.types.Mesh, name: str, index: int) -> Any:
    """The value of an attribute for a face or vertex; None where the mesh does not have it."""
    attribute = mesh.attributes.get(name)
    return attribute.data[index].value if attribute is not None and index < len(attribute.data) else None


def photos_of(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, place: Vector, normal: Vector, owner: Owner
) -> list[Shown]:
    """The photos of a project that show a place, the one with the most pixels on it first."""
    found = []
    for camera in scene.objects:
        if camera.type != "CAMERA" or SIZE not in camera or not owner.owns(camera):
            continue
        way = camera.matrix_world.translation - place
        distance = way.length
        cosine = normal.dot(way) / distance if distance else 0.0
        density = _pixels_per_unit(camera, place)
        if cosine < GRAZING or density is None:
            continue
        start = place + CLEAR * way
        if _cast(scene, depsgraph, start, way / distance, distance * (1 - CLEAR)) is None:
            found.append(Shown(camera, density * cosine))
    return sorted(found, key=lambda shown: -shown.sharpness)


def _pixels_per_unit(camera: bpy.types.Object, place: Vector) -> float | None:
    """Pixels of a photo on a length of one at a place that faces it; None where the place is not in the picture."""
    width, height = camera[SIZE]
    at = camera.matrix_world.inverted() @ place
    if camera.data.type == "PANO":
        return width / (2 * math.pi * at.length)
    if at.z >= 0:
        return None
    lens = pinhole(camera.data, width, height, camera.get(ASPECT, (1.0, 1.0)))
    x, y = lens.cx - lens.fx * at.x / at.z, lens.cy + lens.fy * at.y / at.z
    return -lens.fx / at.z if 0 <= x < width and 0 <= y < height else None


def _cast(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, origin: Vector, direction: Vector, distance: float
) -> tuple[Vector, Vector, int, bpy.types.Object] | None:
    """The first hit of a ray on a surface of Fieldwork, through everything else: place, normal, face, object."""
    left = distance
    for _ in range(MOST_HITS):
        hit, place, normal, face, item, _ = scene.ray_cast(depsgraph, origin, direction, distance=left)
        if not hit:
            return None
        if is_surface(item):
            return place, normal, face, item
        step = (place - origin).length + 1e-5 * max(1.0, (place - origin).length)
        origin, left = origin + step * direction, left - step
        if left <= 0:
            return None
    return None
