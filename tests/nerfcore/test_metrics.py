"""Metrics of images: what they are taken over."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.evaluate.metrics import REACH, psnr, ssim


def test_what_is_not_kept_counts_for_neither_metric() -> None:
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, (60, 80, 3), np.uint8)
    image = photo.copy()
    image[:, :30] = 255 - image[:, :30]
    keep = np.zeros((60, 80), bool)
    keep[:, 30:] = True
    assert psnr(image, photo, keep) == 100
    assert 0.8 < ssim(image, photo, keep) < 1  # windows at its edge see some of the rest
    keep[:, : 30 + REACH] = False
    assert ssim(image, photo, keep) == pytest.approx(1)
    assert ssim(image, photo, ~keep) < 0.2


def test_a_mask_that_keeps_everything_changes_no_metric() -> None:
    photo, image = np.random.default_rng(0).integers(0, 256, (2, 30, 40, 3), np.uint8)
    everything = np.ones((30, 40), bool)
    assert ssim(image, photo, everything) == pytest.approx(ssim(image, photo))
    assert psnr(image, photo, everything) == pytest.approx(psnr(image, photo))
    rim = np.zeros((30, 40), bool)
    rim[0] = True  # no window that lies in the picture
    assert np.isfinite(ssim(image, photo, rim))
