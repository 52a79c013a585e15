"""The terms of the training loss (method: composite loss). All return scalars."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from ..config import LossConfig
from ..data.pixels import VOID, Batch
from ..kernels.composite import sums_in_front
from ..kernels.packed_info import PackedInfo


def color_loss(
    predicted: torch.Tensor, target: torch.Tensor, config: LossConfig, squared: bool = False
) -> torch.Tensor:
    """Huber (δ as configured, scaled to its quadratic part's slope 1/δ) or squared error of colours (R, 3).

    Huber's price is all but that of the absolute error, whose best guess for all pixels alike is their median: where
    most of a capture is black, the field would turn black and transparent before it can tell pixels apart, and black
    in front of black has no gradient to come back by. `squared`: the quadratic part holds for all errors, whose best
    guess is the mean.
    """
    if config.rgb == "mse":
        return F.mse_loss(predicted, target)
    if squared:
        return F.mse_loss(predicted, target) / (2 * config.huber_delta)
    return F.huber_loss(predicted, target, delta=config.huber_delta) / config.huber_delta


def label_weights(batch: Batch) -> torch.Tensor:
    """How much each ray of a batch counts for the classes (R,): the root of its weight, so that pixels drawn more often
    keep half of their advantage; nothing without a label or where the photo is transparent, since a label there would
    call for something to be seen.

    The union of a class is best met when pixels count as its own from a probability of J/(1+J) on, J its IoU (Lipton
    et al., "Optimal thresholding of classifiers to maximize F1 measure", 2014, with F = 2J/(1+J)), less than a half;
    rare classes, which are drawn more often, have the smallest J.
    """
    return batch.weight.sqrt() * batch.alpha * (batch.label != VOID)


def at_given_opacity(probabilities: torch.Tensor, opacity: torch.Tensor) -> torch.Tensor:
    """The rendered probabilities (R, K), with gradients that move weight along a ray but leave its opacity (R,) alone:
    labels say where a thing is, not how much of it; they would fill the free space beside things with fog."""
    return probabilities * (opacity.detach() / opacity.clamp(min=1e-6))[:, None]


def semantic_loss(
    probabilities: torch.Tensor, target: torch.Tensor, weight: torch.Tensor, confidence: torch.Tensor | None = None
) -> torch.Tensor:
    """Cross-entropy in image space: mean of −log Ŝ_y over the rays, weighted; 0 where none is labelled.

    Args:
        probabilities: (R, K) rendered class probabilities; the rest to 1 is void.
        target: (R,) class index, or (R, K) soft labels.
        weight: (R,) how much each ray counts, 0 for those without a label.
        confidence: (R,) in [0, 1], factor of each ray's term; what the rays count stays as it is.
    """
    log = probabilities.clamp(min=1e-6).log()
    if target.dim() == 1:
        picked = log.gather(1, torch.where(weight > 0, target, 0)[:, None])[:, 0]
    else:
        picked = (log * target).sum(1)
    if confidence is not None:
        picked = picked * confidence
    return -(picked * weight).sum() / weight.sum().clamp(min=1e-6)


def sparsity_loss(density: torch.Tensor, config: LossConfig) -> torch.Tensor:
    """Mean price of density (N,) at random points: 1 − exp(−ℓσ), log(1 + σ²/½) (Cauchy) or σ."""
    if config.sparsity == "exponential":
        return (1 - torch.exp(-config.sparsity_scale * density)).mean()
    if config.sparsity == "cauchy":
        return torch.log1p(2 * density * density).mean()
    return density.abs().mean()


def entropy_loss(probabilities: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Weighted mean of −H(Ŝ) of labelled rays, `weight` as for `semantic_loss`: minimising it raises the entropy, so
    that labels do not become overconfident."""
    entropy = -(probabilities * probabilities.clamp(min=1e-6).log()).sum(1)
    return -(entropy * weight).sum() / weight.sum().clamp(min=1e-6)


def opacity_entropy(opacity: torch.Tensor) -> torch.Tensor:
    """Mean binary entropy of ray opacities (R,): small when rays are either empty or opaque."""
    o = opacity.clamp(1e-4, 1 - 1e-4)
    return -(o * o.log() + (1 - o) * (1 - o).log()).mean()


def distortion_loss(
    weights: torch.Tensor, t: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo
) -> torch.Tensor:
    """Σ_ij w_i w_j |s_i − s_j| + ⅓ Σ w_i² δ_i, mean over rays (Barron et al., "Mip-NeRF 360", 2022, eq. 15).

    Args:
        weights (N,), t (N,): normalised distance of each sample along its ray, deltas (N,): its length there.
    """
    if len(weights) == 0:
        return weights.sum() * 0
    # Σ_i w_i (s_i W_<i − S_<i), twice, with running sums: linear in the samples.
    in_front = sums_in_front(weights, packed_info), sums_in_front(weights * t, packed_info)
    pairs = 2 * weights * (t * in_front[0] - in_front[1])
    # With a fixed capacity there are entries even where no sample is visible.
    return (pairs + weights * weights * deltas / 3).sum() / (packed_info.counts > 0).sum().clamp(min=1)


def psnr(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error of values in [0, 1]."""
    return -10 * math.log10(max(mse, 1e-12))
