"""Where the engine's own Python lives, and how it gets there. Standard library only, no bpy: it runs in a thread.

ENGINE/venv/           the environment, made from Blender's Python or a chosen one, which stays untouched
ENGINE/tools/          the installer `uv`, where the machine has none
ENGINE/cache/          downloads; an installation that broke off goes on from here
ENGINE/complete.json   written last, when the doctor was content
ENGINE/install.log     everything the tools said
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from .link import EngineError, Link

ENVIRONMENT = "FIELDWORK_ENGINE_PYTHON"
COMPLETE = "complete.json"
LOG = "install.log"
LOCK = Path(__file__).with_name("engine.lock")
NEEDED_GB = {"cpu": 4.0, "mps": 4.0}  # free disk; builds for graphics cards bring their libraries along
NEEDED_GPU_GB = 12.0
Report = Callable[[float, str], None]


class InstallError(Exception):
    """The installation cannot go on; the text says why and what to do."""


class InstallCancelled(Exception):
    """The user asked to stop."""


@dataclass(frozen=True)
class Options:
    """`base`: Python that the environment is made from. `device`: auto, cuda, rocm, mps or cpu. `wheels`: folder of
    package files to be used besides the index, or instead of it when not `online`; may be empty."""

    folder: Path
    base: Path
    device: str = "auto"
    wheels: str = ""
    online: bool = True


def python_in(folder: Path) -> Path:
    """The interpreter of a virtual environment."""
    return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"


def find_python(chosen: str, engine_folder: Path, root: Path) -> Path | None:
    """The Python that runs the engine: the environment's, the chosen one (a file, or the folder of a virtual
    environment), the installed engine's, or that of a source checkout. None when there is none."""
    from_environment = os.environ.get(ENVIRONMENT)
    if from_environment:
        return Path(from_environment)
    if chosen:
        path = Path(chosen).expanduser()
        return python_in(path) if path.is_dir() else path
    if installed(engine_folder):
        return python_in(engine_folder / "venv")
    checkout = python_in(root / ".venv")
    return checkout if checkout.is_file() else None


