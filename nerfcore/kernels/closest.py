"""The points of a mesh that are closest to given ones."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from .runtime import array, init, launch

FARTHEST = wp.constant(
    1.0e18
)  # distance up to which triangles are looked for; its square is a number of single precision


@wp.kernel(module="fieldwork_closest")
def closest_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
    corner: wp.array(dtype=wp.vec2),
    distance: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    query = wp.mesh_query_point_no_sign(mesh, points[i], FARTHEST)
    if query.result:
        face[i] = query.face
        corner[i] = wp.vec2(query.u, query.v)
        distance[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


class ClosestPoints:
    """A mesh, vertices (V, 3) and faces (F, 3), that is asked on the host."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        init()
        self._points = torch.from_numpy(np.ascontiguousarray(vertices, np.float32))
        self._corners = torch.from_numpy(np.ascontiguousarray(faces, np.int32)).reshape(-1)
        self._mesh = wp.Mesh(points=array(self._points, wp.vec3), indices=array(self._corners))

    def find(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For points (N, 3): the triangle (N,) that is closest, the weights (N, 3) of its corners at the closest point, and
        the distance (N,) to that."""
        if not len(points):  # Warp takes no empty arrays
            return np.zeros(0, np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        asked = torch.from_numpy(np.ascontiguousarray(points, np.float32))
        face, corner = torch.zeros(len(asked), dtype=torch.int32), torch.zeros(len(asked), 2)
        distance = torch.full((len(asked),), torch.inf)
        inputs = [self._mesh.id, array(asked, wp.vec3), array(face), array(corner, wp.vec2), array(distance)]
        launch(closest_kernel, len(asked), inputs, asked.device)
        weights = torch.cat([corner, 1 - corner.sum(1, keepdim=True)], 1)
        return face.numpy(), weights.numpy(), distance.numpy()
