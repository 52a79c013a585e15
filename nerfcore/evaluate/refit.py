"""Held-out cameras of runs with refined poses: fitted to their photos against the fixed field, as BARF does.

Training moved the cameras that it used, so the given pose of a held-out one no longer fits as well as theirs, and its
score would measure the pose rather than the field. Both scores are reported.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..data.camera_rays import CameraRays
from ..data.pixels import Batch
from ..geometry.cameras import Camera
from ..render.model import Model
from ..train.pose_refinement import PoseRefinement, level_weights

# Not tuned: the next two.
STEPS = 120
RAYS = 1024  # a step


def refit_camera(
    model: Model,
    camera: Camera,
    camera_to_box: np.ndarray,
    photo: np.ndarray,
    keep: np.ndarray | None,
    background: float,
    check: Callable[[], None],
) -> np.ndarray:
    """The pose (4, 4) near `camera_to_box` from which the model looks most like a photo.

    Args:
        photo: (H, W, 3) uint8 on the background. keep: (H, W) bool, pixels that count; None: all.
        check: called between steps, may raise to stop.
    """
    device = model.priorities.device
    rays = CameraRays([camera], camera_to_box[None], device)
    refinement = PoseRefinement(rays, model.config.train, keep_rig=False)
    generator = torch.Generator(device).manual_seed(0)
    colors = torch.from_numpy(photo.reshape(-1, 3)).to(device).float() / 255
    pixel_indices = torch.arange(len(colors), device=device)
    if keep is not None:
        pixel_indices = pixel_indices[torch.from_numpy(keep.reshape(-1)).to(device)]
    count = model.config.sampling.samples
    grid = model.field.grid
    for step in range(STEPS if len(pixel_indices) else 0):
        check()
        pixel = pixel_indices[torch.randint(0, len(pixel_indices), (RAYS,), device=device, generator=generator)]
        image = torch.zeros_like(pixel)
        origins, directions = rays(image, pixel)
        valid = ~directions[:, 0].isnan()
        origins, directions, pixel, image = (x[valid] for x in (origins, directions, pixel, image))
        solid = torch.ones(len(pixel), device=device)
        batch = refinement.move(Batch(origins, directions, colors[pixel], solid, image, image, pixel, solid, solid))
        jitter = torch.rand(len(pixel), device=device, generator=generator)
        shift = torch.rand(len(pixel) * count, device=device, generator=generator)
        if grid is not None:
            grid.point_gains = level_weights(model.config.field.levels, step / STEPS)
        out = model.render(batch.origins, batch.directions, count, jitter, shift, semantics=False)
        predicted = out.color + background * (1 - out.opacity[:, None])
        if out.environment is not None:
            predicted = out.color + out.environment.color * out.environment.weight[:, None]
        loss = torch.nn.functional.huber_loss(predicted, batch.rgb, delta=0.1)
        if loss.requires_grad:
            gradients = torch.autograd.grad(loss, (batch.origins, batch.directions), allow_unused=True)
            rays_ = batch.origins, batch.directions
            refinement.step([[torch.zeros_like(r) if g is None else g for r, g in zip(rays_, gradients)]], step / STEPS)
    return refinement.poses(rays)[0].cpu().double().numpy()
