"""How the engine's own Python gets to its place (see place.py). Standard library only, no bpy: it runs in a
thread."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import EngineError
from .in_use import is_used
from .link import Link
from .only_one import forget, only_one
from .place import (
    COMPLETE,
    DOWNLOADS,
    ENVIRONMENTS,
    LOCK,
    LOG,
    STAGING,
    environment,
    installed,
    lock_hash,
    next_environment,
    python_in,
    read_json,
)
from .tools import InstallCancelled, InstallError, Report, Runner

NEEDED_GB = {"cpu": 4.0, "mps": 4.0}  # free disk; builds for graphics cards bring their libraries along
NEEDED_GPU_GB = 12.0


@dataclass(frozen=True)
class Options:
    """`base`: Python that the environment is made from. `device`: auto, cuda, rocm, mps or cpu. `wheels`: folder of
    package files to be used besides the index, or instead of it when not `online`; may be empty."""

    folder: Path
    base: Path
    device: str = "auto"
    wheels: str = ""
    online: bool = True


def remove(folder: Path) -> None:
    """Remove the engine and its downloads. Raises InstallError while another Blender installs it, or something runs on it."""
    with only_one(folder):
        for name in ENVIRONMENTS:
            _check_unused(folder / name, "Remove")
        for name in (COMPLETE, STAGING):
            (folder / name).unlink(missing_ok=True)
        places = [folder / name for name in (*ENVIRONMENTS, *DOWNLOADS)]
        for place in places:
            shutil.rmtree(place, ignore_errors=True)
        for place in places:
            if place.exists() and not place.is_symlink():
                raise InstallError(f"{place} is in use. Close other Blenders, then press Remove again.")


def _check_unused(venv: Path, button: str) -> None:
    if is_used(venv):
        raise InstallError(
            f"The engine in {venv} runs for another Blender, or for a job that goes on without one. Wait until that has "
            f"ended, or stop it, then press {button} again."
        )


def install(options: Options, report: Report, cancelled: threading.Event, lock: Path = LOCK) -> dict[str, Any]:
    """Install or repair the engine. One that works stays in its place until the new one does.

    Returns:
        what the doctor found.
    Raises:
        InstallError: with what to do about it.
        InstallCancelled: `cancelled` was set; running it again goes on.
    """
    with only_one(options.folder):
        return _install(options, report, cancelled, lock)


def _install(options: Options, report: Report, cancelled: threading.Event, lock: Path) -> dict[str, Any]:
    folder = options.folder
    _check_disk(options)
    venv, before = next_environment(folder), environment(folder)
    with open(folder / LOG, "w", encoding="utf-8") as log:
        run = Runner(log, cancelled, report)
        report(0.01, "Looking at Python")
        _check_device(options.device)
        _check_base(options.base, run)
        uv = _find_uv(options, run)
        _make_environment(options, venv, uv, run)
        report(0.1, "Loading packages")
        run(_install_command(options, uv, lock, venv), "The packages could not be installed", packages=_count(lock))
        report(0.92, "Checking the engine")
        try:
            result = _doctor(python_in(venv), folder)
            _check_doctor(result, options)
        except InstallError:
            # A package that a kill left half there, or the build for another device: the installers take both for installed.
            (folder / STAGING).unlink(missing_ok=True)
            raise
    text = {"lock": lock_hash(lock), "time": time.time(), "venv": venv.name, "doctor": result}
    temporary = folder / (COMPLETE + ".part")
    temporary.write_text(json.dumps(text, indent=1), encoding="utf-8")
    os.replace(temporary, folder / COMPLETE)
    (folder / STAGING).unlink(missing_ok=True)
    if before != venv and not is_used(before):  # else it is left for the next time: jobs that run on it go on
        forget(before)
    report(1.0, "The engine is installed")
    return result


def _make_environment(options: Options, venv: Path, uv: Path | None, run: Runner) -> None:
    """An empty environment, or the one of an installation with the same options that broke off."""
    note = options.folder / STAGING
    made = {"venv": venv.name, "base": str(options.base), "device": options.device, "wheels": options.wheels}
    if read_json(note) == made and python_in(venv).is_file():
        return
    run.report(0.08, "Making the environment")
    _check_unused(venv, "Repair")
    note.unlink(missing_ok=True)
    shutil.rmtree(venv, ignore_errors=True)
    if venv.exists():
        raise InstallError(f"{venv} is in use. Close other Blenders, then press Repair again.")
    how = [uv, "venv", "--no-config", "--python", options.base] if uv else [options.base, "-m", "venv"]
    run([*how, venv], "The environment cannot be made")
    note.write_text(json.dumps(made), encoding="utf-8")


def _check_disk(options: Options) -> None:
    free = shutil.disk_usage(options.folder).free / 1e9
    needed = NEEDED_GB.get(options.device, 4.0 if options.device == "auto" and not _has_gpu() else NEEDED_GPU_GB)
    # What a broken installation has loaded already counts; one that works stays beside the new one.
    works = environment(options.folder) if installed(options.folder) else None
    files = (f for f in options.folder.rglob("*") if f.is_file() and not f.is_symlink())
    there = sum(f.stat().st_size for f in files if works is None or works not in f.parents) / 1e9
    if free + there < needed:
        raise InstallError(
            f"The disk of {options.folder} has {free:.1f} GB free; the engine needs about {needed:.0f} GB. Free some "
            "space, or choose an existing environment."
        )


def _has_gpu() -> bool:
    return shutil.which("nvidia-smi") is not None or Path("/dev/kfd").exists()


def _check_base(base: Path, run: Runner) -> None:
    """The base must be a Python that the packages exist for."""
    code = (
        "import platform, struct, sys; "
        "print(sys.version_info[0], sys.version_info[1], struct.calcsize('P') * 8, platform.machine())"
    )
    said = run([base, "-I", "-c", code], f"{base} is not a Python").splitlines()
    words = said[-1].split() if said else []  # what it warns of comes before
    if len(words) < 3 or not all(word.isdecimal() for word in words[:3]):
        raise InstallError(f"{base} is not a Python. Choose another Base Python.")
    version = (int(words[0]), int(words[1]))
    if version < (3, 11) or words[2] != "64":
        raise InstallError(
            f"{base} is Python {version[0]}.{version[1]}, {words[2]} bits; the engine needs 3.11 or newer with 64 bits. "
            "Choose another Base Python."
        )
    if sys.platform == "darwin" and words[3:] == ["x86_64"]:
        raise InstallError(
            f"{base} is a Python for Macs with Intel processors, which PyTorch no longer has builds for. Reconstruct on "
            "another computer, or choose a Base Python for Apple silicon if this Mac has it."
        )


def _find_uv(options: Options, run: Runner) -> Path | None:
    """The installer `uv`: the machine's, or one of our own; None where only pip will do."""
    found = shutil.which("uv")
    # An old one cannot choose among the builds of PyTorch.
    if found and "--torch-backend" in _help_of(found, run):
        return Path(found)
    tools = options.folder / "tools"
    name = "uv.exe" if sys.platform == "win32" else "uv"
    own = python_in(tools).with_name(name)
    if own.is_file():
        return own
    run.report(0.03, "Getting the installer")
    try:
        run([options.base, "-m", "venv", tools], "no environment for the installer")
        run([python_in(tools), "-m", "pip", "install", *_index(options, "pip"), "uv"], "no installer")
    except InstallError as error:
        run.log.write(f"going on with pip: {error}\n")
        return None
    return own


