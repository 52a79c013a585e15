"""The surfaces of all blocks as one: vertices at the seams joined, scraps and small holes as in a mesh of one piece."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ..mesh.clean import SCRAP
from ..mesh.holes import fill_holes
from ..mesh.surface import Surface, vertex_normals
from ..mesh.triangles import areas, border_edges, components
from .surface import Part

SAME = 1e-3  # voxels that vertices of two blocks at a seam differ by at most
ON_SEAM = 1e-2  # voxels
LONGEST_LOOP = 30  # edges of a hole that is filled


def joined(parts: Sequence[Part]) -> tuple[Surface, np.ndarray]:
    """One surface of the parts of all blocks, which share a frame, and which triangles (F,) bool of it fill small holes. A vertex
    at a seam takes its class from the faces around it, of both sides, by their area."""
    surfaces = [part.surface for part in parts]
    counts = np.cumsum([0, *[len(s.vertices) for s in surfaces]])
    faces = np.concatenate([s.faces.astype(np.int64) + before for s, before in zip(surfaces, counts)])
    vertices = np.concatenate([s.vertices for s in surfaces]).astype(np.float64)
    colors, class_id = (np.concatenate([getattr(s, name) for s in surfaces]) for name in ("colors", "class_id"))
    face_class = np.concatenate([s.face_class for s in surfaces])
    same = _same(vertices, faces, np.repeat(np.arange(len(parts)), np.diff(counts)), SAME * parts[0].voxel)
    _, first, index = np.unique(same, return_index=True, return_inverse=True)
    welded = np.flatnonzero(np.bincount(index) > 1)
    vertices, colors, class_id, faces = vertices[first], colors[first], class_id[first].copy(), index[faces]
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    faces, face_class = faces[proper], face_class[proper]
    class_id[welded] = _by_area(vertices, faces, face_class)[welded]
    part = components(faces, len(vertices))
    area = np.bincount(part, areas(vertices, faces))
    kept = area[part] >= SCRAP * area.sum()
    return _filled(vertices, faces[kept], colors, class_id, face_class[kept])


def open_at_seams(surface: Surface, parts: Sequence[Part]) -> int:
    """Number of edges in the planes between blocks that have a triangle on one side only: as many as a mesh in one piece
    has there, whose holes end at such planes now and then; more would be a gap."""
    border = border_edges(surface.faces)
    slack = ON_SEAM * parts[0].voxel
    found = np.zeros(len(border), bool)
    for axis, place in {tuple(plane) for part in parts for plane in part.seams.tolist()}:
        near = np.abs(surface.vertices[:, int(axis)] - place) < slack
        found |= near[border].all(1)
    return int(found.sum())


def _same(vertices: np.ndarray, faces: np.ndarray, block: np.ndarray, distance: float) -> np.ndarray:
    """For each vertex the number of the place it is at: vertices of different blocks at their borders, nearer to each
    other than `distance`, are at one."""
    border = np.unique(border_edges(faces))
    pairs = (
        scipy.spatial.KDTree(vertices[border]).query_pairs(distance, output_type="ndarray")
        if len(border)
        else np.zeros((0, 2), int)
    )
    a, b = border[pairs[:, 0]], border[pairs[:, 1]]
    other = block[a] != block[b]
    ones = np.ones(int(other.sum()), bool)
    graph = scipy.sparse.coo_matrix((ones, (a[other], b[other])), (len(vertices), len(vertices)))
    return scipy.sparse.csgraph.connected_components(graph, False)[1]


def _by_area(vertices: np.ndarray, faces: np.ndarray, face_class: np.ndarray) -> np.ndarray:
    """The class (V,) that most of the area around each vertex has."""
    ids, number = np.unique(face_class, return_inverse=True)
    area, mass = areas(vertices, faces), np.zeros((len(ids), len(vertices)))
    for corner in range(3):
        np.add.at(mass, (number, faces[:, corner]), area)
    return ids[mass.argmax(0)]


def _filled(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, class_id: np.ndarray, face_class: np.ndarray
) -> tuple[Surface, np.ndarray]:
    """The surface with its small holes filled, without vertices that no triangle has, and which triangles (F,) bool are new."""
    before = len(vertices)
    vertices, all_faces, new = fill_holes(vertices, faces, LONGEST_LOOP)
    if len(vertices) > before:  # as the closest of their rims
        rim = np.unique(all_faces[new])
        rim = rim[rim < before]
        nearest = rim[scipy.spatial.KDTree(vertices[rim]).query(vertices[before:])[1]]
        colors, class_id = np.append(colors, colors[nearest], 0), np.append(class_id, class_id[nearest])
    face_class = np.append(face_class, class_id[all_faces[new].min(1)])
    used, index = np.unique(all_faces, return_inverse=True)
    vertices, index = vertices[used], index.reshape(-1, 3)
    surface = Surface(
        vertices.astype(np.float32),
        index.astype(np.int32),
        vertex_normals(vertices, index).astype(np.float32),
        colors[used],
        class_id[used],
        face_class,
    )
    return surface, new
