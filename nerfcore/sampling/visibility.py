"""Which cells of the field's domain are in how many cameras' view (no occlusion)."""

from __future__ import annotations

import torch

from ..data.cameras import Camera


def grid_centers(resolution: int, contracted: bool, device: torch.device) -> torch.Tensor:
    """Normalised positions (resolution³, 3) of cell centres, x fastest."""
    axis = (torch.arange(resolution, device=device) + 0.5) / resolution
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    u = torch.stack([x, y, z], -1).reshape(-1, 3)
    return uncontract(u) if contracted else u * 2 - 1


def uncontract(u: torch.Tensor) -> torch.Tensor:
    """Inverse of the contraction: grid coordinates (N, 3) in (0, 1)³ → normalised positions."""
    q = (u - 0.5) * 4
    r = q.abs().max(1, keepdim=True).values
    # ‖q‖ = 2 − 1/‖p‖ outside the cube
    return torch.where(r > 1, q / r.clamp(min=1e-9) / (2 - r).clamp(min=1e-4), q)


def view_counts(
    cameras: list[Camera], camera_to_box: torch.Tensor, resolution: int, contracted: bool, margin: float = 0.1
) -> torch.Tensor:
    """How many cameras see each cell centre (resolution³,) float32.

    A camera sees what its undistorted image, widened by `margin` of its size, holds in front of it. Equirectangular
    and fisheye cameras see everything.
    """
    device = camera_to_box.device
    points = grid_centers(resolution, contracted, device)
    counts = torch.zeros(len(points), device=device)
    for camera, pose in zip(cameras, camera_to_box):
        if camera.model in ("EQUIRECTANGULAR", "OPENCV_FISHEYE"):
            counts += 1
            continue
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).unbind(1)
        depth = z.clamp(min=1e-6)
        u = (camera.fx * x / depth + camera.cx) / camera.width
        v = (camera.fy * y / depth + camera.cy) / camera.height
        counts += (z > 1e-6) & (u > -margin) & (u < 1 + margin) & (v > -margin) & (v < 1 + margin)
    return counts