def _help_of(uv: str, run: Runner) -> str:
    """What an `uv` says of its way to install; nothing where it does not run, as the stub of a version manager may not."""
    try:
        return run([uv, "pip", "install", "--help"], "uv does not run")
    except InstallError as error:
        run.log.write(f"going on without {uv}: {error}\n")
        return ""


def _check_device(device: str) -> None:
    """Whether PyTorch has builds for the device on this system at all."""
    systems = {"cuda": ("linux", "win32"), "rocm": ("linux",), "mps": ("darwin",)}
    if sys.platform not in systems.get(device, (sys.platform,)):
        names = {"linux": "Linux", "win32": "Windows", "darwin": "macOS"}
        where = " and ".join(names[system] for system in systems[device])
        raise InstallError(
            f"PyTorch has builds for {device.upper()} on {where} only. Choose “Automatic” or “CPU” as the device."
        )


def torch_backend(device: str) -> str | None:
    """What tells uv which build of PyTorch to take; None where there is but one.

    "auto" looks at the driver of the graphics card: NVIDIA's or AMD's, in its version. That the build runs on the
    device that was asked for is seen by the doctor afterwards.
    """
    if sys.platform == "darwin":
        return None
    return "cpu" if device == "cpu" else "auto"


def pip_can(device: str) -> bool:
    """Whether the one build that pip takes suits the device: on Linux it is CUDA's, on Windows that for the CPU."""
    if sys.platform == "darwin":
        return True
    if sys.platform == "win32":
        return device == "cpu" or (device == "auto" and not _has_gpu())
    return device in ("cpu", "cuda") or (device == "auto" and not Path("/dev/kfd").exists())


