"""Which triangle of a mesh rays meet first, seen from its front; how far away one is."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from .runtime import array, init, launch

MOST_LAYERS = wp.constant(64)  # triangles seen from behind that a ray passes at most
FARTHEST = wp.constant(1.0e30)  # how far a ray goes, in any unit


@wp.kernel(module="fieldwork_raycast")
def cast_kernel(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
    corner: wp.array(dtype=wp.vec2),
    offset: int,
):
    i = wp.tid() + offset
    face[i] = -1
    o = origins[i]
    d = directions[i]
    done = int(0)
    for _ in range(MOST_LAYERS):
        if done == 0:
            query = wp.mesh_query_ray(mesh, o, d, FARTHEST)
            if not query.result:
                done = 1
            elif wp.dot(query.normal, d) < 0.0:
                face[i] = query.face
                corner[i] = wp.vec2(query.u, query.v)
                done = 1
            else:
                o = o + d * (query.t + 1.0e-5 * wp.max(query.t, 1.0))


class FrontFaces:
    """A mesh, vertices (V, 3) and faces (F, 3), that rays are cast against on the host."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        init()
        self._points = torch.from_numpy(np.ascontiguousarray(vertices, np.float32))
        self._corners = torch.from_numpy(np.ascontiguousarray(faces, np.int32)).reshape(-1)
        self._mesh = wp.Mesh(points=array(self._points, wp.vec3), indices=array(self._corners))

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The triangle (N,) int that each ray (N, 3) meets first from its front, −1 where there is none, and where in it
        (N, 2): weights of its first and second corner."""
        if not len(origins):  # Warp takes no empty arrays
            return np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
        o, d = (torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (origins, directions))
        face, corner = torch.empty(len(o), dtype=torch.int32), torch.zeros(len(o), 2)
        inputs = [self._mesh.id, array(o, wp.vec3), array(d, wp.vec3), array(face), array(corner, wp.vec2)]
        launch(cast_kernel, len(o), inputs, o.device)
        return face.numpy(), corner.numpy()


@wp.kernel(module="fieldwork_raycast")
def distance_kernel(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e9)
    distance[i] = 1.0e9
    if query.result:
        distance[i] = query.t


class FirstHits:
    """A mesh, vertices (V, 3) and faces (F, 3), and how far away along rays it is, seen from either side; on the host."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        init()
        self._points = torch.from_numpy(np.ascontiguousarray(vertices, np.float32))
        self._corners = torch.from_numpy(np.ascontiguousarray(faces, np.int32)).reshape(-1)
        self._mesh = wp.Mesh(points=array(self._points, wp.vec3), indices=array(self._corners)) if len(faces) else None

    def distances(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """Distance (N,) of what rays (N, 3) with unit directions meet first, 1e9 where that is nothing; on the host."""
        o, d = origins.detach().cpu().contiguous(), directions.detach().cpu().contiguous()
        found = torch.full((len(o),), 1.0e9)
        if self._mesh is not None and len(o):  # Warp takes no array of no vectors
            launch(
                distance_kernel, len(o), [self._mesh.id, array(o, wp.vec3), array(d, wp.vec3), array(found)], o.device
            )
        return found
