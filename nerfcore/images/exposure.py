"""Photos brought to a common exposure: what each one's colours must be multiplied with."""

from __future__ import annotations

import numpy as np

HUBER = 0.05  # difference of logarithms from which one counts less


def common_gains(photo: np.ndarray, color: np.ndarray, use: np.ndarray, photos: int) -> np.ndarray:
    """What each photo's colours must be multiplied with to agree with the others: (photos, 3) float32.

    Least squares in the logarithm over places that several photos show, reweighted by Huber's rule; the mean over photos
    stays, and photos that share little with others keep their colours.

    Args:
        photo: (N, K) int, which photos show each place. color: (N, K, 3), positive, what they show there. use: (N, K) bool,
            which of these count.
    """
    log = np.log(color)
    index = np.where(use, photo, 0).astype(np.int64)
    gain = np.zeros((photos, 3))
    for channel in range(3):
        y = log[..., channel].astype(np.float64)
        for _ in range(4):
            left = y - gain[index, channel]
            off = np.abs(left - _median(left, use))
            weight = use * np.minimum(1, HUBER / np.maximum(off, 1e-9))
            total = np.maximum(weight.sum(1), 1e-12)
            mean = (weight * y).sum(1) / total
            pair = weight[:, :, None] * weight[:, None, :] / total[:, None, None]
            cells = index[:, :, None] * photos + index[:, None, :]
            matrix = -np.bincount(cells.reshape(-1), pair.reshape(-1), photos**2).reshape(photos, photos)
            matrix[np.diag_indices(photos)] += np.bincount(index.reshape(-1), weight.reshape(-1), photos)
            right = np.bincount(index.reshape(-1), (weight * (y - mean[:, None])).reshape(-1), photos)
            few = 1e-3 * max(float(np.trace(matrix)) / photos, 1e-6)
            gain[:, channel] = np.linalg.solve(matrix + few * np.eye(photos), right)
    return np.exp(gain.mean(0) - gain).astype(np.float32)


def _median(values: np.ndarray, use: np.ndarray) -> np.ndarray:
    """The lower median (N, 1) of those values (N, K) of each row that count."""
    ordered = np.sort(np.where(use, values, np.inf), 1)
    return np.take_along_axis(ordered, np.maximum(use.sum(1, keepdims=True) - 1, 0) // 2, 1)
