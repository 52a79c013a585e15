"""Noise taken off a surface, edges kept: normals of neighbouring triangles are averaged where they differ little, then
vertices follow them (Zheng, Fu, Au and Tai, "Bilateral normal filtering for mesh denoising", 2011).

Fused depths leave bumps of a fraction of a cell on what is flat. They turn normals, cost triangles when the surface is
simplified, and shade what is plain.
"""

from __future__ import annotations

import numpy as np
import torch

from ..progress import Reporter

DIFFERENCE = 0.45  # of unit normals: beyond it one triangle tells another little, so that edges stay
NORMAL_ROUNDS = 20
VERTEX_ROUNDS = 30


def denoised(
    vertices: np.ndarray,
    faces: np.ndarray,
    device: torch.device,
    report: Reporter,
    free: np.ndarray | None = None,
) -> np.ndarray:
    """Vertices (V, 3) float64 of triangles (F, 3) without noise, computed on `device`. Those of open borders stay where they
    are, and others move by the share `free` (V,) of the way, 1 where nothing is given.
    """
    place = torch.from_numpy(np.asarray(vertices, np.float32)).to(device)
    corner = torch.from_numpy(np.asarray(faces, np.int64)).to(device)
    beside = neighbours(corner)
    normals = _filtered(place, corner, beside, report)
    flat = corner.reshape(-1)
    follow = (
        torch.ones(len(place), device=device) if free is None else torch.from_numpy(free.astype(np.float32)).to(device)
    )
    open_edge = beside == torch.arange(len(corner), device=device)[:, None]
    for first, second in ((0, 1), (1, 2), (2, 0)):
        follow[corner[open_edge[:, first]][:, [first, second]].reshape(-1)] = 0
    amount = torch.zeros(len(place), device=device).index_add_(0, flat, torch.ones(len(flat), device=device))
    share = (follow / amount.clamp(min=1))[:, None]
    for _ in range(VERTEX_ROUNDS):
        report.check()
        corners = place[corner]
        off = corners.mean(1, keepdim=True) - corners
        step = normals[:, None] * (normals[:, None] * off).sum(2, keepdim=True)
        place = place + share * torch.zeros_like(place).index_add_(0, flat, step.reshape(-1, 3))
    return place.double().cpu().numpy()


def neighbours(corner: torch.Tensor) -> torch.Tensor:
    """For each triangle (F, 3) the ones beyond its edges from corner 0 to 1, 1 to 2 and 2 to 0: (F, 3); itself where there is
    none, or where an edge has more than two triangles."""
    count = len(corner)
    own = torch.arange(count, device=corner.device)
    edges = torch.cat([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]]).sort(1).values
    key, order = (edges[:, 0] * (int(corner.max()) + 1 if count else 1) + edges[:, 1]).sort(stable=True)
    same = key[1:] == key[:-1]
    none = same.new_zeros(1)
    before, after = torch.cat([none, same]), torch.cat([same, none])  # whether the edge before or after is the same one
    two = after & ~before & ~torch.cat([after[1:], none])
    first = torch.nonzero(two)[:, 0]
    beside = own.repeat(3)
    beside[order[first]], beside[order[first + 1]] = order[first + 1] % count, order[first] % count
    return beside.reshape(3, count).T.contiguous()


def _filtered(place: torch.Tensor, corner: torch.Tensor, beside: torch.Tensor, report: Reporter) -> torch.Tensor:
    """Unit normals (F, 3), each the mean of its own and those of its neighbours `beside` (F, 3), by their area and by how
    little they differ from it."""
    a, b, c = place[corner].unbind(1)
    normals = torch.linalg.cross(b - a, c - a)
    area = normals.norm(dim=1, keepdim=True)
    normals = normals / area.clamp(min=1e-30)
    other = beside != torch.arange(len(corner), device=corner.device)[:, None]
    weight = area[:, 0][beside] * other
    for _ in range(NORMAL_ROUNDS):
        report.check()
        around = normals[beside]
        alike = torch.exp(-((around - normals[:, None]) ** 2).sum(2) / (2 * DIFFERENCE**2))
        total = normals * area + ((weight * alike)[:, :, None] * around).sum(1)
        normals = total / total.norm(dim=1, keepdim=True).clamp(min=1e-30)
    return normals
