"""Starts the windowed Blender of a test in its own root folder (see ../shared/blender-gui)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT.parent / "shared" / "blender-gui"
BLENDER_ROOT = Path(os.environ.get("FIELDWORK_GUI_ROOT", "/var/tmp/blender-sid"))
BUILD = ROOT / "build" / "gui"
MUSEUM = BUILD / "museum"  # a small simulated capture with labels


def missing() -> str | None:
    """Why there can be no windowed Blender here."""
    if not TOOLS.is_dir():
        return f"the scripts that make a windowed Blender are not at {TOOLS}"
    if os.geteuid() != 0:
        return "a windowed Blender in its own root folder needs root"
    if not (BLENDER_ROOT / ".complete").exists():
        return f"there is no Blender root at {BLENDER_ROOT}: {TOOLS / 'make-root'} sid {BLENDER_ROOT}"
    return None


def enter(command: list[str], environment: dict[str, str], timeout: float) -> subprocess.CompletedProcess[str]:
    """Run a command inside the root, with the project, the shared data and the engine's Python at their places."""
    threads = {name: os.environ[name] for name in ("OMP_NUM_THREADS", "FIELDWORK_THREADS") if name in os.environ}
    variables = " ".join(f"{name}={value}" for name, value in {**environment, **threads}.items())
    binds = f"{ROOT.parent / 'shared'} {sys.base_prefix}"
    # The environment may be shared by several checkouts, and then is a link to a folder elsewhere.
    if not Path(sys.prefix).resolve().is_relative_to(ROOT):
        binds += f" {Path(sys.prefix).resolve()}"
    return subprocess.run(
        ["timeout", "-k", "10", str(timeout), TOOLS / "enter", BLENDER_ROOT, ROOT, *command],
        env={**os.environ, "BIND": binds, "ENTER_ENV": variables},
        capture_output=True,
        text=True,
        check=False,
    )


def simulate() -> None:
    """Make the simulated capture unless it is there."""
    if not (MUSEUM / "classes.json").is_file():
        command = [sys.executable, "-m", "nerfcore", "simulate", MUSEUM, "--views", "24", "--size", "360x240"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        subprocess.run([*command, "--samples", "8"], env=environment, check=True)


class Window:
    """One Blender with the extension installed from its built archive, with preferences of its own."""

    def __init__(self, name: str) -> None:
        self.folder = BUILD / name
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        self.environment = {
            "BLENDER_USER_RESOURCES": str(self.folder / "user"),
            "FIELDWORK_ENGINE_PYTHON": str(Path(sys.prefix) / "bin" / "python"),
            "FIELDWORK_MUSEUM": str(MUSEUM),
            "FIELDWORK_BASE_PYTHON": str(Path(sys.base_prefix) / "bin" / "python3"),
        }
        build, out = BUILD / "zip", ""
        build.mkdir(parents=True, exist_ok=True)
        for arguments in (
            ["build", "--source-dir", str(ROOT), "--output-filepath", str(build / f"{name}.zip")],
            ["install-file", "-r", "user_default", "-e", str(build / f"{name}.zip")],
        ):
            done = enter(["blender", "--command", "extension", *arguments], self.environment, 120)
            out += done.stdout + done.stderr
            assert done.returncode == 0, out

    def play(self, scenario: str, timeout: float = 300) -> dict:
        """Drive a scenario; returns its facts. Fails with its traceback and Blender's output."""
        result = self.folder / "result.json"
        result.unlink(missing_ok=True)
        done = enter(
            [
                *[str(TOOLS / "with-display"), "blender", "--factory-startup", "-noaudio", "--gpu-backend", "opengl"],
                "--enable-event-simulate",
                *[
                    "--window-geometry",
                    "0",
                    "0",
                    "1920",
                    "1080",
                    "--python",
                    str(Path(__file__).with_name("driver.py")),
                ],
                *["--", scenario, str(self.folder)],
            ],
            self.environment,
            timeout,
        )
        (self.folder / "blender.log").write_text(done.stdout + done.stderr)
        assert result.is_file(), (
            f"{scenario} did not end (status {done.returncode}): {(done.stdout + done.stderr)[-3000:]}"
        )
        facts = json.loads(result.read_text())
        assert not facts["error"], f"{facts['error']}\nscreenshots: {self.folder}"
        return facts
