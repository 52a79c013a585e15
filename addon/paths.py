"""Paths as Blender stores them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy


def absolute(path: str, library: Any = None) -> Path:
    """A path that may begin with "//", the folder of the open file or of a linked one, as an absolute one without "..":
    each file has one such path, so that paths can be compared and a folder's name read."""
    return Path(os.path.abspath(bpy.path.abspath(path, library=library)))
