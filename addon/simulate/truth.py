"""The exact surface of a scene, for comparison with what was reconstructed."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
import numpy as np


def write_truth(scene: bpy.types.Scene, folder: Path) -> None:
    """Write all visible meshes as one triangle soup with the material's pass index per face.

    mesh.npz: vertices (V, 3) float32 in metres (world), faces (F, 3) int32, face_class (F,) int32;
    mesh.ply: the same, binary, with an int property `class_id` per face.
    """
    vertices, faces, classes = surface(scene)
    temporary = folder / "writing.npz"
    np.savez_compressed(temporary, vertices=vertices, faces=faces, face_class=classes)
    os.replace(temporary, folder / "mesh.npz")
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty int class_id\nend_header\n"
    )
    rows = np.zeros(len(faces), np.dtype([("n", "u1"), ("v", "<i4", 3), ("c", "<i4")]))
    rows["n"], rows["v"], rows["c"] = 3, faces, classes
    temporary = folder / "writing.ply"
    temporary.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
    os.replace(temporary, folder / "mesh.ply")


def surface(scene: bpy.types.Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) in the world, triangles (F, 3) and material pass index per triangle (F,) of a scene."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    vertices, faces, classes, first = [], [], [], 0
    for item in depsgraph.object_instances:
        if item.object.type not in {"MESH", "CURVE", "SURFACE", "META", "FONT"} or not item.show_self:
            continue
        mesh = item.object.to_mesh()
        mesh.calc_loop_triangles()
        points = np.empty(len(mesh.vertices) * 3, np.float32)
        mesh.vertices.foreach_get("co", points)
        triangles = np.empty(len(mesh.loop_triangles) * 3, np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles)
        slots = np.empty(len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("material_index", slots)
        indices = np.array([m.pass_index if m else 0 for m in mesh.materials] or [0], np.int32)
        matrix = np.array(item.matrix_world, np.float64)
        vertices.append((points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32))
        faces.append(triangles.reshape(-1, 3) + first)
        classes.append(indices[np.minimum(slots, len(indices) - 1)])
        first += len(mesh.vertices)
        item.object.to_mesh_clear()
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(classes)
