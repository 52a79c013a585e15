"""Noise taken off a surface, edges kept: normals of neighbouring triangles are averaged where they differ little, then
vertices follow them (Zheng, Fu, Au and Tai, "Bilateral normal filtering for mesh denoising", 2011).

Fused depths leave bumps of a fraction of a cell on what is flat, which turn its normals. It is done after a surface was
simplified: where there are none, triangles become large, and classes have their borders between triangles.
"""

from __future__ import annotations

import numpy as np
import torch

from ..progress import Reporter

DIFFERENCE = 0.35  # of unit normals: beyond it one triangle tells another little, so that edges stay
NORMAL_ROUNDS = 5
VERTEX_ROUNDS = 10
FLAT = 0.5  # of the noise: what normals around a vertex may differ from their mean; thin things would shrink, edges wear off


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
    before = torch.from_numpy(np.asarray(vertices, np.float32)).to(device)
    corner = torch.from_numpy(np.asarray(faces, np.int64)).to(device)
    beside = neighbours(corner)
    normals, noise = _filtered(before, corner, beside, report)
    mean = _around(normals, corner, len(before))
    follow = torch.exp(-2 * (1 - mean.norm(dim=1).clamp(max=1)) / max(FLAT * noise, 1e-6) ** 2)
    if free is not None:
        follow *= torch.from_numpy(free.astype(np.float32)).to(device)
    for number, ends in enumerate(([0, 1], [1, 2], [2, 0])):
        is_open = beside[:, number] == torch.arange(len(corner), device=device)
        follow[corner[is_open][:, ends].reshape(-1)] = 0
    after = _moved(before, corner, normals, follow, report)
    old, new = _normals(before, corner), _normals(after, corner)
    follow[corner[(old * new).sum(1) < 0].reshape(-1)] = 0  # what would be turned over
    place = torch.where(follow[:, None] > 0, after, before)
    return place.cpu().double().numpy()


def _moved(
    place: torch.Tensor, corner: torch.Tensor, normals: torch.Tensor, follow: torch.Tensor, report: Reporter
) -> torch.Tensor:
    """Vertices (V, 3) moved by the share `follow` (V,) towards the planes with `normals` (F, 3) through the middles of their
    triangles."""
    for _ in range(VERTEX_ROUNDS):
        report.check()
        corners = place[corner]
        off = corners.mean(1, keepdim=True) - corners
        step = normals[:, None] * (normals[:, None] * off).sum(2, keepdim=True)
        place = place + follow[:, None] * _around(step, corner, len(place))
    return place


def _around(values: torch.Tensor, corner: torch.Tensor, count: int) -> torch.Tensor:
    """The mean (count, 3) for each vertex of values (F, 3) of triangles, or (F, 3, 3) of their corners."""
    each = values.reshape(-1, 3) if values.dim() == 3 else values.repeat_interleave(3, 0)
    flat = corner.reshape(-1)
    amount = torch.zeros(count, device=each.device).index_add_(0, flat, torch.ones(len(flat), device=each.device))
    total = torch.zeros(count, 3, device=each.device).index_add_(0, flat, each)
    return total / amount.clamp(min=1)[:, None]


def _normals(place: torch.Tensor, corner: torch.Tensor) -> torch.Tensor:
    """Normals (F, 3) of triangles, twice their area long."""
    a, b, c = place[corner].unbind(1)
    return torch.linalg.cross(b - a, c - a)


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


def _filtered(
    place: torch.Tensor, corner: torch.Tensor, beside: torch.Tensor, report: Reporter
) -> tuple[torch.Tensor, float]:
    """Unit normals (F, 3), each the mean of its own and those of its neighbours `beside` (F, 3), by their area and by how
    little they differ from it; and their noise, the median difference of neighbours before."""
    normals = _normals(place, corner)
    area = normals.norm(dim=1, keepdim=True)
    normals = normals / area.clamp(min=1e-30)
    other = beside != torch.arange(len(corner), device=corner.device)[:, None]
    differ = (normals[beside] - normals[:, None]).norm(dim=2)[other]
    noise = float(differ.median()) if len(differ) else 0.0
    weight = area[:, 0][beside] * other
    for _ in range(NORMAL_ROUNDS):
        report.check()
        around = normals[beside]
        alike = torch.exp(-((around - normals[:, None]) ** 2).sum(2) / (2 * DIFFERENCE**2))
        total = normals * area + ((weight * alike)[:, :, None] * around).sum(1)
        normals = total / total.norm(dim=1, keepdim=True).clamp(min=1e-30)
    return normals, noise
