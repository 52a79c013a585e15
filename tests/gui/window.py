"""Starts the windowed Blender of a test in its own root folder (see ../shared/blender-gui)."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT.parent / "shared" / "blender-gui"
BLENDER_ROOT = Path(os.environ.get("FIELDWORK_GUI_ROOT", "/var/tmp/blender-sid"))
OLDER_ROOT = Path(os.environ.get("FIELDWORK_GUI_OLDER_ROOT", "/var/tmp/blender-trixie"))  # Blender 4.3
BUILD = ROOT / "build" / "gui"
PATIENCE = float(os.environ.get("FIELDWORK_GUI_PATIENCE", "1"))  # factor of all waiting, for a machine under load
SOFTWARE_VULKAN = "usr/share/vulkan/icd.d/lvp_icd.json"
MUSEUM = BUILD / "museum"  # a small simulated capture with labels


def missing(root: Path = BLENDER_ROOT, suite: str = "sid") -> str | None:
    """Why there can be no windowed Blender here."""
    if not TOOLS.is_dir():
        return f"the scripts that make a windowed Blender are not at {TOOLS}"
    if os.geteuid() != 0:
        return "a windowed Blender in its own root folder needs root"
    if not (root / ".complete").exists():
        return f"there is no Blender root at {root}: {TOOLS / 'make-root'} {suite} {root}"
    return None


def missing_vulkan(root: Path = BLENDER_ROOT) -> str | None:
    """Why no Blender in a root can draw by Vulkan here, which is software as well."""
    if not (root / SOFTWARE_VULKAN).is_file():
        return f"there is no software Vulkan in {root}: chroot {root} apt-get install mesa-vulkan-drivers"
    return None


def enter(
    command: list[str], environment: dict[str, str], timeout: float, root: Path = BLENDER_ROOT
) -> subprocess.CompletedProcess[str]:
    """Run a command inside the root, with the project, the shared data and the engine's Python at their places."""
    threads = {name: os.environ[name] for name in ("OMP_NUM_THREADS", "FIELDWORK_THREADS") if name in os.environ}
    variables = " ".join(f"{name}={value}" for name, value in {**environment, **threads}.items())
    binds = f"{ROOT.parent / 'shared'} {sys.base_prefix}"
    # The environment may be shared by several checkouts, and then is a link to a folder elsewhere.
    if not Path(sys.prefix).resolve().is_relative_to(ROOT):
        binds += f" {Path(sys.prefix).resolve()}"
    return subprocess.run(
        ["timeout", "-k", "10", str(timeout), TOOLS / "enter", root, ROOT, *command],
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
    """A Blender with preferences of its own, and the extension installed from its built archive.

    `install=False`: the archive is built (its path is in FIELDWORK_ZIP), but not installed.
    """

    def __init__(self, name: str, root: Path = BLENDER_ROOT, install: bool = True) -> None:
        self.folder, self.root = BUILD / name, root
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        build = BUILD / "zip"
        build.mkdir(parents=True, exist_ok=True)
        archive = build / f"{name}.zip"
        self.environment = {
            "BLENDER_USER_RESOURCES": str(self.folder / "user"),
            "FIELDWORK_ENGINE_PYTHON": str(Path(sys.prefix) / "bin" / "python"),
            "FIELDWORK_MUSEUM": str(MUSEUM),
            "FIELDWORK_BASE_PYTHON": str(Path(sys.base_prefix) / "bin" / "python3"),
            "FIELDWORK_ZIP": str(archive),
            "FIELDWORK_GUI_PATIENCE": str(PATIENCE),
        }
        steps = [["build", "--source-dir", str(ROOT), "--output-filepath", str(archive)]]
        if install:
            steps.append(["install-file", "-r", "user_default", "-e", str(archive)])
        for arguments in steps:
            done = enter(["blender", "--command", "extension", *arguments], self.environment, 120, root)
            assert done.returncode == 0, done.stdout + done.stderr

    def play(
        self, *scenarios: str, timeout: float = 300, size: tuple[int, int] = (1920, 1080), backend: str = "opengl"
    ) -> dict:
        """Drive scenarios one after the other, each in a Blender of its own whose window lies at the lower left corner of the
        screen; returns the facts of the last.

        Fails with the traceback of the scenario and Blender's output.
        """
        blender = ["blender", "--factory-startup", "-noaudio", "--gpu-backend", backend, "--enable-event-simulate"]
        blender += ["--window-geometry", "0", "0", *map(str, size)]
        blender += ["--python", str(ROOT / "tests" / "gui" / "driver.py")]
        runs = [shlex.join([*blender, "--", scenario, str(self.folder)]) for scenario in scenarios]
        for scenario in scenarios:
            (self.folder / f"{scenario}.json").unlink(missing_ok=True)
        command = [str(TOOLS / "with-display"), "sh", "-c", "; ".join(runs)]
        done = enter(command, self.environment, timeout * PATIENCE, self.root)
        output = done.stdout + done.stderr
        (self.folder / "blender.log").write_text(output)
        facts = {}
        for scenario in scenarios:
            result = self.folder / f"{scenario}.json"
            assert result.is_file(), f"{scenario} did not end (status {done.returncode}): {output[-3000:]}"
            facts = json.loads(result.read_text())
            assert not facts["error"], f"{facts['error']}\nscreenshots: {self.folder}"
        # Panels that fail while they are drawn say so nowhere else.
        assert "Traceback" not in output, output[output.index("Traceback") :][:3000]
        return facts
