"""A labelled triangle mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.similarity import similarity_scale, transform_points
from .triangles import areas, cross, unit


@dataclass(frozen=True)
class Surface:
    """A triangle mesh with attributes.

    vertices (V, 3), faces (F, 3), normals (V, 3) unit, outward; colors (V, 3) uint8 sRGB; class_id (V,) and
    face_class (F,) class ids; face_instance (F,) uint32 numbers of instances, 0 for none, None where nobody looked.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    class_id: np.ndarray
    face_class: np.ndarray
    face_instance: np.ndarray | None = None


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3): those of the triangles around a vertex, weighted by their area."""
    each = cross(vertices, faces)
    total = np.stack(
        [sum(np.bincount(faces[:, k], each[:, axis], len(vertices)) for k in range(3)) for axis in range(3)], 1
    )
    return unit(total)


def to_world(surface: Surface, world_from_box: np.ndarray) -> Surface:
    """The surface carried by a similarity (4, 4)."""
    rotation = world_from_box[:3, :3] / similarity_scale(world_from_box)
    return replace(
        surface,
        vertices=transform_points(world_from_box, surface.vertices).astype(np.float32),
        normals=(surface.normals @ rotation.T).astype(np.float32),
    )


def with_faces(surface: Surface, kept: np.ndarray) -> Surface:
    """The triangles (F,) `kept` of a surface, without vertices that none of them has."""
    used, index = np.unique(surface.faces[kept], return_inverse=True)
    return Surface(
        surface.vertices[used],
        index.reshape(-1, 3).astype(np.int32),
        surface.normals[used],
        surface.colors[used],
        surface.class_id[used],
        surface.face_class[kept],
        None if surface.face_instance is None else surface.face_instance[kept],
    )


def class_table(surface: Surface, names: dict[int, str]) -> dict[str, dict[str, float]]:
    """Number of faces and area (world units², to six digits, as a small thing has little of it) of each class on the surface;
    void and a class that is called so are one."""
    area = areas(surface.vertices.astype(np.float64), surface.faces)
    ids: dict[str, list[int]] = {}
    for number in np.unique(surface.face_class).tolist():
        ids.setdefault(names.get(number, str(number)), []).append(number)
    own = {name: np.isin(surface.face_class, some) for name, some in ids.items()}
    return {name: {"faces": int(mask.sum()), "area": float(f"{area[mask].sum():.6g}")} for name, mask in own.items()}


def is_watertight(faces: np.ndarray) -> bool:
    """Whether every edge of the triangles (F, 3) joins exactly two of them."""
    if not len(faces):
        return False
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    _, count = np.unique(edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1], return_counts=True)
    return bool((count == 2).all())
