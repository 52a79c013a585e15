"""What a trained field holds at points: density on a regular grid, colours and class probabilities at surfaces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..field.encoding import spherical_harmonics
from ..geometry.contraction import grid_position
from ..progress import Reporter
from ..render.model import Model

CHUNK = 1 << 16
SAMPLES = 9  # of the short ray through a surface point
BEFORE, BEHIND = 1.5, 2.5  # where it begins and ends, in voxels


@torch.no_grad()
def density_volume(
    model: Model, resolution: int, low: np.ndarray, high: np.ndarray, report: Reporter
) -> tuple[np.ndarray, float]:
    """Density at the nodes of a regular grid between two corners of the normalised cube.

    Closed cells of the occupancy grid count as empty and are not evaluated.

    Returns:
        (x, y, z) volume and the spacing; the longest side has `resolution` cells.
    """
    device = model.priorities.device
    spacing = float((high - low).max()) / resolution
    counts = np.maximum(np.ceil((high - low) / spacing).astype(int) + 1, 2)
    axes = [torch.arange(n, device=device, dtype=torch.float32) * spacing + float(a) for n, a in zip(counts, low)]
    n = model.occupancy.config.resolution
    # An open cell opens its neighbours: the surface may lie on its border.
    opened = model.occupancy.cells[:, 0].view(1, 1, n, n, n) > 0
    opened = torch.nn.functional.max_pool3d(opened.float(), 3, 1, 1).reshape(-1) > 0
    volume = np.zeros(counts, np.float32)
    for index, x in enumerate(axes[0]):
        report.progress(index / counts[0])
        yz = torch.stack(torch.meshgrid(axes[1], axes[2], indexing="ij"), -1).reshape(-1, 2)
        points = torch.cat([torch.full_like(yz[:, :1], float(x)), yz], 1)
        u = grid_position(points, model.contracted).clamp(0, 1)
        cell = (u * n).long().clamp(max=n - 1)
        inside = opened[(cell[:, 2] * n + cell[:, 1]) * n + cell[:, 0]].nonzero()[:, 0]
        plane = torch.zeros(len(points), device=device)
        for part in inside.split(CHUNK):
            plane[part] = model.field.density(u[part].contiguous())
        volume[index] = plane.view(counts[1], counts[2]).cpu().numpy()
    return volume, spacing


def surface_level(spacing: float) -> float:
    """Density at which a stretch of two cells is half opaque: ln 2 / (2 · spacing)."""
    return float(np.log(2) / (2 * spacing))


@torch.no_grad()
def shade(
    model: Model,
    points: np.ndarray,
    normals: np.ndarray,
    semantics: bool,
    spacing: float,
    progress: Callable[[float], None],
) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour (V, 3) float32 in [0, 1] and class probabilities (V, K), None unless `semantics`, of surface points (V, 3)
    of the normalised frame with normals (V, 3).

    A point is seen from outside along its normal: the values are those of a short ray through the surface, so that
    they are the ones a camera would see.
    """
    device = model.priorities.device
    where = torch.from_numpy(np.array(points, np.float32)).to(device)
    outward = torch.from_numpy(np.array(normals, np.float32)).to(device)
    colors, classes = [], []
    offsets = torch.linspace(BEFORE, -BEHIND, SAMPLES, device=device) * spacing
    step = float(offsets[0] - offsets[1])
    for index, (p, n) in enumerate(zip(where.split(CHUNK // 8), outward.split(CHUNK // 8))):
        progress(min(index * CHUNK / 8 / max(len(where), 1), 1.0))
        places = p[:, None] + n[:, None] * offsets[:, None]
        u = grid_position(places.reshape(-1, 3), model.contracted).clamp(0, 1).contiguous()
        geometry = model.field.geometry(u)
        alpha = 1 - torch.exp(-geometry.density.view(len(p), -1) * step)
        before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1]], 1), 1)
        weight = alpha * before + 1e-6
        weight = (weight / weight.sum(1, keepdim=True))[..., None]
        facing = spherical_harmonics(-n).repeat_interleave(len(offsets), 0)
        color = model.field.color(geometry, facing).view(len(p), -1, 3)
        colors.append((color * weight).sum(1).cpu())
        if semantics:
            probabilities = model.field.class_probabilities(geometry).view(len(p), len(offsets), -1)
            classes.append((probabilities * weight).sum(1).cpu())
    rgb = torch.cat(colors).clamp(0, 1).numpy() if colors else np.zeros((0, 3), np.float32)
    return rgb, torch.cat(classes).numpy() if classes else None
