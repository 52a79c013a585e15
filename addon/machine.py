"""What the user has set in the preferences, and where Fieldwork keeps what belongs to the machine."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import bpy

from .engine import place
from .engine.place import ROOT
from .registration import ROOT_PACKAGE

AS_EXTENSION = ROOT_PACKAGE.startswith("bl_ext.")


def user_folder(*parts: str) -> Path:
    """A folder that outlives updates of the extension; outside an extension (tests, scripts), a temporary one."""
    if AS_EXTENSION:
        return Path(bpy.utils.extension_path_user(ROOT_PACKAGE, path="/".join(parts), create=True))
    import tempfile

    folder = Path(tempfile.gettempdir(), "fieldwork-user", *parts)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


class _Defaults:
    """What the preferences say where the extension is not enabled as one (tests, scripts)."""

    engine_python = ""
    device = "auto"
    base_python = ""
    wheels = ""
    on_close = "stop"
    idle_minutes = 5


def preferences() -> Any:
    addon = bpy.context.preferences.addons.get(ROOT_PACKAGE)
    return addon.preferences if addon and addon.preferences else _Defaults


def engine_folder() -> Path:
    """Where the engine is. On Windows in a short place, one for all Blenders with this version of the extension, patches
    aside: paths end at 260 characters there, of which PyTorch takes 170."""
    local = os.environ.get("LOCALAPPDATA") if AS_EXTENSION and sys.platform == "win32" else None
    return Path(local, "Fieldwork", f"engine-{place.feature_version()}") if local else user_folder("engine")


def engine_log() -> Path:
    """What this Blender's engine says; other Blenders have theirs."""
    return user_folder("logs") / f"engine-{os.getpid()}.log"


def engine_python() -> Path | None:
    """The Python that runs the engine, None when it is not installed."""
    return place.find_python(bpy.path.abspath(preferences().engine_python), engine_folder(), ROOT)
