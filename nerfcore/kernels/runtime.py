"""Launching Warp kernels on CPU and CUDA from one source, and host threads for the CPU.

A CPU launch runs its threads one after the other, but releases the interpreter lock: `launch` cuts the range into
chunks and runs them in a small thread pool. Kernels therefore take the first index of their chunk as last argument
and begin with `i = wp.tid() + offset`. On CUDA the whole range is one launch on torch's current stream.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import torch
import warp as wp

from .device import backend_of

wp.config.log_level = 30  # warnings; stdout belongs to results
# The adjoints are written by hand (`torch.autograd.Function`), so that nothing is compiled that is never called.
wp.config.enable_backward = False
# For the GPU at hand: the oldest one's instructions, Warp's default, are compiled a second time by the driver.
wp.config.cuda_output = "cubin"

_MINIMUM_CHUNK = 256
NVIDIA = "0x10de"  # vendor number of PCI
NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
CUDA_BLOCK = 256  # threads a block, Warp's default
Result = TypeVar("Result")


def worker_count() -> int:
    """Threads for CPU kernels: what torch uses, so that one setting rules both."""
    return max(1, torch.get_num_threads())


_thread = threading.local()


def _enter_pool() -> None:
    # Each thread works on its own part; what it calls must not start threads of its own.
    torch.set_num_threads(1)
    _thread.in_pool = True


def in_pool() -> bool:
    """Whether this thread is one of `run_parallel`'s: launches and nested `run_parallel` calls then stay in it."""
    return getattr(_thread, "in_pool", False)


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, "kernel", initializer=_enter_pool)


_load_lock = threading.Lock()
_started = False


def init() -> None:
    """Start Warp once (a fraction of a second), whichever thread asks first."""
    global _started
    if _started:
        return
    with _load_lock:
        if not _started:
            # Kernel threads hold the interpreter lock for microseconds; at the default 5 ms they would wait for each
            # other.
            sys.setswitchinterval(1e-4)
            with nullcontext() if nvidia_gpu() else _without_note_of_driver():
                wp.init()
            _started = True


def nvidia_gpu() -> bool:
    """Whether the machine has an NVIDIA GPU, as far as can be told without its driver."""
    if torch.cuda.is_available() or shutil.which("nvidia-smi"):
        return True
    return any(path.read_text().strip() == NVIDIA for path in Path("/sys/bus/pci/devices").glob("*/vendor"))


@contextmanager
def _without_note_of_driver() -> Iterator[None]:
    """Leave out the line that Warp's native code writes to stderr where there is no NVIDIA driver."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as held:
        kept = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            rest = b"".join(line for line in held if NO_DRIVER not in line)
            if rest:
                os.write(2, rest)


def array(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """View a contiguous torch tensor as a Warp array without copying; vector types take the last dimension."""
    return wp.from_torch(tensor.detach(), dtype=dtype) if dtype is not None else wp.from_torch(tensor.detach())


def small_tensor(values: Any, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """A few numbers on the device, without making the host wait for it."""
    tensor = torch.tensor(values, dtype=dtype)
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


_loaded: dict[tuple[str, str], float] = {}


def load(kernel: wp.Kernel, device: torch.device) -> None:
    """Compile the kernel's module (seconds, the first time ever) or take it from Warp's cache, once for all threads."""
    key = (kernel.module.name, str(device))
    if key in _loaded:
        return
    with _load_lock:
        if key not in _loaded:
            begin = time.perf_counter()
            # A module is compiled for a block size: for another one than launches use it would be compiled twice.
            if device.type == "cpu":
                kernel.module.load("cpu", 1)
            else:
                kernel.module.load(wp.device_from_torch(str(device)), CUDA_BLOCK)
            _loaded[key] = time.perf_counter() - begin


def compile_seconds() -> float:
    """Time spent so far on compiling and loading kernels in this process."""
    return sum(_loaded.values())


@cache
def _warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    # Kept, as torch keeps its own: a Warp stream that goes ends a recording that is under way on the same stream.
    return wp.stream_from_torch(stream)


def current_stream(device: torch.device) -> wp.Stream:
    """Torch's current stream of a CUDA device, as Warp sees it."""
    return _warp_stream(torch.cuda.current_stream(device))


def launch(kernel: wp.Kernel, count: int, inputs: list[Any], device: torch.device, serial: bool = False) -> None:
    """Run `kernel` for indices 0 … count−1 with `inputs` followed by the chunk's offset.

    `serial` keeps a CPU launch in one thread, for kernels that write entries that indices share.
    """
    if count <= 0:
        return
    load(kernel, device)
    if device.type == "cuda":
        stream = current_stream(device)
        wp.launch(kernel, dim=count, inputs=[*inputs, 0], device=wp.device_from_torch(str(device)), stream=stream)
        return
    workers = 1 if in_pool() else worker_count()
    chunk = max(-(-count // workers), _MINIMUM_CHUNK)
    spans = [(begin, min(chunk, count - begin)) for begin in range(0, count, chunk)]
    if serial or len(spans) == 1:
        wp.launch(kernel, dim=count, inputs=[*inputs, 0], device="cpu")
        return
    run_parallel(
        [lambda s=span: wp.launch(kernel, dim=s[1], inputs=[*inputs, s[0]], device="cpu") for span in spans], device
    )


def run_parallel(tasks: Sequence[Callable[[], Result]], device: torch.device) -> list[Result]:
    """Results of callables that compute on a device, in their order: run in the kernel pool where its backend shares
    work among host threads, else one after the other; the first exception is raised when all are done."""
    if not backend_of(device).host_threads or in_pool() or worker_count() == 1 or len(tasks) == 1:
        return [task() for task in tasks]
    futures = [_pool(worker_count()).submit(task) for task in tasks]
    wait(futures)
    return [future.result() for future in futures]
