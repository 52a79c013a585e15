"""The extension in every supported Blender: build the zip, then install, use, disable and uninstall it in each.

    .venv/bin/python tests/addon/matrix.py [--only 5.0.1 …] [--no-window] [--renders]

The bpy wheels go into venvs/bpy-<version> (made when missing; each needs 1 GB). Windowed Blenders are used where
../shared/blender-gui can build them (root, Debian). With --renders, the tests of the render engine (cameras, passes,
Cryptomattes, objects, dead engines) run in each wheel as well, minutes a version. Prints a table; the exit status is the
number of failures.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from fieldwork.nerfcore.blender.package import write_package
from fieldwork.nerfcore.blender.simulate import simulate
from fieldwork.nerfcore.data.scene import ClassInfo, Scene, View
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.params import SimulateParams
from fieldwork.nerfcore.progress import Reporter
from PIL import Image
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
WORKER = Path(__file__).with_name("matrix_worker.py")
RENDERS = (
    "test_render_lenses.py",
    "test_render_passes.py",
    "test_render_engine.py",
    "test_field_with_objects.py",
    "test_field_shadows.py",
    "test_edited_things.py",
)
WHEELS = {"4.2.0": "3.11", "4.5.15": "3.11", "5.0.1": "3.11", "5.2.3": "3.13"}
WINDOWED = {"sid": "/var/tmp/blender-sid", "trixie": "/var/tmp/blender-trixie"}
GUI = ROOT.parent / "shared" / "blender-gui"


def find_python(version: str) -> str | None:
    """A Python of a minor version: on the PATH, from pyenv, or from uv."""
    found = shutil.which(f"python{version}")
    if found and subprocess.run([found, "-c", ""], capture_output=True).returncode == 0:
        return found
    installed = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    if installed:
        return str(installed[-1])
    if shutil.which("uv"):
        done = subprocess.run(["uv", "python", "find", version], capture_output=True, text=True)
        return done.stdout.strip() or None
    return None


def wheel_python(version: str) -> Path | str:
    """The Python of venvs/bpy-<version>, made when missing; a sentence when that is not possible."""
    folder = ROOT / "venvs" / f"bpy-{version}"
    python = folder / "bin" / "python"
    if python.is_file() and subprocess.run([python, "-c", "import bpy, os; os._exit(0)"]).returncode == 0:
        return python
    base = find_python(WHEELS[version])
    if base is None:
        return f"no Python {WHEELS[version]} on this machine"
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([base, "-m", "venv", folder], check=True)
    done = subprocess.run([python, "-m", "pip", "install", "-q", f"bpy=={version}"], capture_output=True, text=True)
    return python if done.returncode == 0 else f"pip could not install bpy {version}: {done.stderr.strip()[-200:]}"


def extension_tool(python: Path) -> Path:
    """Blender's own program for packages, which works without Blender."""
    code = "import importlib.util as u; print(*u.find_spec('bpy').submodule_search_locations)"
    place = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    return next(Path(place).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))


