"""What all baselines have in common: rays with a width, what is rendered, and how the trial trains and asks them."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

import torch
from torch import nn

from ...data.camera_rays import CameraRays
from ...data.pixels import Batch
from ...kernels.device import native_half, synchronize

NEAR = 0.02  # in normalised units, as of the field
FAR = 4.0  # where there is no cube around everything: how far rays go, in halves of the box
CONE = 2 / 12**0.5  # from the width of a pixel to the radius of its cone with the same variance: Mip-NeRF, section 3.1


@dataclass(frozen=True)
class Setup:
    """What a method is told of a scene.

    classes, images: how many there are; contracted: space goes on around the cube [−1, 1]³ instead of ending with it;
    background: grey behind the field; rays: of a training step.
    """

    classes: int
    images: int
    contracted: bool
    background: float
    rays: int
    device: torch.device

    @property
    def bound(self) -> float:
        """Half side of the cube that holds all sample points."""
        return FAR + 1 if self.contracted else 1.0


@dataclass(frozen=True)
class Rays:
    """R rays in the normalised frame: origins, unit directions (R, 3); radii (R,) of their cones at distance 1; images
    (R,) int64 index of the training photo, None for other cameras."""

    origins: torch.Tensor
    directions: torch.Tensor
    radii: torch.Tensor
    images: torch.Tensor | None = None

    def part(self, chosen: slice) -> Rays:
        images = None if self.images is None else self.images[chosen]
        return Rays(self.origins[chosen], self.directions[chosen], self.radii[chosen], images)

    def __len__(self) -> int:
        return len(self.origins)


@dataclass(frozen=True)
class Rendered:
    """R rendered rays: color (R, 3) without background; opacity (R,); depth (R,) Σ w t; probabilities (R, K) or None."""

    color: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    probabilities: torch.Tensor | None = None


def camera_rays(cameras: CameraRays, image: torch.Tensor, pixel: torch.Tensor, training: bool) -> Rays:
    """Rays through pixels (N,) of cameras (N,), as wide as a pixel."""
    origins, directions = cameras(image, pixel)
    right = torch.where(pixel % cameras.width[image] == cameras.width[image] - 1, pixel - 1, pixel + 1)
    between = cameras.camera_directions(image, right) - cameras.camera_directions(image, pixel)
    return Rays(origins, directions, between.norm(dim=1) * CONE, image if training else None)


def ray_limits(rays: Rays, contracted: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances (R,) between which samples lie: inside the cube [−1, 1]³, or up to `FAR`."""
    near = torch.full_like(rays.radii, NEAR)
    if contracted:
        return near, torch.full_like(near, FAR)
    inverse = 1 / torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
    first, second = (-1 - rays.origins) * inverse, (1 - rays.origins) * inverse
    near = torch.maximum(torch.minimum(first, second).amax(1), near)
    return near, torch.maximum(torch.maximum(first, second).amin(1), near + 1e-3)


def ray_weights(density: torch.Tensor, deltas: torch.Tensor) -> torch.Tensor:
    """Rendering weights (R, S) T α of samples with densities and lengths (R, S): Mildenhall et al., “NeRF”, 2020, eq. 3."""
    after = torch.cumsum(density * deltas, 1)
    before = nn.functional.pad(after, (1, 0))[:, :-1]
    return torch.exp(-before) - torch.exp(-after)


def log_linear(progress: float, first: float, last: float) -> float:
    """A rate that falls from `first` to `last` by equal factors in equal times."""
    return first * (last / first) ** progress


class Baseline(nn.Module, ABC):
    """A method: its networks, one training step, and what a ray shows.

    `timer`: the clock that `network_seconds`, the time spent in networks, is measured with.
    """

    chunk = 1024  # rays rendered at once

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        self.setup = setup
        self.steps = 0
        self.rays = setup.rays
        self.timer: Callable[[], float] = time.perf_counter
        self.network_seconds = 0.0

    @abstractmethod
    def train_step(self, batch: Batch, rays: Rays, progress: float, generator: torch.Generator) -> float:
        """One step of optimisation at `progress` in [0, 1] of the schedule; returns the mean squared error."""

    @abstractmethod
    def render(self, rays: Rays, semantics: bool = True) -> Rendered:
        """What rays show, without gradients."""

    def parameter_count(self) -> int:
        return sum(p.numel() for p in self.parameters())

    def target(self, batch: Batch) -> torch.Tensor:
        """Colours (R, 3) of the photos on the background."""
        return batch.rgb * batch.alpha[:, None] + self.setup.background * (1 - batch.alpha[:, None])

    def behind(self, color: torch.Tensor, opacity: torch.Tensor) -> torch.Tensor:
        """A rendered colour on the background."""
        return color + self.setup.background * (1 - opacity[:, None])

    def half_precision(self) -> AbstractContextManager[None]:
        """Matrix products as fast as the device has them, as those of our own networks are."""
        half = native_half(self.setup.device)
        return torch.autocast(self.setup.device.type, half) if half is not None else nullcontext()  # type: ignore[return-value]

    @contextmanager
    def network(self) -> Iterator[None]:
        """What happens here is counted in `network_seconds`."""
        if self.training:
            yield
            return
        synchronize(self.setup.device)
        begin = self.timer()
        yield
        synchronize(self.setup.device)
        self.network_seconds += self.timer() - begin
