"""What changes in the course of training, as functions of progress in [0, 1]."""

from __future__ import annotations

import math

from ..config import TrainConfig


def rate_factor(progress: float, decay: float) -> float:
    """Learning-rate factor: × `decay` at ½, ¾ and 9/10."""
    return decay ** sum(progress >= milestone for milestone in (0.5, 0.75, 0.9))


def bias_correction(step: int, beta1: float = 0.9, beta2: float = 0.99) -> float:
    """Adam's correction of the learning rate at `step` ≥ 1 (Kingma & Ba, 2015, section 2)."""
    return math.sqrt(1 - beta2**step) / (1 - beta1**step)


def sample_budget(train: TrainConfig, progress: float) -> int:
    """Field samples of a step: early on many small steps learn faster, later large batches average out the noise."""
    return round(train.batch_start * (train.batch_samples / train.batch_start) ** progress)
