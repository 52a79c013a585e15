"""Whole images from a trained model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch

from ..data.camera_rays import CameraRays
from ..geometry.cameras import Camera
from ..images.picture import Picture, over
from ..kernels.runtime import run_parallel
from ..sampling.space import unknown_share
from .baked import BakedField
from .fused import ray_renderer
from .model import Model
from .run import RunInfo

CPU_RAYS = 8192  # at once
LEAST = 1e-3  # opacity from which something has a depth


@dataclass(frozen=True)
class Frame:
    """One rendered view, numpy, (H, W, …).

    picture: sRGB float32 with associated alpha, nothing behind it; background: the grey that `color` has behind it, or the
    environment (3); opacity; depth: distance along the optical axis, of a panorama along the ray, in normalised units,
    NaN where nothing is; probabilities (K) or None; position (3) expected surface point in the normalised frame;
    unknown: share of the ray's way, up to what it meets, that no training photo shows, or None where not asked for.
    Where nothing is for a share above 0 the field does not say that there is nothing.
    """

    picture: Picture
    background: float | np.ndarray
    depth: np.ndarray
    probabilities: np.ndarray | None
    position: np.ndarray
    unknown: np.ndarray | None = None

    @property
    def opacity(self) -> np.ndarray:
        """Opacity (H, W) in [0, 1]."""
        return self.picture.pixels[..., 3]

    @cached_property
    def color(self) -> np.ndarray:
        """sRGB (H, W, 3) in [0, 1] on the background."""
        return over(self.picture, self.background).pixels.clip(0, 1)

    def label(self, class_ids: list[int], void: int = 0) -> np.ndarray:
        """Class id (H, W) of each pixel; `void` where more than half of the ray is void."""
        if self.probabilities is None:
            return np.full(self.opacity.shape, void)
        best = self.probabilities.argmax(-1)
        solid = self.probabilities.sum(-1) > 0.5
        return np.where(solid, np.array(class_ids)[best], void)

    def confidence(self) -> np.ndarray:
        """Probability (H, W) of the winning class."""
        return self.opacity * 0 if self.probabilities is None else self.probabilities.max(-1)

    def normal(self) -> np.ndarray:
        """Surface normal (H, W, 3) in the normalised frame from neighbouring surface points; 0 where nothing is, and in a
        picture of one row or column, whose points have no neighbours."""
        if min(self.opacity.shape) < 2:
            return np.zeros_like(self.position)
        dy, dx = np.gradient(self.position, axis=(0, 1))
        normal = np.cross(dx, dy)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = np.where(length > 1e-12, -normal / np.maximum(length, 1e-12), 0)
        return np.where((self.opacity > 0.5)[..., None], normal, 0)


def background_of(info: RunInfo) -> float:
    """Grey value behind the field in pictures: white for transparent captures, as benchmarks expect, else black."""
    choice = info.config.scene.background
    if choice in ("white", "black"):
        return 1.0 if choice == "white" else 0.0
    return 1.0 if info.transparent else 0.0


@torch.no_grad()
def render_view(
    model: Model | BakedField,
    camera: Camera,
    camera_to_box: np.ndarray,
    background: float,
    semantics: bool = True,
    check: Callable[[], None] | None = None,
    unknown: bool = False,
) -> Frame:
    """Render what a camera (pose (4, 4) in the normalised frame, OpenCV axes) sees.

    `background`: the grey behind the field where the model has no environment.
    `unknown`: also which share of each ray's way lies where no training photo looked, which only a model knows.
    `check` is called before every tile, on the CPU by several threads, and may raise to stop.
    """
    device = model.device
    rays = CameraRays([camera], camera_to_box[None], device)
    axis = rays.rotation[0, :, 2]
    pixels = torch.arange(camera.width * camera.height, device=device)
    # Haze before the sky has no depth: what is there lies behind it.
    least = LEAST if model.environment is None else 0.5
    if isinstance(model, BakedField):
        render, count, states, contracted = model, 0, None, False
    else:
        render = ray_renderer(model, len(pixels), semantics)
        count = model.config.render.samples or model.config.sampling.samples
        states, contracted = model.occupancy.states() if unknown else None, model.contracted

    @torch.no_grad()
    def tile(pixel: torch.Tensor) -> list[torch.Tensor]:
        if check is not None:
            check()
        origins, directions = rays(torch.zeros_like(pixel), pixel)
        valid = ~directions[:, 0].isnan()
        directions = torch.where(valid[:, None], directions, axis.expand_as(directions)).contiguous()
        out = render(origins, directions, count)
        opacity = out.opacity * valid
        distance = torch.where(opacity > least, out.depth / out.opacity.clamp(min=least), torch.nan)
        color = torch.cat([out.color * valid[:, None], opacity[:, None]], 1)
        depth = distance if camera.model == "EQUIRECTANGULAR" else distance * (directions @ axis)
        found = [color, depth, origins + directions * distance[:, None]]
        if states is not None:
            solid = torch.where(opacity > 0.5, distance, torch.nan)
            found.append(unknown_share(states, contracted, origins, directions, solid))
        probabilities, behind = out.probabilities, out.environment
        if behind is not None:
            found.append(behind.color * valid[:, None])
            if probabilities is not None and behind.probabilities is not None:
                probabilities = probabilities + behind.weight[:, None] * behind.probabilities
        return found if probabilities is None else [*found, probabilities * valid[:, None]]

    # The CPU renders small tiles side by side, each of which fits a core's cache.
    tiles = pixels.split(render.rays if device.type != "cpu" else min(render.rays, CPU_RAYS))
    parts = run_parallel([partial(tile, pixel) for pixel in tiles], device)
    shape = (camera.height, camera.width)
    images = [torch.cat(column).cpu() for column in zip(*parts)]
    color, depth, position, *more = (i.reshape(*shape, *i.shape[1:]).numpy() for i in images)
    picture = Picture(color, "srgb", "associated")
    hidden = more.pop(0) if states is not None else None
    behind = background if model.environment is None else more.pop(0)
    return Frame(picture, behind, depth, more[0] if more else None, position, hidden)
