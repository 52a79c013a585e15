"""Where the engine's own Python lives, and what is known of it. Standard library only, no bpy.

ENGINE/venv/, venv-2/  the environment, made from Blender's Python or a chosen one, which stays untouched. One of them is
                       installed; the next one is made in the other, and takes its place once the doctor is content
ENGINE/staging.json    is there while packages come into one, and says from what it was made; one that broke off goes on
ENGINE/tools/          the installer `uv`, where the machine has none
ENGINE/cache/          downloads; an installation that broke off goes on from here
ENGINE/complete.json   written last, when the doctor was content; names the environment that is installed
ENGINE/install.log     everything the tools said

Imported when the extension is enabled, so it imports little.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = "FIELDWORK_ENGINE_PYTHON"
COMPLETE = "complete.json"
STAGING = "staging.json"
ENVIRONMENTS = ("venv", "venv-2")
DOWNLOADS = ("tools", "cache")
LOG = "install.log"
LOCK = Path(__file__).with_name("engine.lock")


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
        return python_in(environment(engine_folder))
    checkout = python_in(root / ".venv")
    return checkout if checkout.is_file() else None


def installed(folder: Path) -> dict[str, Any] | None:
    """What is known of the installed engine; None when there is none, or only a part of one."""
    value = read_json(folder / COMPLETE)
    return value if isinstance(value, dict) and python_in(folder / _name(value)).is_file() else None


def read_json(path: Path) -> Any:
    """What stands in a file; None where there is none, or only a part of one."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def environment(folder: Path) -> Path:
    """The environment that is installed, or the first place for one."""
    return folder / _name(installed(folder) or {})


def next_environment(folder: Path) -> Path:
    """Where the next one is made: beside the one that is installed."""
    if installed(folder) is None:
        return folder / ENVIRONMENTS[0]
    return folder / next(name for name in ENVIRONMENTS if name != environment(folder).name)


def _name(value: dict[str, Any]) -> str:
    name = value.get("venv", ENVIRONMENTS[0])
    return name if name in ENVIRONMENTS else ENVIRONMENTS[0]


def feature_version(manifest: Path = ROOT / "blender_manifest.toml") -> str:
    """The extension's version without its patch number, such as "0.1"."""
    import tomllib

    version: str = tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]
    return ".".join(version.split(".")[:2])


def lock_hash(lock: Path = LOCK) -> str:
    """Digest of the versions this extension wants."""
    import hashlib

    return hashlib.sha256(lock.read_bytes()).hexdigest()


def up_to_date(folder: Path) -> bool:
    """Whether the installed engine has the versions of this extension."""
    return (installed(folder) or {}).get("lock") == lock_hash()


def tail(path: Path, lines: int = 20) -> list[str]:
    """The last lines of a text file that are not blank; none when there is no file."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.path.getsize(path) - 16384))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return []
    return [line.rstrip() for line in text.splitlines() if line.strip()][-lines:]