def renders(python: Path) -> dict[str, Any]:
    """The tests of the render engine in a wheel, which reads its files with OpenImageIO; the engine is this Python's."""
    subprocess.run([python, "-m", "pip", "install", "-q", "OpenImageIO"], check=True, capture_output=True)
    environment = {**os.environ, "FIELDWORK_BPY_PYTHON": str(python)}
    command = [sys.executable, "-m", "pytest", "-q", "-s", *(str(ROOT / "tests/addon" / name) for name in RENDERS)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    if done.returncode != 0:
        return {"ok": False, "error": "a test of the render engine failed", "log": done.stdout + done.stderr}
    return {"renders": done.stdout.strip().splitlines()[-1].split(" in ")[0]}


def build_zip(python: Path, out: Path) -> Path:
    """Validate the manifest, build the zip into `out` and validate it in turn."""
    out.mkdir(parents=True, exist_ok=True)
    tool = [python, extension_tool(python)]
    for old in out.glob("fieldwork-*.zip"):
        old.unlink()
    for command in (["validate", ROOT], ["build", "--source-dir", ROOT, "--output-dir", out]):
        subprocess.run([*tool, *command], check=True, stdout=subprocess.DEVNULL)
    built = next(out.glob("fieldwork-*.zip"))
    subprocess.run([*tool, "validate", built], check=True, stdout=subprocess.DEVNULL)
    return built


def make_package(folder: Path) -> Path:
    """A tiny capture prepared for Blender: two photos and a cube of two classes."""
    camera = Camera(width=48, height=32, fx=40, fy=40, cx=24, cy=16)
    views = []
    for index in range(2):
        Image.new("RGB", (48, 32), (90, 120, 60 + 90 * index)).save(folder / f"photo_{index}.png")
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = [0.3 * index, 0, 4]
        views.append(View(f"photo_{index}", camera, pose, folder / f"photo_{index}.png"))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    faces = "013 032 467 475 054 015 237 276 026 064 157 173"
    (folder / "exports/main").mkdir(parents=True)
    np.savez(
        folder / "exports/main/mesh.npz",
        vertices=corners,
        faces=np.array([[int(c) for c in face] for face in faces.split()], np.int32),
        colors=((corners + 1) * 127).astype(np.uint8),
        class_id=np.ones(8, np.int32),
        face_class=np.array([1, 2] * 6, np.int32),
        normals=corners / np.sqrt(3),
    )
    classes = [ClassInfo(1, "stone", (0.7, 0.7, 0.6)), ClassInfo(2, "wood", (0.5, 0.3, 0.1))]
    points = Points(corners.astype(np.float64), np.full((8, 3), 128, np.uint8), np.zeros(8))
    scene = Scene(views, [0, 1], [], classes, points=points, frame="world")
    return write_package(folder, "main", scene, "matrix", Reporter())


def make_capture(folder: Path) -> Path:
    """A small simulated capture with known poses and labels."""
    simulate(SimulateParams(out=folder, views=12, size=(96, 64), samples=1), Reporter())
    text = (folder / "ground_truth/transforms.json").read_text().replace('"../', '"')
    (folder / "transforms.json").write_text(text)
    return folder


def run_wheel(python: Path, request: dict[str, Any], folder: Path) -> dict[str, Any]:
    return _answer([str(python), str(WORKER)], request, folder, dict(os.environ))


def run_window(root: Path, request: dict[str, Any], folder: Path) -> dict[str, Any]:
    """In the background mode of a windowed Blender, which lives in a folder of its own."""
    environment = {
        **os.environ,
        "BIND": f"{folder} {Path(request['zip']).parent} {engine_places()}",
        "ENTER_ENV": f"BLENDER_USER_RESOURCES={folder / 'user'}",
    }
    command = [str(GUI / "enter"), str(root), str(ROOT), "blender", "-noaudio", "--background", "--factory-startup"]
    row = _answer([*command, "--python", str(WORKER), "--"], request, folder, environment)
    if row["ok"]:
        row |= _command_line(root, request, environment, folder / "out" / "project")
    return row


def engine_places() -> str:
    """Folders that the engine needs in a Blender that lives in a folder of its own."""
    places = [sys.base_prefix]
    # The environment may be shared by several checkouts, and then is a link to a folder elsewhere.
    if not (ROOT / ".venv").resolve().is_relative_to(ROOT):
        places.append(str((ROOT / ".venv").resolve()))
    return " ".join(places)


def _command_line(root: Path, request: dict[str, Any], environment: dict[str, str], project: Path) -> dict[str, Any]:
    """`blender -c fieldwork VERB`, with this checkout's environment as the engine: the doctor, an export of the project,
    and the exit status of a failure."""
    environment = {
        **environment,
        "ENTER_ENV": f"{environment['ENTER_ENV']} FIELDWORK_ENGINE_PYTHON={ROOT}/.venv/bin/python",
    }
    blender = [str(GUI / "enter"), str(root), str(ROOT), "blender", "--command"]
    install = [*blender, "extension", "install-file", "-r", "user_default", "-e", request["zip"]]
    done = subprocess.run(install, capture_output=True, text=True, env=environment, timeout=300)
    if done.returncode != 0:
        return {"ok": False, "error": "the extension was not installed for -c", "log": done.stdout + done.stderr}
    for verb, key, status in (
        (["doctor"], "torch", 0),
        (["export", project, "--to", "ply"], "files", 0),
        (["export", project, "--to", "ply", "--run", "none"], "error", 1),
        (["train"], None, 2),
    ):
        ran = subprocess.run(
            [*blender, "fieldwork", *map(str, verb), "--json"],
            capture_output=True, text=True, env=environment, timeout=300,
        )  # fmt: skip
        answer = json.loads(next((line for line in ran.stdout.splitlines() if line.startswith("{")), "{}"))
        if ran.returncode != status or (key and not answer.get(key)):
            error = f"`blender -c fieldwork {verb[0]}` ended with {ran.returncode} instead of {status}"
            return {"ok": False, "error": error, "log": ran.stdout + ran.stderr}
    return {"command": "ok"}


def _answer(command: list[str], request: dict[str, Any], folder: Path, environment: dict[str, str]) -> dict[str, Any]:
    (folder / "out").mkdir()
    answer = folder / "answer.json"
    path = folder / "request.json"
    path.write_text(json.dumps({**request, "out": str(folder / "out"), "answer": str(answer)}))
    environment["BLENDER_USER_RESOURCES"] = str(folder / "user")
    done = subprocess.run([*command, str(path)], capture_output=True, text=True, env=environment, timeout=600)
    log = done.stdout + done.stderr
    if not answer.is_file():
        return {"ok": False, "error": f"no answer, status {done.returncode}", "log": log}
    return {**json.loads(answer.read_text()), "log": log}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", help="versions, or sid and trixie")
    parser.add_argument("--no-window", action="store_true", help="leave the windowed Blenders out")
    parser.add_argument("--renders", action="store_true", help="also run the tests of the render engine in each wheel")
    options = parser.parse_args()
    chosen = lambda name: not options.only or name in options.only  # noqa: E731
    rows: list[tuple[str, dict[str, Any]]] = []
    # A windowed Blender has a /tmp of its own, into which this folder is bound.
    with tempfile.TemporaryDirectory(prefix="fieldwork-matrix-") as name:
        work = Path(name)
        (work / "capture").mkdir()
        request: dict[str, Any] = {
            "package": str(make_package(work / "capture")),
            "capture": str(make_capture(work / "simulated")),
            "engine": str(ROOT / ".venv/bin/python"),
        }
        for version in filter(chosen, WHEELS):
            python = wheel_python(version)
            if isinstance(python, str):
                rows.append((f"bpy {version}", {"skipped": python}))
                continue
            print(f"bpy {version} …", flush=True)
            try:
                # Each version builds its own zip, so that each version's rules for manifests are kept.
                request["zip"] = str(build_zip(python, work / f"dist-{version}"))
                (work / version).mkdir()
                row = run_wheel(python, request, work / version)
                rows.append((f"bpy {version}", row))
                if options.renders and row["ok"]:
                    row |= renders(python)
                (ROOT / "dist").mkdir(exist_ok=True)
                shutil.copy(request["zip"], ROOT / "dist")
            except subprocess.SubprocessError as error:
                rows.append((f"bpy {version}", {"ok": False, "error": str(error), "log": ""}))
        for suite, place in {} if options.no_window else {k: v for k, v in WINDOWED.items() if chosen(k)}.items():
            root = Path(os.environ.get(f"FIELDWORK_BLENDER_{suite.upper()}", place))
            if not (root / ".complete").exists():
                rows.append((f"windowed {suite}", {"skipped": f"no {root}; build it with blender-gui/make-root"}))
                continue
            print(f"windowed {suite} …", flush=True)
            (work / suite).mkdir()
            zips = sorted((ROOT / "dist").glob("fieldwork-*.zip"))
            request["zip"] = shutil.copy(zips[-1], work / suite)
            for name in ("capture", "simulated"):
                shutil.copytree(work / name, work / suite / name)
            request["package"] = str(work / suite / "capture/exports/main/package")
            request["capture"] = str(work / suite / "simulated")
            rows.append((f"windowed {suite}", run_window(root, request, work / suite)))
    return report(rows)


def report(rows: list[tuple[str, dict[str, Any]]]) -> int:
    table = Table(
        "Blender",
        "version",
        "Python",
        "operators",
        "enable ms",
        "photo s",
        "mesh s",
        "faces",
        "denoiser",
        "-c",
        "renders",
        "result",
    )
    failures = 0
    for name, row in rows:
        if "skipped" in row:
            table.add_row(name, *[""] * 10, f"skipped: {row['skipped']}")
            continue
        failures += not row["ok"]
        facts = [
            str(row.get(key, ""))
            for key in (
                "blender",
                "python",
                "operators",
                "enable_ms",
                "photo_s",
                "mesh_s",
                "faces",
                "oidn",
                "command",
                "renders",
            )
        ]
        table.add_row(name, *facts, "ok" if row["ok"] else f"FAILED: {row['error']}")
        if not row["ok"]:
            print(f"--- {name} ---\n{row['log'][-3000:]}")
    Console(width=None if sys.stdout.isatty() else 130).print(table)
    return failures


if __name__ == "__main__":
    sys.exit(main())
