"""Triangles on a grid of pixels: what a camera sees of a mesh, and which texels a triangle of a UV map covers."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from .runtime import array, init, launch


@wp.func
def edge_side(a: wp.vec2, b: wp.vec2, p: wp.vec2):
    """Twice the signed area of the triangle a, b, p."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])


@wp.kernel(module="fieldwork_triangles")
def nearest_triangles(
    pixels: wp.array(dtype=wp.vec2),
    depth: wp.array(dtype=float),
    faces: wp.array2d(dtype=int),
    widest: float,
    width: int,
    height: int,
    nearest: wp.array(dtype=wp.int64),
    offset: int,
):
    i = wp.tid() + offset
    a = pixels[faces[i, 0]]
    b = pixels[faces[i, 1]]
    c = pixels[faces[i, 2]]
    near = wp.min(depth[faces[i, 0]], wp.min(depth[faces[i, 1]], depth[faces[i, 2]]))
    min_x = wp.min(a[0], wp.min(b[0], c[0]))
    max_x = wp.max(a[0], wp.max(b[0], c[0]))
    min_y = wp.min(a[1], wp.min(b[1], c[1]))
    max_y = wp.max(a[1], wp.max(b[1], c[1]))
    area = edge_side(a, b, c)
    # Comparisons with what is not a number are false.
    if (
        near > 0.0
        and wp.abs(area) > 1.0e-12
        and max_x > 0.0
        and max_y > 0.0
        and min_x < float(width)
        and min_y < float(height)
        and max_x - min_x < widest
    ):
        low_x = int(wp.floor(wp.max(min_x, 0.0)))
        low_y = int(wp.floor(wp.max(min_y, 0.0)))
        high_x = wp.min(int(wp.ceil(wp.min(max_x, float(width)))) + 1, width)
        high_y = wp.min(int(wp.ceil(wp.min(max_y, float(height)))) + 1, height)
        inverse_a = 1.0 / depth[faces[i, 0]]
        inverse_b = 1.0 / depth[faces[i, 1]]
        inverse_c = 1.0 / depth[faces[i, 2]]
        for y in range(low_y, high_y):
            for x in range(low_x, high_x):
                p = wp.vec2(float(x) + 0.5, float(y) + 0.5)
                v = edge_side(c, a, p) / area
                w = edge_side(a, b, p) / area
                if v >= -1.0e-5 and w >= -1.0e-5 and v + w <= 1.00001:
                    value = (1.0 - v - w) * inverse_a + v * inverse_b + w * inverse_c
                    # Positive floats are ordered as their bits are; the triangle's number rides in the lower half.
                    key = (wp.int64(wp.cast(value, wp.int32)) << wp.int64(32)) | wp.int64(i)
                    wp.atomic_max(nearest, y * width + x, key)


@wp.kernel(module="fieldwork_triangles")
def covered_texels(
    corners: wp.array2d(dtype=wp.vec2),
    first: wp.array(dtype=wp.int64),
    left: int,
    top: int,
    width: int,
    height: int,
    write: int,
    count: wp.array(dtype=int),
    texel: wp.array(dtype=int),
    barycentric: wp.array(dtype=wp.vec2),
    offset: int,
):
    i = wp.tid() + offset
    a = corners[i, 0]
    b = corners[i, 1]
    c = corners[i, 2]
    area = edge_side(a, b, c)
    number = int(0)
    if wp.abs(area) > 1.0e-9:
        low_x = wp.max(int(wp.floor(wp.min(a[0], wp.min(b[0], c[0])) - 0.5)), left)
        low_y = wp.max(int(wp.floor(wp.min(a[1], wp.min(b[1], c[1])) - 0.5)), top)
        high_x = wp.min(int(wp.ceil(wp.max(a[0], wp.max(b[0], c[0])) - 0.5)) + 1, left + width)
        high_y = wp.min(int(wp.ceil(wp.max(a[1], wp.max(b[1], c[1])) - 0.5)) + 1, top + height)
        for y in range(low_y, high_y):
            for x in range(low_x, high_x):
                p = wp.vec2(float(x) + 0.5, float(y) + 0.5)
                v = edge_side(c, a, p) / area
                w = edge_side(a, b, p) / area
                if v >= -1.0e-5 and w >= -1.0e-5 and v + w <= 1.00001:
                    if write != 0:
                        place = int(first[i]) + number
                        texel[place] = (y - top) * width + x - left
                        barycentric[place] = wp.vec2(v, w)
                    number += 1
    count[i] = number


def _on(values: np.ndarray, device: torch.device) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)


def nearest_triangle(
    pixels: np.ndarray,
    depth: np.ndarray,
    faces: np.ndarray,
    width: int,
    height: int,
    device: torch.device,
    widest: float = 1e9,
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of projected triangles at every pixel centre.

    Args:
        pixels: (V, 2) x, y of the vertices; depth: (V,) along the viewing axis, its inverse is linear on the picture;
            faces: (F, 3). Triangles with a vertex that is not finite, or not in front, are left out.
        widest: triangles at least that many pixels wide are left out too.
    Returns:
        triangle (height, width) int32, −1 where there is none; depth (height, width) float32, inf there.
    """
    init()
    nearest = torch.zeros(width * height, dtype=torch.int64, device=device)
    indices = torch.from_numpy(np.ascontiguousarray(faces, np.int32)).to(device)
    inputs = [array(_on(pixels, device), wp.vec2), array(_on(depth, device)), array(indices)]
    # Triangles share pixels, and Warp's atomics on a CPU are plain reads and writes.
    launch(nearest_triangles, len(faces), [*inputs, widest, width, height, array(nearest)], device, serial=True)
    keys = nearest.cpu().numpy().reshape(height, width)
    found = keys > 0
    inverse = (keys >> 32).astype(np.int32).view(np.float32)
    with np.errstate(divide="ignore"):
        return np.where(found, keys & 0xFFFFFFFF, -1).astype(np.int32), np.where(found, 1 / inverse, np.inf)


def triangle_texels(
    corners: np.ndarray, left: int, top: int, width: int, height: int, device: torch.device
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Texels of a tile whose centres lie in triangles; two triangles may share one on their common edge.

    Args:
        corners: (F, 3, 2) x, y of the corners in texels of the whole picture, y downwards.
        left, top, width, height: the tile.
    Returns:
        first (F + 1,) int64: triangle f has the places first[f] … first[f + 1]; texel (N,) int32: y · width + x within
        the tile; barycentric (N, 2) float32: weights of corners 1 and 2.
    """
    init()
    where = _on(corners, device)
    total = len(where)
    count = torch.zeros(total, dtype=torch.int32, device=device)
    first = torch.zeros(total + 1, dtype=torch.int64, device=device)

    def run(write: int, texel: torch.Tensor, weights: torch.Tensor) -> None:
        tile = [left, top, width, height]
        outputs = [array(count), array(texel), array(weights, wp.vec2)]
        launch(covered_texels, total, [array(where, wp.vec2), array(first), *tile, write, *outputs], device)

    run(0, torch.zeros(1, dtype=torch.int32, device=device), torch.zeros((1, 2), device=device))
    first[1:] = count.cumsum(0)
    found = int(first[-1])
    texel = torch.zeros(max(found, 1), dtype=torch.int32, device=device)
    weights = torch.zeros((max(found, 1), 2), device=device)
    run(1, texel, weights)
    return first.cpu().numpy(), texel[:found].cpu().numpy(), weights[:found].cpu().numpy()
