"""Fixed encodings of positions and directions."""

from __future__ import annotations

import torch

from ..kernels.device import on_host
from ..kernels.inputs_host import encode_frequencies


def encoded_positions(points: torch.Tensor, octaves: int, dtype: torch.dtype) -> torch.Tensor:
    """`frequency_encoding` in another dtype."""
    if on_host(points.device) and dtype in (torch.float32, torch.bfloat16) and not points.requires_grad:
        return encode_frequencies(points, octaves, dtype)
    return frequency_encoding(points, octaves).to(dtype)


def frequency_encoding(points: torch.Tensor, octaves: int) -> torch.Tensor:
    """Positions (N, 3) in [0, 1]³ → (N, 3 + 6 · octaves): x, then sin and cos of 2^k π x.

    Source: Mildenhall et al., "NeRF", 2020, eq. 4. Higher octaves follow from the first by the double-angle formulas.
    """
    # One row per coordinate: whole rows are written at once, columns would be written number by number.
    centered = (points * 2 - 1).t().contiguous()
    sine, cosine = torch.sin(torch.pi * centered), torch.cos(torch.pi * centered)
    parts = [centered, sine, cosine]
    for _ in range(octaves - 1):
        sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
        parts += [sine, cosine]
    return torch.cat(parts).t()


def spherical_harmonics(directions: torch.Tensor) -> torch.Tensor:
    """Unit directions (N, 3) → the 16 real spherical harmonics of degree < 4, (N, 16).

    Source: Sloan, "Stupid spherical harmonics tricks", 2008, appendix A2.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479),
            -0.48860251 * y,
            0.48860251 * z,
            -0.48860251 * x,
            1.09254843 * xy,
            -1.09254843 * yz,
            0.31539157 * (3 * zz - 1),
            -1.09254843 * xz,
            0.54627422 * (xx - yy),
            -0.59004359 * y * (3 * xx - yy),
            2.89061144 * xy * z,
            -0.45704580 * y * (5 * zz - 1),
            0.37317633 * z * (5 * zz - 3),
            -0.45704580 * x * (5 * zz - 1),
            1.44530572 * z * (xx - yy),
            -0.59004359 * x * (xx - 3 * yy),
        ],
        -1,
    )
