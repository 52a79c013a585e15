"""`doctor`: is everything here that the engine needs, and does it work?"""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from .. import __version__
from ..errors import SettingError
from ..params import DoctorParams
from ..progress import Reporter

# Below these it warns; nothing is refused.
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
    ("onnxscript", "onnxscript", "onnxscript"),
    ("onnxruntime", "onnxruntime", "onnxruntime"),
]


def doctor(params: DoctorParams, report: Reporter) -> dict[str, Any]:
    """Look at the machine and try the engine's libraries.

    Returns:
        ok, device, python, torch, warp, pycolmap, blender (versions; None when absent), problems (sentences that say
        what is wrong and what to do), and more facts about the machine: backend (warp-cuda, warp-cpu, torch) and
        native_dtype (of matrix products) that training would use, notes (sentences about what is as it should be).
        Sizes in GB (10⁹ bytes).
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
    device = _device()
    result.update(device.facts)
    result["notes"] = device.notes
    problems += device.problems
    report.progress(0.5, "Warp kernels")
    # Where torch's operations are the backend, Warp still makes the kernels of the CPU.
    result["warp_cache"], problem = _warp()
    problems += problem

    result["free_disk_gb"], problem = _disk(Path.home())
    problems += problem
    report.progress(1.0)
    result["problems"] = problems
    result["ok"] = not problems
    return result


def training_memory() -> dict[str, float] | None:
    """Gigabytes of a graphics card that training with each preset takes, without the photos, which may stay outside; None
    where the engine's libraries do not load, which is told elsewhere."""
    try:
        from ..config import preset_names
        from ..train.memory_plan import preset_plans
    except (ImportError, OSError):
        return None
    return {name: round(plan.needed / 1e9, 1) for name, plan in preset_plans(preset_names()).items()}


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


@dataclass
class _Device:
    """What is known of the device: facts are keys of the result, notes what is worth knowing, problems what is wrong."""

    facts: dict[str, Any]
    notes: list[str]
    problems: list[str]


def _device() -> _Device:
    """The device that the engine would compute on, measured by using it."""
    empty = {"device": "none", "device_name": "", "gpu_memory_gb": None, "training_memory_gb": None}
    found = _Device({**empty, "backend": None, "native_dtype": None, "free_memory_gb": None}, [], [])
    try:
        import torch
    except (ImportError, OSError):
        return found
    from ..kernels.device import backend_of, choose_device, free_memory, native_half
    from ..kernels.host import default_threads

    try:
        default_threads()
        device = choose_device()
        backend = backend_of(device)
    except SettingError as error:
        found.problems.append(str(error))
        return found
    name, memory = platform.processor() or platform.machine(), None
    kind = "rocm" if device.type == "cuda" and torch.version.hip else device.type
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        name, memory = properties.name, round(properties.total_memory / 1e9, 1)
        if memory < MINIMUM_GPU_GB:
            found.problems.append(f"{name} has {memory} GB of memory. Use the draft preset, or smaller images.")
    elif device.type == "mps":
        name = "Apple GPU"
    elif shutil.which("nvidia-smi") and not torch.cuda.is_available():
        found.problems.append(
            "There is an NVIDIA driver, but torch cannot use the GPU. Install the engine again with the CUDA build, "
            "or update the driver."
        )
    elif torch.cuda.is_available() or torch.backends.mps.is_available():
        found.notes.append("FIELDWORK_DEVICE asks for the CPU although there is a GPU that torch can use.")
    found.facts |= {"device": kind, "device_name": name, "gpu_memory_gb": memory, "backend": backend.name}
    found.facts["training_memory_gb"] = training_memory()
    if not backend.warp:
        found.notes.append(
            f"{name} computes with PyTorch's own operations (backend torch): training is complete but slower than with "
            "the kernels for NVIDIA GPUs and CPUs."
        )
    try:
        found.facts["free_memory_gb"] = round(free_memory(device) / 1e9, 1)
        half = native_half(device)
        found.facts["native_dtype"] = str(half or torch.float32).removeprefix("torch.")
        a = torch.ones((64, 64), device=device)
        if float((a @ a)[0, 0]) != 64.0:
            found.problems.append(f"{name} computes wrongly. Update its driver.")
    except RuntimeError as error:
        found.problems.append(f"{name} cannot be used: {str(error).splitlines()[0]} Update its driver.")
    return found


def _warp() -> tuple[str | None, list[str]]:
    """Where Warp keeps compiled kernels; compiles and runs one."""
    try:
        import warp as wp

        from ..kernels.runtime import init
    except (ImportError, OSError):
        return None, []
    try:
        init()
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
