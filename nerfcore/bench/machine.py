"""What the figures were taken on, and the yardstick that may run beside them."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError
from ..kernels.device import default_threads, use_device
from ..progress import Reporter


def describe() -> str:
    """Name of the device, its threads, and the versions that matter."""
    device = use_device()
    if device.type == "cuda":
        p = torch.cuda.get_device_properties(device)
        what = f"{p.name}, {p.total_memory / 2**30:.0f} GiB, compute capability {p.major}.{p.minor}"
    else:
        what = f"{_processor()}, threads: {torch.get_num_threads()}"
    return f"{what}; PyTorch {torch.__version__}, {platform.system()}"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


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
