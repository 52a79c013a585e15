"""`doctor`: is everything here that the engine needs, and does it work?"""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from .. import __version__
from ..params import DoctorParams
from ..progress import Reporter

MINIMUM_DISK_GB = 2.0
MINIMUM_GPU_GB = 4.0
INSTALL_HINT = "Repair the engine in the preferences, or run `make venv` again."

# Distribution name, module to import, key of the result. pycolmap carries its own zlib: Python's comes first.
LIBRARIES = [
    ("numpy", "numpy", "numpy"),
    ("torch", "torch", "torch"),
    ("warp-lang", "warp", "warp"),
    ("OpenImageIO", "OpenImageIO", "openimageio"),
    ("pycolmap", "pycolmap", "pycolmap"),
    ("av", "av", "av"),
    ("pillow-heif", "pillow_heif", "pillow_heif"),
    ("scikit-image", "skimage", "scikit_image"),
    ("trimesh", "trimesh", "trimesh"),
    ("xatlas", "xatlas", "xatlas"),
    ("safetensors", "safetensors", "safetensors"),
    ("rawpy", "rawpy", "rawpy"),
    ("fast-simplification", "fast_simplification", "fast_simplification"),
    ("onnx", "onnx", "onnx"),
]


def doctor(params: DoctorParams, report: Reporter) -> dict[str, Any]:
    """Look at the machine and try the engine's libraries.

    Returns:
        ok, device, python, torch, warp, pycolmap, blender (versions; None when absent), problems (sentences that say
        what is wrong and what to do), and more facts about the machine. Sizes in GB (10⁹ bytes).
    """
    problems: list[str] = []
    result: dict[str, Any] = {
        "ok": False,
        "version": __version__,
        "python": platform.python_version(),
        "executable": sys.executable,
        "system": platform.platform(),
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
    }
    report.stage("Checking libraries")
    for number, (distribution, module, key) in enumerate(LIBRARIES):
        report.progress(number / len(LIBRARIES), distribution)
        result[key], problem = _library(distribution, module)
        problems += problem
    result["blender"] = _blender()

    report.stage("Checking the device")
    result["device"], result["device_name"], result["gpu_memory_gb"], problem = _device()
    problems += problem
    report.progress(0.5, "Warp kernels")
    result["warp_cache"], problem = _warp()
    problems += problem

    result["free_disk_gb"], problem = _disk(Path.home())
    problems += problem
    report.progress(1.0)
    result["problems"] = problems
    result["ok"] = not problems
    return result


def _library(distribution: str, module: str) -> tuple[str | None, list[str]]:
    try:
        version = metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None, [f"{distribution} is not installed. {INSTALL_HINT}"]
    import zlib  # noqa: F401 - before pycolmap

    try:
        importlib.import_module(module)
    except Exception as error:  # noqa: BLE001 - a broken native library may raise anything
        return version, [f"{distribution} {version} does not load: {error}. {INSTALL_HINT}"]
    return version, []


def _blender() -> str | None:
    """Version of pip's bpy beside the engine, else of a Blender on the path."""
    try:
        return metadata.version("bpy")
    except metadata.PackageNotFoundError:
        return shutil.which("blender")


def _device() -> tuple[str, str, float | None, list[str]]:
    """Device for training, its name, its memory in GB, and what is wrong with it (measured by using it)."""
    try:
        import torch
    except (ImportError, OSError):
        return "none", "", None, []
    name, memory, device = platform.processor() or platform.machine(), None, "cpu"
    problems = []
    if torch.cuda.is_available():
        device = "rocm" if torch.version.hip else "cuda"
        name = torch.cuda.get_device_name(0)
        memory = round(torch.cuda.get_device_properties(0).total_memory / 1e9, 1)
        if memory < MINIMUM_GPU_GB:
            problems.append(f"{name} has {memory} GB of memory. Use the draft preset, or smaller images.")
    elif torch.backends.mps.is_available():
        device, name = "mps", "Apple GPU"
    elif shutil.which("nvidia-smi"):
        problems.append(
            "There is an NVIDIA driver, but torch cannot use the GPU. Install the engine again with the CUDA build, "
            "or update the driver."
        )
    try:
        a = torch.ones((64, 64), device="cuda" if device == "rocm" else device)
        if float((a @ a)[0, 0]) != 64.0:
            problems.append(f"{name} computes wrongly. Update its driver.")
    except RuntimeError as error:
        problems.append(f"{name} cannot be used: {str(error).splitlines()[0]} Update its driver.")
    return device, name, memory, problems


def _warp() -> tuple[str | None, list[str]]:
    """Where Warp keeps compiled kernels; compiles and runs one."""
    try:
        import warp as wp
    except (ImportError, OSError):
        return None, []
    try:
        wp.config.log_level = 30  # warnings; its greeting would go to stdout
        wp.init()
        from ..kernels.probe import check_warp

        wrong = check_warp()
    except Exception as error:  # noqa: BLE001 - the kernel compiler may raise anything
        return None, [f"Warp cannot compile kernels: {error}. {INSTALL_HINT}"]
    return str(wp.config.kernel_cache_dir), [f"Warp computes wrongly. {INSTALL_HINT}"] if wrong else []


def _disk(folder: Path) -> tuple[float, list[str]]:
    free = round(shutil.disk_usage(folder).free / 1e9, 1)
    if free < MINIMUM_DISK_GB:
        return free, [f"Only {free} GB are free on the disk of {folder}. Free some space."]
    return free, []
