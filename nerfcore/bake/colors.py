"""What a baked field shows at its vertices: colours as the training cameras see them, and classes."""

from __future__ import annotations

from functools import partial

import torch

from ..field.encoding import spherical_harmonics
from ..field.hybrid import Geometry
from ..geometry.contraction import uncontract
from ..kernels.runtime import run_parallel
from ..kernels.voxel_field import AXES, TEXELS, VERTICES, VIEWS
from ..render.model import Model
from .blocks import CHUNK, CHUNK_BLOCKS, Blocks, Check, vertex_points, weights_and_cameras

HARMONIC_RANGE = 0.5  # largest change of a colour with the direction that is stored
DAMPING = 0.003  # of that change, against the mean colour


@torch.no_grad()
def vertex_texels(
    model: Model, blocks: Blocks, views: torch.Tensor, centers: torch.Tensor, check: Check
) -> tuple[torch.Tensor, torch.Tensor]:
    """Texels (S · 9³, 2, 4) uint8 of the vertices of blocks and their changes (S · 5³, 3, 4) uint8, as `VoxelField`
    describes them.

    Args:
        views: (S · 9³, VIEWS) which cameras see them (`blocks.seen_by`); vertices that none does look as the camera sees
            them that sees most of their block.
        centers: (C, 3) camera centres in the normalised frame.
    """
    device = blocks.roots.device
    texels = torch.full((len(blocks.roots), TEXELS, 4), 128, dtype=torch.uint8, device=device)
    texels[:, 0, 3] = blocks.roots
    texels[:, 1] = torch.tensor([0, 255, 0, 0], dtype=torch.uint8, device=device)
    slopes = torch.full((len(blocks.roots), AXES, 3), 128, dtype=torch.uint8, device=device)
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
        colors = _colors(model, geometry, there, codes, centers)
        texels[rows, 0, :3], slopes[rows] = colors[:, 0], colors[:, 1:]
        if model.field.classes:
            texels[rows, 1, :3] = _classes(model.field.class_probabilities(geometry))

    run_parallel([partial(read, rows) for rows in used.split(CHUNK)], device)
    known = torch.zeros(len(slopes), dtype=torch.bool, device=device)
    known[used] = True
    per_block = zip(slopes.split(CHUNK_BLOCKS * VERTICES**3), known.split(CHUNK_BLOCKS * VERTICES**3))
    changes = [_coarse(some, mask) for some, mask in per_block]
    return texels, torch.cat(changes) if changes else slopes.new_zeros(0, AXES, 4)


def _coarse(slopes: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Changes (S · 5³, 3, 4) uint8 of every second vertex: the mean of those (S · 9³, 3, 3) of the vertices around it that
    are `known` (S · 9³,)."""
    blocks = len(known) // VERTICES**3
    weight = known.float().view(blocks, 1, VERTICES, VERTICES, VERTICES)
    values = slopes.view(blocks, VERTICES, VERTICES, VERTICES, AXES * 3).permute(0, 4, 1, 2, 3).float() - 127.5
    pooled = torch.nn.functional.avg_pool3d(torch.cat([values * weight, weight], 1), 3, 2, 1)
    mean = 127.5 + pooled[:, :-1] / pooled[:, -1:].clamp(min=1e-6)
    rgb = mean.permute(0, 2, 3, 4, 1).reshape(-1, AXES, 3).round().to(torch.uint8)
    return torch.nn.functional.pad(rgb, (0, 1), value=0)


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
    """Most probable class, its probability, and second class (N, 3) uint8 of probabilities (N, K); an only class is its own
    second."""
    value, number = probabilities.topk(min(2, probabilities.shape[1]), 1)
    return torch.stack([number[:, 0], stored_shares(value[:, 0]), number[:, -1]], 1).to(torch.uint8)


def stored_shares(probabilities: torch.Tensor) -> torch.Tensor:
    """Bytes (N,) of the probabilities of the most probable classes: a half at least, for the second class has all the rest."""
    return (probabilities.clamp(min=0.5) * 255).ceil().long()
