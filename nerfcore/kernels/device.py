"""What everything is computed on: a device, and the backend whose kernels run there. Decided here and nowhere else.

| backend | kernels | devices |
| --- | --- | --- |
| warp-cuda | Warp, compiled for the GPU | NVIDIA |
| warp-cpu | Warp, compiled for the CPU, in a few host threads | any CPU |
| torch | PyTorch operations | AMD (ROCm), Apple (MPS); any other on demand |

FIELDWORK_DEVICE (cpu, cuda, cuda:1, rocm, mps) chooses the device, else the first GPU there is is taken, else the CPU.
FIELDWORK_BACKEND (warp, torch) overrides which kernels run on it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Literal

import psutil
import torch

from ..errors import SettingError
from .host import default_threads, keep_memory

Kernels = Literal["warp", "torch"]
BackendName = Literal["warp-cuda", "warp-cpu", "torch"]
DEVICES = ("cpu", "cuda", "rocm", "mps")


@dataclass(frozen=True)
class Backend:
    """The kernels of one kind of device (`device_type` as torch names it), and what follows from them."""

    name: BackendName
    device_type: str

    @property
    def warp(self) -> bool:
        """Whether kernels are Warp's."""
        return self.name != "torch"

    @property
    def host_threads(self) -> bool:
        """Whether parts of a computation run side by side in host threads, each launching kernels of its own. A GPU is
        filled by one launch, and threads that launch on one stream would only wait for each other."""
        return self.name == "warp-cpu"

    @property
    def asynchronous(self) -> bool:
        """Whether the device runs behind the host, which must wait for what it reads back."""
        return self.device_type != "cpu"

    @property
    def fixed_capacity(self) -> bool:
        """Whether training steps have places for as many samples as there may be instead of reading back how many
        there are."""
        return self.name == "warp-cuda"

    @property
    def fused(self) -> bool:
        """Whether pictures are rendered by the fused kernel."""
        return self.name == "warp-cuda"

    @property
    def fused_optimizer(self) -> bool:
        """Whether torch's Adam runs as one operation that can skip a step by itself."""
        return self.device_type in ("cpu", "cuda")

    @property
    def has_float64(self) -> bool:
        """Whether the device computes in double precision."""
        return self.device_type != "mps"


_kernels: Kernels | None = None  # what `using_kernels` asks for


def _asked() -> Kernels | None:
    if _kernels is not None:
        return _kernels
    wanted = os.environ.get("FIELDWORK_BACKEND", "")
    if wanted in ("", "auto"):
        return None
    if wanted not in ("warp", "torch"):
        raise SettingError(f"FIELDWORK_BACKEND is “{wanted}”.", "Set it to warp or torch, or leave it out.")
    return wanted


@cache
def _backend(device_type: str, asked: Kernels | None) -> Backend:
    warp_serves = device_type == "cpu" or (device_type == "cuda" and torch.version.hip is None)
    if asked == "warp" and not warp_serves:
        name = "ROCm" if device_type == "cuda" else device_type.upper()
        raise SettingError(f"Warp has no kernels for {name}.", "Leave FIELDWORK_BACKEND out, or set it to torch.")
    if asked == "torch" or not warp_serves:
        return Backend("torch", device_type)
    return Backend("warp-cuda" if device_type == "cuda" else "warp-cpu", device_type)


def backend_of(device: torch.device) -> Backend:
    """The backend that serves tensors on a device.

    Raises:
        SettingError: FIELDWORK_BACKEND is not a backend, or not one for this device.
    """
    return _backend(device.type, _asked())


@contextmanager
def using_kernels(kernels: Kernels | None) -> Iterator[None]:
    """Inside, kernels are Warp's or torch's whatever FIELDWORK_BACKEND says; for all threads."""
    global _kernels
    before, _kernels = _kernels, kernels
    try:
        yield
    finally:
        _kernels = before


def choose_device() -> torch.device:
    """The device to compute on: FIELDWORK_DEVICE when set, else the first GPU there is, else the CPU.

    Raises:
        SettingError: FIELDWORK_DEVICE names no device, or one that this build of PyTorch cannot use.
    """
    wanted = os.environ.get("FIELDWORK_DEVICE", "")
    if wanted in ("", "auto"):
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    kind, _, number = wanted.partition(":")
    if kind not in DEVICES or (number and not (number.isdecimal() and kind in ("cuda", "rocm"))):
        raise SettingError(
            f"FIELDWORK_DEVICE is “{wanted}”.", "Set it to cpu, cuda, cuda:1, rocm or mps, or leave it out."
        )
    if kind == "cpu":
        return torch.device("cpu")
    built = "rocm" if torch.version.hip else "cuda"
    there = torch.backends.mps.is_available() if kind == "mps" else torch.cuda.is_available() and kind == built
    if not there or (number and int(number) >= torch.cuda.device_count()):
        raise SettingError(
            f"FIELDWORK_DEVICE is “{wanted}”, but this build of PyTorch ({torch.__version__}) finds no such device.",
            "See `fieldwork doctor`, choose another device, or leave FIELDWORK_DEVICE out.",
        )
    if kind == "mps":
        return torch.device("mps")
    return torch.device("cuda", int(number)) if number else torch.device("cuda")


def on_host(device: torch.device) -> bool:
    """Whether kernels written for CPUs serve a device (`*_host.py`), instead of those for every device."""
    return device.type == "cpu" and backend_of(device).warp


def kernel_device(device: torch.device) -> torch.device:
    """Where kernels that only Warp has run: on the device itself, or on the host where Warp does not serve it."""
    return device if backend_of(device).warp else torch.device("cpu")


def use_device() -> torch.device:
    """`choose_device`, with torch set up for it: as many threads as the engine may use, memory that is used again, and
    on the device at hand."""
    keep_memory()
    torch.set_num_threads(default_threads())
    device = choose_device()
    if device.index is not None:
        torch.cuda.set_device(device)
    return device


def synchronize(device: torch.device) -> None:
    """Wait until the device has done all it was asked to do."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


def free_memory(device: torch.device) -> int:
    """Bytes that are free on the device: a GPU's own memory, else the machine's."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    if device.type == "mps":
        return max(torch.mps.recommended_max_memory() - torch.mps.driver_allocated_memory(), 0)
    return psutil.virtual_memory().available


@cache
def native_half(device: torch.device) -> torch.dtype | None:
    """The half-precision type that the device multiplies natively, bfloat16 before float16; None when there is none."""
    if device.type == "cpu":
        able = torch.cpu.get_capabilities()
        return torch.bfloat16 if able.get("avx512_bf16") or able.get("amx_bf16") else None
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float16
    return None
