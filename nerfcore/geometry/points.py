"""Sparse point clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Points:
    """A sparse point cloud: positions (N, 3), colours (N, 3) uint8 sRGB, reprojection error (N,) pixels."""

    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray

    @staticmethod
    def empty() -> Points:
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))

    def __len__(self) -> int:
        return len(self.xyz)