def installed(folder: Path) -> dict[str, Any] | None:
    """What is known of the installed engine; None when there is none, or only a part of one."""
    try:
        value = json.loads((folder / COMPLETE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return value if python_in(folder / "venv").is_file() else None


def lock_hash() -> str:
    return hashlib.sha256(LOCK.read_bytes()).hexdigest()


def up_to_date(folder: Path) -> bool:
    """Whether the installed engine has the versions of this extension."""
    return (installed(folder) or {}).get("lock") == lock_hash()


def remove(folder: Path) -> None:
    """Remove the engine and its downloads."""
    (folder / COMPLETE).unlink(missing_ok=True)
    for name in ("venv", "tools", "cache"):
        shutil.rmtree(folder / name, ignore_errors=True)


def install(options: Options, report: Report, cancelled: threading.Event, lock: Path = LOCK) -> dict[str, Any]:
    """Install or repair the engine; what is there already is kept.

    Returns:
        what the doctor found.
    Raises:
        InstallError: with what to do about it.
        InstallCancelled: `cancelled` was set; running it again goes on.
    """
    folder = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    (folder / COMPLETE).unlink(missing_ok=True)
    _check_disk(options)
    with open(folder / LOG, "w", encoding="utf-8") as log:
        run = Runner(log, cancelled, report)
        report(0.01, "Looking at Python")
        _check_base(options.base, run)
        uv = _find_uv(options, run)
        venv = folder / "venv"
        if not python_in(venv).is_file():
            report(0.08, "Making the environment")
            shutil.rmtree(venv, ignore_errors=True)
            if uv:
                run([uv, "venv", "--no-config", "--python", options.base, venv], "The environment cannot be made")
            else:
                run([options.base, "-m", "venv", venv], "The environment cannot be made")
        report(0.1, "Loading packages")
        run(_install_command(options, uv, lock), "The packages could not be installed", packages=_count(lock))
        report(0.92, "Checking the engine")
        result = _doctor(python_in(venv), folder)
        _check_doctor(result, options)
    text = {"lock": hashlib.sha256(lock.read_bytes()).hexdigest(), "time": time.time(), "doctor": result}
    temporary = folder / (COMPLETE + ".part")
    temporary.write_text(json.dumps(text, indent=1), encoding="utf-8")
    os.replace(temporary, folder / COMPLETE)
    report(1.0, "The engine is installed")
    return result


class Runner:
    """Runs the tools: their words go to the log and, in short, to the user; ends them when cancelled."""

    def __init__(self, log: IO[str], cancelled: threading.Event, report: Report) -> None:
        self.log, self.cancelled, self.report = log, cancelled, report

    def __call__(self, command: list[Any], failure: str, packages: int = 0) -> str:
        """Run to the end and return the output. `packages`: how many are expected, for the progress.

        Raises:
            InstallError: `failure` and the last line the tool said.
            InstallCancelled.
        """
        if self.cancelled.is_set():
            raise InstallCancelled
        words = [str(word) for word in command]
        self.log.write("> " + " ".join(words) + "\n")
        self.log.flush()
        options: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            options = {"creationflags": subprocess.CREATE_NO_WINDOW}
        try:
            process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                encoding="utf-8", errors="replace", env=_environment(self.log), **options,
            )  # fmt: skip
        except OSError as error:
            raise InstallError(f"{failure}: {words[0]} cannot be run: {error}.") from error
        watcher = threading.Thread(target=self._watch, args=(process,), daemon=True)
        watcher.start()
        lines: list[str] = []
        done = 0
        assert process.stdout is not None
        for line in process.stdout:
            self.log.write(line)
            self.log.flush()
            lines.append(line.strip())
            done += bool(re.match(r"\s*(Downloaded|Collecting|Built)\b", line))
            if packages and line.strip():
                # uv names only the large downloads, then what it has prepared.
                share = 0.9 if line.lstrip().startswith(("Prepared", "Installed", "+")) else min(done / packages, 0.85)
                self.report(0.1 + 0.8 * share, line.strip()[:80])
        status = process.wait()
        if self.cancelled.is_set():
            raise InstallCancelled
        if status:
            told = [line for line in lines if line]
            reason = next((line for line in told if line.lower().startswith("error")), told[-1] if told else "")
            raise InstallError(
                f"{failure}. {reason[:300].rstrip('.')}. Press Install again to go on; what was loaded is kept. "
                "If it fails again, see the log."
            )
        return "\n".join(lines)

    def _watch(self, process: subprocess.Popen[str]) -> None:
        while process.poll() is None:
            if self.cancelled.wait(0.2):
                _kill_tree(process)
                return


def _kill_tree(process: subprocess.Popen[str]) -> None:
    """End a tool and what it started: pip builds and downloads in processes of its own."""
    if sys.platform == "win32":
        command = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
        subprocess.run(command, capture_output=True, check=False, creationflags=subprocess.CREATE_NO_WINDOW)
        return
    with contextlib.suppress(ProcessLookupError):  # it has just ended
        os.killpg(process.pid, signal.SIGKILL)


def _environment(log: IO[str]) -> dict[str, str]:
    """No user site, no settings of another environment, downloads in the engine's own folder."""
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "VIRTUAL_ENV")}
    env["PYTHONNOUSERSITE"] = "1"
    env["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    env["UV_CACHE_DIR"] = str(Path(log.name).with_name("cache"))
    env["UV_PYTHON_DOWNLOADS"] = "never"
    env["UV_HTTP_TIMEOUT"] = "120"
    return env


def _check_disk(options: Options) -> None:
    free = shutil.disk_usage(options.folder).free / 1e9
    needed = NEEDED_GB.get(options.device, 4.0 if options.device == "auto" and not _has_gpu() else NEEDED_GPU_GB)
    # What a broken installation has loaded already counts.
    there = sum(f.stat().st_size for f in options.folder.rglob("*") if f.is_file() and not f.is_symlink()) / 1e9
    if free + there < needed:
        raise InstallError(
            f"The disk of {options.folder} has {free:.1f} GB free; the engine needs about {needed:.0f} GB. Free some "
            "space, or choose an existing environment."
        )


def _has_gpu() -> bool:
    return shutil.which("nvidia-smi") is not None or Path("/dev/kfd").exists()


def _check_base(base: Path, run: Runner) -> None:
    """The base must be a Python that the packages exist for."""
    code = "import sys, struct; print(sys.version_info[0], sys.version_info[1], struct.calcsize('P') * 8)"
    words = run([base, "-I", "-c", code], f"{base} is not a Python").split()
    version = (int(words[0]), int(words[1]))
    if version < (3, 11) or words[2] != "64":
        raise InstallError(
            f"{base} is Python {version[0]}.{version[1]}, {words[2]} bits; the engine needs 3.11 or newer with 64 bits. "
            "Choose another Base Python."
        )


def _find_uv(options: Options, run: Runner) -> Path | None:
    """The installer `uv`: the machine's, or one of our own; None where only pip will do."""
    found = shutil.which("uv")
    if found:
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


def _install_command(options: Options, uv: Path | None, lock: Path) -> list[Any]:
    python = python_in(options.folder / "venv")
    if uv is None:
        return [python, "-m", "pip", "install", *_index(options, "pip"), "-r", lock]
    command = [uv, "pip", "install", "--no-config", "--python", python, "--compile-bytecode"]
    # Wheels on the disk are one certain build; else uv looks at the driver for the build that fits.
    if not options.wheels and options.device != "mps":
        command += ["--torch-backend", "cpu" if options.device == "cpu" else "auto"]
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

    def _report(self, fraction: float, message: str) -> None:
        self.fraction, self.message = fraction, message


def default_base() -> Path:
    """Python that Blender runs on."""
    return Path(sys.executable)
