"""Launching kernels whose blocks work together on tiles: the block size is part of how they are compiled."""

from __future__ import annotations

import threading
import time
from typing import Any

import torch
import warp as wp

from .runtime import _load_lock, _loaded, current_stream

_one_at_a_time = threading.Lock()  # tiles of all CPU threads lie in the same memory


def load_blocks(kernel: wp.Kernel, lanes: int, device: torch.device) -> None:
    """Compile the kernel for blocks of `lanes` threads (seconds, the first time ever), or take it from
    Warp's cache."""
    key = (kernel.module.name, str(device))
    with _load_lock:
        if key not in _loaded:
            begin = time.perf_counter()
            kernel.module.load("cpu" if device.type == "cpu" else wp.device_from_torch(str(device)), lanes)
            _loaded[key] = time.perf_counter() - begin


def launch_blocks(kernel: wp.Kernel, blocks: int, lanes: int, inputs: list[Any], device: torch.device) -> None:
    """Run `blocks` blocks of `lanes` threads; on the CPU one after the other."""
    load_blocks(kernel, lanes, device)
    if device.type == "cuda":
        target, stream = wp.device_from_torch(str(device)), current_stream(device)
        wp.launch(kernel, dim=blocks * lanes, inputs=inputs, device=target, stream=stream, block_dim=lanes)
        return
    with _one_at_a_time:
        wp.launch(kernel, dim=blocks * lanes, inputs=inputs, device="cpu", block_dim=lanes)
