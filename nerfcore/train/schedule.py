"""What changes in the course of training, as functions of progress in [0, 1]."""

from __future__ import annotations

import math

from ..config import TrainConfig

ENOUGH_STEPS = 1500
FIXED_COST = 0.6  # of a first step on a CPU, which does not grow with its samples


def rate_factor(progress: float, decay: float) -> float:
    """Learning-rate factor: × `decay` at ½, ¾ and 9/10."""
    return decay ** sum(progress >= milestone for milestone in (0.5, 0.75, 0.9))


def bias_correction(step: int, beta1: float = 0.9, beta2: float = 0.99) -> float:
    """Adam's correction of the learning rate at `step` ≥ 1 (Kingma & Ba, 2015, section 2)."""
    return math.sqrt(1 - beta2**step) / (1 - beta1**step)


def sample_budget(train: TrainConfig, progress: float, largest: int | None = None) -> int:
    """Field samples of a step: early on many small steps learn faster, later large batches average out the noise.

    `largest`: those of the last steps instead of the setting's.
    """
    return round(train.batch_start * ((largest or train.batch_samples) / train.batch_start) ** progress)


def padded_capacity(wanted: float, most: float) -> float:
    """A capacity of at least `wanted` that is one of four an octave, so that it stays the same for many steps; no more than
    `most`, if that is enough."""
    padded = 2.0 ** (math.ceil(4 * math.log2(max(wanted, 1.0))) / 4)
    return max(wanted, min(padded, most))


def largest_batch(train: TrainConfig, seconds: float, step_seconds: float) -> int:
    """Field samples of the last steps of a training of so many seconds, whose first steps take `step_seconds`: as large
    as the setting has them if that leaves `ENOUGH_STEPS`, else as small as it takes, down to twice those of the first."""
    least = min(2 * train.batch_start, train.batch_samples)
    if train.batch_samples <= train.batch_start:
        return train.batch_samples
    size = train.batch_samples
    while size > least and seconds / (step_seconds * _mean_cost(size / train.batch_start)) < ENOUGH_STEPS:
        size = max(least, size // 2)
    return size


def _mean_cost(growth: float) -> float:
    """Seconds of a step, on average over a schedule in which its samples grow by this factor, relative to its first."""
    mean = 1.0 if growth <= 1 else (growth - 1) / math.log(growth)
    return FIXED_COST + (1 - FIXED_COST) * mean
