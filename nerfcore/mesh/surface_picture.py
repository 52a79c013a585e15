"""Pictures of a textured mesh from a camera: what the surface is worth beside photos, and how it looks from outside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..images.picture import linear_to_srgb, to_bytes
from .facelets import small_pieces
from .photos import LINEAR, halvings, sample
from .visibility import PosedCamera, depth_buffer


class TexturedMesh:
    """A mesh (V, 3), (F, 3) whose colours are looked up in its texture (S, S, 3) uint8 sRGB by the UV (F, 3, 2) of its
    faces' corners, v upwards."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray, texture: np.ndarray) -> None:
        self._corners, self._size = corners, texture.shape[0]
        a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
        surface = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        u, v = ((corners[:, k] - corners[:, 0]).astype(np.float64) * self._size for k in (1, 2))
        self._texel = np.sqrt(surface / np.maximum(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), 1e-9))
        self._levels = halvings(torch.from_numpy(LINEAR[texture].transpose(2, 0, 1)), 6)

    def light(self, face: np.ndarray, weights: np.ndarray, footprint: np.ndarray) -> torch.Tensor:
        """Linear colours (N, 3) at places of faces (N,) with weights (N, 3) of their corners, each the mean over about as
        much as a pixel shows: footprint (N,), its width in units of the mesh."""
        uv = np.einsum("nk,nkc->nc", weights, self._corners[face].astype(np.float64))
        wide = footprint / np.maximum(self._texel[face], 1e-12)
        level = np.round(np.log2(np.maximum(wide, 1))).astype(int)
        return sample(self._levels, uv * [self._size, -self._size] + [0, self._size], level)


def surface_picture(
    view: PosedCamera,
    vertices: np.ndarray,
    faces: np.ndarray,
    corners: np.ndarray,
    texture: np.ndarray,
    samples: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh with its texture as a camera sees it, without any light but the texture's own.

    Args:
        vertices (V, 3), faces (F, 3), corners (F, 3, 2): UV in [0, 1], v upwards; texture: (S, S, 3) uint8 sRGB.
        samples: a pixel is the mean, in linear light, of samples² rays.
    Returns:
        (H, W, 3) uint8, black where there is no surface, and (H, W) float32: share of the pixel that hits the surface.
    """
    width, height = view.camera.width, view.camera.height
    pieces = small_pieces(vertices, faces, corners)
    assert pieces.corners is not None
    vertices, faces, corners = pieces.vertices, pieces.faces, pieces.corners
    fine = replace(view, camera=view.camera.resized(width * samples, height * samples))
    buffer = depth_buffer(fine, vertices, faces)
    rows, columns = np.nonzero(buffer.face >= 0)
    face = buffer.face[rows, columns]
    weights = _place(fine, vertices[faces[face]], np.stack([columns + 0.5, rows + 0.5], 1))
    color = torch.zeros((height * samples, width * samples, 3))
    shown = TexturedMesh(vertices, faces, corners, texture)
    color[rows, columns] = shown.light(face, weights, fine.footprint(buffer.depth[rows, columns]))
    hit = torch.from_numpy((buffer.face >= 0).astype(np.float32))
    share = hit.view(height, samples, width, samples).mean((1, 3))
    mean = color.view(height, samples, width, samples, 3).mean((1, 3)) / share.clamp(min=1e-6)[..., None]
    return to_bytes(linear_to_srgb(mean.numpy())), share.numpy()


def _place(view: PosedCamera, triangles: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of the corners of triangles (N, 3, 3) at the pixels (N, 2) that show them, true to perspective."""
    local = view.local(triangles.reshape(-1, 3))
    corner, depth = view.pixels(local).reshape(-1, 3, 2), view.depth(local).reshape(-1, 3)
    ab, ac, p = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], pixels - corner[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    second = (p[:, 0] * ac[:, 1] - p[:, 1] * ac[:, 0]) / area
    third = (ab[:, 0] * p[:, 1] - ab[:, 1] * p[:, 0]) / area
    weights = np.stack([1 - second - third, second, third], 1) / depth
    return weights / weights.sum(1, keepdims=True)
