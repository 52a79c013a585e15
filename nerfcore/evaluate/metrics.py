"""Image and label metrics. Images are uint8-quantised before they are compared."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

REACH = 5  # pixels: half of the window of the structural similarity
BINS = 10  # of the expected calibration error
BOUNDARY = 0.02  # of the image's diagonal, as wide as what counts as a class's boundary


def psnr(image: np.ndarray, photo: np.ndarray, keep: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two (H, W, 3) uint8 images, over pixels where `keep` (H, W) is true."""
    error = ((image.astype(np.float64) - photo) / 255) ** 2
    mse = float(error.mean() if keep is None else error[keep].mean())
    return -10 * math.log10(max(mse, 1e-10))


def ssim(image: np.ndarray, photo: np.ndarray, keep: np.ndarray | None = None) -> float:
    """Structural similarity, 11×11 Gaussian window with σ 1.5 (Wang et al., 2004), of (H, W, 3) uint8 images; its mean over
    the pixels where `keep` (H, W) is true. Windows around these see what lies beside them."""
    from skimage.metrics import structural_similarity  # takes a quarter of a second

    found: Any = structural_similarity(
        image,
        photo,
        data_range=255,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    mean, each = found
    if keep is None:
        return float(mean)
    inner = np.zeros_like(keep)  # where windows lie in the picture, as for the mean of all
    inner[REACH:-REACH, REACH:-REACH] = keep[REACH:-REACH, REACH:-REACH]
    return float(each[inner if inner.any() else keep].mean())


@dataclass
class Confusion:
    """Counts of (true, predicted) class over the whole data set; void is never counted as truth."""

    class_ids: list[int]
    counts: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        # One more column: void or a class outside the list predicted.
        self.counts = np.zeros((len(self.class_ids), len(self.class_ids) + 1), np.int64)

    def add(self, truth: np.ndarray, predicted: np.ndarray) -> None:
        """Count two label images of class ids; pixels whose truth is not in the list are skipped."""
        n = len(self.class_ids)
        lookup = np.full(max([*self.class_ids, int(truth.max()), int(predicted.max())]) + 1, n)
        lookup[self.class_ids] = np.arange(n)
        t, p = lookup[truth.ravel()], lookup[predicted.ravel()]
        keep = t < n
        np.add.at(self.counts, (t[keep], p[keep]), 1)

    def iou(self) -> dict[int, float]:
        """Intersection over union of each class that occurs in the truth."""
        hit = np.diag(self.counts[:, :-1])
        truth, predicted = self.counts.sum(1), self.counts[:, :-1].sum(0)
        union = truth + predicted - hit
        return {c: float(hit[i] / union[i]) for i, c in enumerate(self.class_ids) if truth[i] > 0}

    def miou(self) -> float | None:
        """Mean IoU over the classes in the truth; None without labels."""
        values = list(self.iou().values())
        return float(np.mean(values)) if values else None


def calibration_error(sure: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error of confidences (N,) in [0, 1] of answers that are right (N,) or not.

    Source: Naeini et al., “Obtaining well calibrated probabilities using Bayesian binning”, 2015.
    """
    number = np.minimum((sure * BINS).astype(int), BINS - 1)
    gap = np.bincount(number, sure - right, BINS)
    return float(np.abs(gap).sum() / max(len(sure), 1))


def boundary(mask: np.ndarray) -> np.ndarray:
    """The pixels (H, W) bool of a mask that lie near its outline; what the picture cuts off is no outline."""
    from scipy.ndimage import binary_erosion

    width = max(1, round(BOUNDARY * math.hypot(*mask.shape)))
    inner = np.asarray(binary_erosion(mask, np.ones((3, 3), bool), iterations=width, border_value=1), bool)
    return mask & ~inner


@dataclass
class BoundaryOverlap:
    """Boundary IoU of each class over the whole data set; pixels whose truth is not in the list are left out.

    Source: Cheng et al., “Boundary IoU: Improving Object-Centric Image Segmentation Evaluation”, 2021.
    """

    class_ids: list[int]
    both: dict[int, int] = field(default_factory=dict)
    either: dict[int, int] = field(default_factory=dict)

    def add(self, truth: np.ndarray, predicted: np.ndarray) -> None:
        """Count two label images (H, W) of class ids."""
        known = np.isin(truth, self.class_ids)
        for number in np.unique(truth[known]).tolist():
            there, told = (boundary(labels == number) & known for labels in (truth, predicted))
            self.both[number] = self.both.get(number, 0) + int((there & told).sum())
            self.either[number] = self.either.get(number, 0) + int((there | told).sum())

    def mean(self) -> float | None:
        """Mean over the classes in the truth that have a boundary; None without labels."""
        found = [self.both[number] / union for number, union in self.either.items() if union]
        return float(np.mean(found)) if found else None
