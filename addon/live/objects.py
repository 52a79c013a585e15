"""The triangles of a scene's objects, which hide what of a field is behind them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import EngineError
from ..roles import ROLE

SOLID = {"MESH", "CURVE", "SURFACE", "META", "FONT"}


class Triangles(NamedTuple):
    """Vertices (V, 3) in the scene, faces (F, 3), and which of these are holdouts (F,), behind which there is nothing."""

    vertices: np.ndarray
    faces: np.ndarray
    holdout: np.ndarray


def triangles(depsgraph: Any) -> Triangles:
    """The triangles of all that a camera sees, but for surfaces of captures, which are what the field shows itself."""
    vertices, faces, count = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int32)], 0
    holdout = [np.zeros(0, bool)]
    for instance in depsgraph.object_instances:
        obj = instance.object
        if obj.type not in SOLID or not instance.show_self or obj.hide_render or ROLE in obj.original:
            continue
        if not _is_seen(instance):
            continue
        places, corners = mesh_of(obj)
        matrix = np.array(instance.matrix_world, np.float32)
        vertices.append(places @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append(corners + count)
        holdout.append(np.full(len(faces[-1]), is_holdout(instance, depsgraph.view_layer)))
        count += len(vertices[-1])
    return Triangles(np.concatenate(vertices), np.concatenate(faces), np.concatenate(holdout))


def with_instances(objects: Iterable[Any], looked_into: set[Any] | None = None) -> Iterator[Any]:
    """Objects, and those of the collections of which they are instances."""
    looked_into = set() if looked_into is None else looked_into
    for obj in objects:
        yield obj
        collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        if collection is not None and collection not in looked_into:
            looked_into.add(collection)
            yield from with_instances(collection.all_objects, looked_into)


def mesh_of(obj: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and triangles (F, 3) int32 of an evaluated object, in its own frame."""
    mesh = obj.to_mesh()
    if mesh is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    places = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", places)
    if hasattr(mesh, "calc_loop_triangles"):
        mesh.calc_loop_triangles()
    corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    obj.to_mesh_clear()
    return places.reshape(-1, 3), corners.reshape(-1, 3)


def _is_seen(instance: Any) -> bool:
    """Whether cameras see an instance of the depsgraph (Ray Visibility), rather than only its shadow or its reflection."""
    return instance.object.visible_camera and (instance.parent is None or instance.parent.visible_camera)


def is_holdout(instance: Any, view_layer: Any) -> bool:
    """Whether an instance of the depsgraph is a holdout, by itself or by its collection in the view layer."""
    obj = instance.object.original
    placed = instance.parent.original if instance.parent is not None else obj
    return obj.is_holdout or placed.is_holdout or placed.holdout_get(view_layer=view_layer)


def write_triangles(path: Path, depsgraph: Any) -> Path:
    """The same in a file for the engine. Raises EngineError: there is no room for it."""
    found = triangles(depsgraph)._asdict()
    try:
        with open(path, "wb") as file:
            np.savez(file, **found)
    except OSError as error:
        path.unlink(missing_ok=True)
        raise EngineError(
            "disk", f"There is no room for the scene's objects in {path.parent}: {error.strerror}.", "Free some memory."
        ) from error
    return path
