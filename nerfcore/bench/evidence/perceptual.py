"""LPIPS with weights that the user has: nothing is downloaded, and without weights nothing is measured.

Source: Zhang et al., “The Unreasonable Effectiveness of Deep Features as a Perceptual Metric”, 2018.
"""

from __future__ import annotations

import importlib
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...errors import InputError


class Perceptual:
    """LPIPS on features of VGG-16, by the package `lpips`.

    Args:
        weights: torchvision's VGG-16, a file of tensors as `vgg16-397923af.pth`.
    Raises:
        InputError: the package is not installed, or the file is not what it takes.
    """

    def __init__(self, weights: Path, device: torch.device) -> None:
        try:
            lpips: Any = importlib.import_module("lpips")
        except ImportError as error:
            raise InputError(
                "LPIPS needs the package lpips, which is not installed.",
                "Run `pip install lpips torchvision` in the engine's environment, or leave out --lpips.",
            ) from error
        self.device = device
        self.model = lpips.LPIPS(net="vgg", pnet_rand=True, verbose=False).to(device).eval()
        own = self.model.net.state_dict()
        try:
            given = torch.load(weights, map_location=device, weights_only=True)  # tensors only, no code
            own = {name: given[f"features.{name.split('.', 1)[1]}"] for name in own}
            self.model.net.load_state_dict(own)
        except (OSError, EOFError, KeyError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError) as error:
            raise InputError(
                f"{weights} does not hold the weights of torchvision's VGG-16: {error}.",
                "Give the file vgg16-397923af.pth of torchvision.",
            ) from error

    @torch.no_grad()
    def __call__(self, image: np.ndarray, photo: np.ndarray) -> float:
        """LPIPS of two (H, W, 3) uint8 images."""
        pair = [torch.from_numpy(x).to(self.device).permute(2, 0, 1)[None].float() / 127.5 - 1 for x in (image, photo)]
        return float(self.model(*pair))
