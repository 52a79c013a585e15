"""What a baked field shows at its vertices: colours as the training cameras see them, and classes."""

from __future__ import annotations

from functools import partial

import torch

from ..field.encoding import spherical_harmonics
from ..field.hybrid import Geometry
from ..geometry.contraction import uncontract
from ..kernels.runtime import run_parallel
from ..kernels.voxel_field import VERTICES, VIEWS
from ..render.model import Model
from .blocks import CHUNK, Blocks, Check, vertex_points, weights_and_cameras

HARMONIC_RANGE = 0.5  # largest change of a colour with the direction that is stored
DAMPING = 0.003  # of that change, against the mean colour


@torch.no_grad()
def vertex_texels(
    model: Model, blocks: Blocks, views: torch.Tensor, centers: torch.Tensor, check: Check
) -> torch.Tensor:
    """Texels (S · 9³, 4, 4) uint8 of the vertices of blocks, as `VoxelField` describes them.

    Args:
        views: (S · 9³, VIEWS) which cameras see them (`blocks.seen_by`); vertices that none does look as the camera sees
            them that sees most of their block.
        centers: (C, 3) camera centres in the normalised frame.
    """
    device = blocks.roots.device
    texels = torch.full((len(blocks.roots), 4, 4), 128, dtype=torch.uint8, device=device)
    texels[:, 0, 3] = blocks.roots
    texels[:, 1:, 3] = torch.tensor([0, 255, 0], dtype=torch.uint8, device=device)
    best = views.view(-1, VERTICES**3 * VIEWS).amax(1).repeat_interleave(VERTICES**3)
    points = vertex_points(blocks.places, blocks.side)
    seen = (views > 0).any(1)
    used = (seen | (blocks.roots > 0)).nonzero()[:, 0]

    @torch.no_grad()
    def read(rows: torch.Tensor) -> None:
        check()
        codes = views[rows].clone()
        codes[:, 0] = torch.where(seen[rows], codes[:, 0], best[rows])
        there = points[rows].contiguous()
        geometry = model.field.geometry(there)
        texels[rows, :, :3] = _colors(model, geometry, there, codes, centers)
        if model.field.classes:
            texels[rows, 1:, 3] = _classes(model.field.class_probabilities(geometry))

    run_parallel([partial(read, rows) for rows in used.split(CHUNK)], device)
    return texels


def _colors(
    model: Model, geometry: Geometry, points: torch.Tensor, codes: torch.Tensor, centers: torch.Tensor
) -> torch.Tensor:
    """Base colour and its changes with x, y and z (N, 4, 3) uint8, fitted to what the cameras see of N points."""
    weights, cameras = weights_and_cameras(codes)
    places = uncontract(points) if model.contracted else points * 2 - 1
    basis, colors = [], []
    for column in range(codes.shape[1]):
        d = torch.nn.functional.normalize(places - centers[cameras[:, column].long()], dim=1)
        basis.append(torch.cat([torch.ones_like(d[:, :1]), d], 1))
        colors.append(model.field.color(geometry, spherical_harmonics(d)))
    b, c, w = torch.stack(basis, 1), torch.stack(colors, 1), weights[..., None]
    w = w / w.sum(1, keepdim=True).clamp(min=1e-9) + 1e-6
    mean = (w * c).sum(1, keepdim=True) / w.sum(1, keepdim=True)
    normal = (w * b).transpose(1, 2) @ b
    normal += torch.diag(torch.tensor([1e-3, *[DAMPING] * 3], device=points.device))
    found = torch.linalg.solve(normal, (w * b).transpose(1, 2) @ (c - mean))
    base = ((found[:, :1] + mean) * 255).round()
    slope = (found[:, 1:] / HARMONIC_RANGE * 127.5 + 127.5).round()
    return torch.cat([base, slope], 1).clamp(0, 255).to(torch.uint8)


def _classes(probabilities: torch.Tensor) -> torch.Tensor:
    """Most probable class, its probability and second class (N, 3) uint8 of probabilities (N, K).

    The second class stands for all others: a probability below one half is stored as one half, or it would win.
    """
    if probabilities.shape[1] == 1:
        probabilities = torch.nn.functional.pad(probabilities, (0, 1))
    value, number = probabilities.topk(2, 1)
    share = (value[:, 0].clamp(min=0.5) * 255).ceil()
    return torch.stack([number[:, 0].float(), share, number[:, 1].float()], 1).to(torch.uint8)
