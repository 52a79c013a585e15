"""Which mesh files there are. Apart from their writers, whose libraries load only when something is written."""

from __future__ import annotations

from pathlib import Path

from ..errors import SettingError

USD = (".usdc", ".usda", ".usd", ".usdz")
FORMATS = (".ply", ".obj", ".glb", ".stl", *USD)
Y_UP = (".glb", ".obj")
TEXTURED = (".glb", ".obj")  # and USD, which knows the corners' own places on the texture


def check_format(path: Path) -> None:
    """Raise SettingError unless the ending of the file is one of `FORMATS`."""
    if path.suffix.lower() not in FORMATS:
        raise SettingError(f"{path}: meshes are written as {', '.join(FORMATS)}.", "Choose one of these endings.")
