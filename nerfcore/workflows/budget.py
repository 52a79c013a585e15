"""What a time limit leaves for all that comes after training."""

from __future__ import annotations

import math

SHARE, EXTRA = 0.5, 60.0  # of the training's seconds, and seconds, for everything after it
EVALUATION, PICTURES = 0.2, 0.2  # of that; mesh and .blend take the rest
SMALLEST = 0.25  # of the side of pictures, before there are fewer of them
FLOOR = 0.05  # of the training's seconds, and a second: what a stage gets when those before it took all


def seconds_after(time_limit: float | None) -> float:
    """Seconds for what comes after a training of so many seconds; `math.inf` without a limit."""
    return math.inf if time_limit is None else SHARE * time_limit + EXTRA


def share_of(time_limit: float | None, share: float, spent: float) -> float:
    """Seconds for a stage that has this share, less where those before it have `spent` more than theirs: on a busy machine a
    mesh takes longer than planned, and one held-out photo would say nothing of a field."""
    if time_limit is None:
        return math.inf
    whole = seconds_after(time_limit)
    return max(1 + FLOOR * time_limit, min(share * whole, whole - spent))


def fitting_pictures(
    size: tuple[int, int], count: int, rays_per_second: float | None, seconds: float
) -> tuple[tuple[int, int], int]:
    """Size and number of pictures that can be rendered in so many seconds: smaller ones first, then fewer, at least one.

    `rays_per_second`: how fast the field renders; None where that is not known: then they are as small as they get.
    """
    if seconds == math.inf:
        return size, count
    fits = SMALLEST**2 if rays_per_second is None else seconds * rays_per_second / (size[0] * size[1] * count)
    scale = min(1.0, max(SMALLEST, math.sqrt(fits)))
    fewer = count if fits >= SMALLEST**2 else max(1, int(count * fits / SMALLEST**2))
    return (max(1, round(size[0] * scale)), max(1, round(size[1] * scale))), fewer


def estimate(time_limit: float) -> str:
    """How long it takes, as far as that is known before the photos are read."""
    return (
        f"Once the poses of the photos are known: {time_limit / 60:.1f} minutes of training, then about "
        f"{seconds_after(time_limit) / 60:.1f} minutes for mesh, .blend, measurements and pictures, or as long as the mesh takes."
    )
