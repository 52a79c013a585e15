"""What the figures were taken on, and the yardstick that may run beside them."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil
import torch

from ..errors import InputError
from ..kernels.device import use_device
from ..kernels.host import default_threads
from ..progress import Reporter
from .results import CPU_FLAGS, Machine, Taken

ROOT = Path(__file__).resolve().parents[2]
CODE = ("nerfcore", "addon", "operators", "panels", "pyproject.toml")
CPUINFO = Path("/proc/cpuinfo")


def describe() -> str:
    """Name of the device, its threads, and the versions that matter."""
    device = use_device()
    what = _gpu(device) or f"{_processor()}, threads: {torch.get_num_threads()}"
    return f"{what}; {_software()}"


def taken() -> Taken:
    """Machine, code and time of what is measured now."""
    device = use_device()
    commit, modified = checked_out()
    flags = _cpuinfo("flags").split()
    machine = Machine(
        cpu=_processor(),
        flags=tuple(flag for flag in CPU_FLAGS if flag in flags),
        cores=psutil.cpu_count(logical=False) or psutil.cpu_count(),
        threads=torch.get_num_threads(),
        gpu=_gpu(device),
        software=_software(),
    )
    return Taken(machine=machine, date=datetime.now(UTC).date().isoformat(), commit=commit, modified=modified)


def peak_memory() -> float:
    """Most memory of the main store that this process has held so far, in MiB."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset / 2**20
    import resource  # not on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def checked_out(root: Path = ROOT) -> tuple[str | None, bool]:
    """Commit of the checkout at `root`, and whether its code differs from it; (None, False) where there is none."""

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=30)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    top = git("rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != root:
        return None, False
    commit = git("rev-parse", "--short=8", "HEAD")
    return commit or None, bool(commit and git("status", "--porcelain", "--", *CODE))


def _gpu(device: torch.device) -> str | None:
    if device.type != "cuda":
        return None
    p = torch.cuda.get_device_properties(device)
    return f"{p.name}, {p.total_memory / 2**30:.0f} GiB, compute capability {p.major}.{p.minor}"


def _software() -> str:
    return f"PyTorch {torch.__version__}, {platform.system()}"


def _cpuinfo(key: str) -> str:
    """What Linux says about its first processor; empty elsewhere."""
    if CPUINFO.is_file():
        for line in CPUINFO.read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == key:
                return value.strip()
    return ""


def _processor() -> str:
    return _cpuinfo("model name") or platform.processor() or platform.machine()


def run_yardstick(script: Path, seconds: float, report: Reporter) -> dict[str, Any]:
    """Run another trainer, called as `script SECONDS THREADS`, which prints one JSON object with "psnr" at its end.

    Raises:
        InputError: it is missing, fails, or prints no such object.
    """
    if not script.is_file():
        raise InputError(f"{script} is not there.", "Give the path of the yardstick script.")
    report.stage("Yardstick")
    command = [sys.executable, str(script.resolve()), f"{seconds:g}", str(default_threads())]
    begin = time.monotonic()
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", cwd=script.parent
    )
    try:
        while True:
            try:
                out, errors = process.communicate(timeout=1.0)
                break
            except subprocess.TimeoutExpired:
                report.progress(min((time.monotonic() - begin) / seconds, 1.0), script.name)
    finally:
        process.kill()
    for line in reversed(out.splitlines()):
        if line.startswith("{"):
            return json.loads(line)
    raise InputError(f"{script} printed no result: {errors.strip()[-300:] or 'nothing on stderr'}.", "Run it by hand.")
