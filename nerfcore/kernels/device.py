"""The device that everything is computed on."""

from __future__ import annotations

import os

import torch

from .runtime import default_threads


def use_device() -> torch.device:
    """The device to compute on: FIELDWORK_DEVICE when set, else CUDA when there is one, else the CPU."""

    torch.set_num_threads(default_threads())
    wanted = os.environ.get("FIELDWORK_DEVICE")
    return torch.device(wanted or ("cuda" if torch.cuda.is_available() else "cpu"))
