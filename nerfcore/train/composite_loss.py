"""The training loss of rendered rays: its terms (`losses.py`), weighted as configured (method: composite loss)."""

from __future__ import annotations

import torch

from ..config import LossConfig
from ..data.pixels import Batch
from ..render.model import Model, Rendered
from .losses import (
    at_given_opacity,
    color_loss,
    distortion_loss,
    entropy_loss,
    label_weights,
    opacity_entropy,
    semantic_loss,
)


def composite_loss(
    batch: Batch,
    rendered: Rendered,
    background: torch.Tensor,
    progress: float,
    config: LossConfig,
    model: Model,
    share: tuple[float, float | torch.Tensor] = (1.0, 1.0),
    squared: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The loss of R rays in front of `background` (R, 3), or of the environment where the model has one and it may be what
    they show, and their mean squared colour error; both scalars.

    Args:
        progress: of the schedule, in [0, 1]; some terms begin later.
        model: what rendered the rays.
        share: the part of the whole batch's rays and of its labelled rays that these are; both results are scaled so
            that those of all parts sum to the batch's.
        squared: colour errors count squared, see `color_loss`.
    """
    rays, labels = share
    alpha, behind, environment = batch.alpha[:, None], 1 - rendered.opacity, rendered.environment
    if environment is not None:
        behind = environment.weight
        background = (
            environment.color if batch.sky is None else torch.where(batch.sky[:, None], environment.color, background)
        )
    target = batch.rgb * alpha + background.detach() * (1 - alpha)
    predicted = rendered.color + background * behind[:, None]
    total = rays * config.rgb_weight * color_loss(predicted, target, config, squared)
    if rendered.probabilities is not None:
        counted = label_weights(batch)
        opacity = torch.lerp(rendered.opacity.detach(), rendered.opacity, model.label_pull)
        probabilities = at_given_opacity(rendered.probabilities, opacity)
        if environment is not None and environment.probabilities is not None:
            left = environment.weight.detach()
            left = left if batch.sky is None else left * batch.sky
            probabilities = probabilities + environment.probabilities * left[:, None]
        price = semantic_loss(probabilities, batch.label, counted, batch.confidence)
        total = total + labels * config.semantic_weight * price
        if config.entropy_ratio > 0 and config.regularization > 0 and progress >= config.entropy_start:
            weight = config.regularization * config.entropy_ratio * config.semantic_weight
            total = total + labels * weight * entropy_loss(probabilities, counted)
    if config.regularization > 0:
        total = total + rays * config.regularization * _regularizers(
            batch, rendered, progress, config, model.contracted
        )
    return total, rays * ((predicted.detach() - target) ** 2 * batch.weight[:, None]).mean()


def _regularizers(
    batch: Batch, rendered: Rendered, progress: float, config: LossConfig, contracted: bool
) -> torch.Tensor:
    samples = rendered.samples
    total = rendered.opacity.sum() * 0
    if config.distortion_weight > 0 and progress >= config.distortion_start:
        t = samples.t / (1 + samples.t) if contracted else samples.t
        deltas = samples.deltas / (1 + samples.t) ** 2 if contracted else samples.deltas
        distortion = distortion_loss(rendered.weights, t, deltas, samples.packed_info)
        total = total + config.distortion_weight * distortion
    if config.opacity_weight > 0:
        total = total + config.opacity_weight * opacity_entropy(rendered.opacity)
    if config.environment_weight > 0 and rendered.environment is not None:
        priced = rendered.opacity if batch.sky is None else rendered.opacity * batch.sky
        total = total + config.environment_weight * priced.mean()
    return total