def _install_command(options: Options, uv: Path | None, lock: Path, venv: Path) -> list[Any]:
    python = python_in(venv)
    if uv is None:
        if not options.wheels and not pip_can(options.device):
            raise InstallError(
                "The build of PyTorch for this graphics card needs the installer uv, which could not be had (see the "
                "log). Install uv, or choose “CPU” as the device."
            )
        return [python, "-m", "pip", "install", *_index(options, "pip"), "-r", lock]
    command = [uv, "pip", "install", "--no-config", "--python", python, "--compile-bytecode"]
    # Wheels on the disk are one certain build.
    backend = None if options.wheels else torch_backend(options.device)
    if backend is not None:
        command += ["--torch-backend", backend]
    return [*command, *_index(options, "uv"), "-r", lock]


def _index(options: Options, tool: str) -> list[str]:
    arguments = ["--find-links", options.wheels] if options.wheels else []
    if not options.online:
        arguments += ["--no-index"] + (["--offline"] if tool == "uv" else [])
    return arguments


def _count(lock: Path) -> int:
    return sum(bool(re.match(r"[A-Za-z]", line)) for line in lock.read_text(encoding="utf-8").splitlines())


def _doctor(python: Path, folder: Path) -> dict[str, Any]:
    link = Link(python, folder / "doctor.log")
    try:
        return link.run_blocking("doctor", {})
    except EngineError as error:
        raise InstallError(f"The engine does not run: {error}. Press Repair.") from error
    finally:
        link.close(timeout=5.0)


def _check_doctor(result: dict[str, Any], options: Options) -> None:
    if not result.get("ok"):
        raise InstallError("The engine is not in order: " + " ".join(result.get("problems", [])))
    expected, found = options.device, result.get("device")
    if expected in ("cuda", "rocm", "mps") and found != expected:
        raise InstallError(
            f"The engine runs on {found}, not on {expected}: update the driver of the graphics card, or choose "
            "another device."
        )


class Installer(threading.Thread):
    """One installation in the background; its fields may be read at any time."""

    def __init__(self, options: Options) -> None:
        super().__init__(name="fieldwork-install", daemon=True)
        self.options = options
        self.fraction, self.message, self.error = 0.0, "", ""
        self.result: dict[str, Any] | None = None
        self.cancelled = threading.Event()

    def run(self) -> None:
        try:
            self.result = install(self.options, self._report, self.cancelled)
        except InstallCancelled:
            self.error = "Stopped. Press Install to go on."
        except (InstallError, OSError) as error:
            self.error = str(error)
        except Exception as error:  # noqa: BLE001 - of a thread that just ends nobody would hear
            self.error = f"{type(error).__name__}: {error}"

    def _report(self, fraction: float, message: str) -> None:
        self.fraction, self.message = fraction, message


def default_base() -> Path:
    """Python that Blender runs on."""
    return Path(sys.executable)
