"""Rays of Blender's lenses: through any point of the picture and of the aperture, at any time of the shutter.

Source: Blender's Cycles, `kernel/camera/camera.h` and `projection.h`; pixels there count from below.
"""

from __future__ import annotations

import math

import torch

from .shot import Aperture, Lens


def camera_directions(lens: Lens, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and unit directions (N, 3) in camera axes (Blender's: −z is ahead, y is up) through pixels (N, 2); NaN
    where the lens sees nothing."""
    x, y = pixels.unbind(1)
    ahead = torch.zeros_like(x)
    if lens.kind == "orthographic":
        across = torch.stack([(x - lens.center[0]) / lens.scale[0], (lens.center[1] - y) / lens.scale[1], ahead], 1)
        return across, torch.stack([ahead, ahead, ahead - 1], 1)
    if lens.kind == "perspective":
        straight = torch.stack(
            [(x - lens.center[0]) / lens.scale[0], (lens.center[1] - y) / lens.scale[1], ahead - 1], 1
        )
        return torch.zeros_like(straight), straight / straight.norm(dim=1, keepdim=True)
    u, v = x / lens.width, 1 - y / lens.height
    if lens.kind == "equirectangular":
        (west, east), (south, north) = lens.longitudes, lens.latitudes
        phi = (west - east) * u - west
        theta = (south - north) * v - south + math.pi / 2
        sine = theta.sin()
        found = torch.stack([-sine * phi.sin(), theta.cos(), -sine * phi.cos()], 1)
        return torch.zeros_like(found), found
    if lens.kind == "equidistant":
        a, b = 2 * (u - 0.5), 2 * (v - 0.5)
        radius = torch.hypot(a, b)
        theta, seen = radius * lens.angle / 2, radius <= 1
    else:
        a, b = (u - 0.5) * lens.sensor[0], (v - 0.5) * lens.sensor[1]
        radius = torch.hypot(a, b)
        seen = radius <= 2 * lens.focal * math.sin(lens.angle / 4)
        theta = 2 * torch.asin((radius / (2 * lens.focal)).clamp(max=1))
    share = theta.sin() / radius.clamp(min=1e-12)
    found = torch.stack([a * share, b * share, -theta.cos()], 1)
    return torch.zeros_like(found), torch.where(seen[:, None], found, torch.nan)


def on_aperture(aperture: Aperture, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Points (N, 2) evenly over the aperture from numbers in [0, 1)."""
    if aperture.blades < 3:
        angle, radius = 2 * math.pi * v, u.sqrt()
        point = torch.stack([radius * angle.cos(), radius * angle.sin()], 1)
    else:
        corner = (u * aperture.blades).floor()
        rest = u * aperture.blades - corner
        # A point of the triangle between the middle and a side of the polygon.
        root, half = rest.sqrt(), math.pi / aperture.blades
        point = torch.stack([root * math.cos(half), (1 - 2 * v) * root * math.sin(half)], 1)
        turn = aperture.rotation + (2 * corner + 1) * half
        cosine, sine = turn.cos(), turn.sin()
        point = torch.stack([cosine * point[:, 0] - sine * point[:, 1], sine * point[:, 0] + cosine * point[:, 1]], 1)
    return point * torch.tensor([aperture.radius / aperture.ratio, aperture.radius], device=u.device)


def poses_at(poses: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """Matrices (N, 4, 4) at times (N,) in [0, 1], between those (P, 4, 4) at even times."""
    if len(poses) == 1:
        return poses[0].expand(len(time), 4, 4)
    place = time * (len(poses) - 1)
    first = place.floor().long().clamp(max=len(poses) - 2)
    return torch.lerp(poses[first], poses[first + 1], (place - first)[:, None, None])


def scene_rays(
    lens: Lens, pixels: torch.Tensor, chance: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and unit directions (N, 3) in the scene of rays through pixels (N, 2).

    chance: (N, 3) numbers in [0, 1): two for the place on the aperture, one for the time; None: through the middle of
    the lens while the shutter is half open.
    """
    origins, directions = camera_directions(lens, pixels)
    aperture = lens.aperture
    if aperture is not None and chance is not None:
        x, y = on_aperture(aperture, chance[:, 0], chance[:, 1]).unbind(1)
        if lens.panoramic:
            sharp = origins + directions * aperture.focus
            side = torch.linalg.cross(
                torch.tensor([[0.0, 0.0, -1.0]], device=x.device).expand_as(directions), directions
            )
            side = side / side.norm(dim=1, keepdim=True).clamp(min=1e-9)
            up = torch.linalg.cross(directions, side)
            shift = side * x[:, None] + up * y[:, None]
        else:
            sharp = origins + directions * (aperture.focus / -directions[:, 2:])
            shift = torch.stack([x, y, torch.zeros_like(x)], 1)
        origins = origins + shift
        directions = sharp - origins
        directions = directions / directions.norm(dim=1, keepdim=True)
    poses = torch.tensor(lens.poses, dtype=torch.float32, device=pixels.device)
    time = torch.full_like(pixels[:, 0], 0.5) if chance is None else chance[:, 2]
    pose = poses_at(poses, time)
    turned = torch.einsum("nij,nj->ni", pose[:, :3, :3], directions)
    start = torch.einsum("nij,nj->ni", pose[:, :3, :3], origins) + pose[:, :3, 3]
    return start, turned / turned.norm(dim=1, keepdim=True)


def axis_cosine(lens: Lens, directions: torch.Tensor) -> torch.Tensor:
    """Cosine (N,) between rays in the scene and the axis of the lens; 1 for panoramas, whose depth is a distance."""
    if lens.panoramic:
        return torch.ones_like(directions[:, 0])
    axis = -torch.tensor(lens.poses[len(lens.poses) // 2], device=directions.device)[:3, 2]
    return directions @ axis.to(directions.dtype)
