"""The triangles of a scene's objects, which hide what of a field is behind them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..roles import ROLE

SOLID = {"MESH", "CURVE", "SURFACE", "META", "FONT"}


def triangles(depsgraph: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in the scene and faces (F, 3) of all that is rendered, but for surfaces of captures, which are what
    the field shows itself."""
    vertices, faces, count = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int32)], 0
    for instance in depsgraph.object_instances:
        obj = instance.object
        if obj.type not in SOLID or not instance.show_self or obj.hide_render or ROLE in obj.original:
            continue
        mesh = obj.to_mesh()
        if mesh is None:
            continue
        place = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", place)
        if hasattr(mesh, "calc_loop_triangles"):
            mesh.calc_loop_triangles()
        corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("vertices", corners)
        obj.to_mesh_clear()
        matrix = np.array(instance.matrix_world, np.float32)
        vertices.append(place.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append(corners.reshape(-1, 3) + count)
        count += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces)


def write_triangles(path: Path, depsgraph: Any) -> Path:
    """The same in a file for the engine."""
    vertices, faces = triangles(depsgraph)
    with open(path, "wb") as file:
        np.savez(file, vertices=vertices, faces=faces)
    return path
