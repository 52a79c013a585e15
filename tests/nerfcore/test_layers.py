"""Packages stand in layers: imports run downwards only, and there is no circle. The layers are in pyproject.toml."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def check(root: Path) -> subprocess.CompletedProcess[str]:
    """import-linter over the package `fieldwork` whose parent folder is `root`."""
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(cache_dir=None))"
    config = root / "fieldwork"
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=config,
        env={"PYTHONPATH": str(root), "PATH": ""},
        text=True,
        capture_output=True,
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The package's sources in another place, to be spoiled."""
    import shutil

    folder = tmp_path / "fieldwork"
    for name in ("nerfcore", "addon", "operators", "panels"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__.py", "pyproject.toml"):
        shutil.copy(ROOT / name, folder)
    return tmp_path


def test_imports_run_downwards_without_circles(copy):
    done = check(copy)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("nerfcore/files.py", "from .project import store as _spoiled\n"),
        ("nerfcore/kernels/device.py", "from ..render import model as _spoiled\n"),
        ("addon/text.py", "from .jobs import queue as _spoiled\n"),
        ("nerfcore/errors.py", "from ..addon import roles as _spoiled\n"),
        ("addon/roles.py", "from ..panels import base as _spoiled\n"),
        ("addon/project/snapshot.py", "from ...nerfcore.project import store as _spoiled\n"),
        ("addon/engine/link.py", "import torch as _spoiled\n"),
    ],
)
def test_an_import_that_climbs_is_found(copy, file, line):
    path = copy / "fieldwork" / file
    path.write_text(path.read_text("utf-8") + line, "utf-8")
    done = check(copy)
    assert done.returncode != 0
    assert "BROKEN" in done.stdout


def test_every_room_is_packaged() -> None:
    """What the list of packages lacks is missing where Fieldwork is installed, though not in a checkout."""
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"])
    rooms = {
        ".".join(["fieldwork", *path.parent.relative_to(ROOT).parts])
        for top in ("addon", "nerfcore", "operators", "panels")
        for path in (ROOT / top).rglob("__init__.py")
    }
    assert rooms - listed == set()
