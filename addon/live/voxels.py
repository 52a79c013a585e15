"""A baked field as the viewport reads it: the files of `runs/RUN/voxels`, and where it lies in its capture.

What the files hold stands in docs/bake.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from mathutils import Matrix

from ..project import snapshot

VERTICES = 9  # along a side of a block
TEXELS = ("T0", "T1", "T2", "T3")


class Baked(NamedTuple):
    """Where a baked field is, and its meta.json; `key` changes whenever the files do."""

    folder: Path
    meta: dict[str, Any]
    key: tuple[str, int]


def baked(project: Path, run: str) -> Baked | None:
    """The baked field of a run; None where there is none that can be read."""
    folder = project / "runs" / run / "voxels"
    meta = snapshot.cached_json(folder / "meta.json")
    if not isinstance(meta, dict) or meta.get("version") != 1 or meta.get("cells") != VERTICES - 1:
        return None
    return Baked(folder, meta, (str(folder), (folder / "meta.json").stat().st_mtime_ns))


def world_from_box(project: Path, meta: dict[str, Any]) -> Matrix:
    """From the field's cube [−1, 1]³ to the capture's own frame."""
    known = snapshot.frame(project).get("world_from_sfm")
    return (Matrix(known) if known else Matrix.Identity(4)) @ Matrix(meta["sfm_from_box"])


def texture_size(meta: dict[str, Any]) -> tuple[int, int, int]:
    """Texels of the textures along x, y and z."""
    x, y, z = meta["across"]
    return VERTICES * x, VERTICES * y, VERTICES * z


def read_texels(found: Baked, name: str) -> Any:
    """The bytes of a texture as numbers in [0, 1]: flat float32, x fastest. Raises one of UNREADABLE_ARRAYS: it is damaged."""
    import numpy as np

    array = np.load(found.folder / f"{name}.npy", mmap_mode="r")
    x, y, z = texture_size(found.meta)
    if array.shape != (z, y, x, 4) or array.dtype != np.uint8:
        raise ValueError(f"{name}.npy holds {array.dtype} {array.shape}")
    return np.multiply(array, np.float32(1 / 255), dtype=np.float32).reshape(-1)


def read_index(found: Baked) -> Any:
    """The index of the blocks: flat float32, x fastest. Raises one of UNREADABLE_ARRAYS: it is damaged."""
    import numpy as np

    side = found.meta["side"]
    array = np.load(found.folder / "index.npy")
    if array.shape != (side,) * 3:
        raise ValueError(f"index.npy holds {array.shape}")
    return np.ascontiguousarray(array, np.float32).reshape(-1)


def class_rows(meta: dict[str, Any], classes: Any, void: tuple[float, float, float] = (0, 0, 0)) -> list[float]:
    """The table of the classes as a texture 256 × 2 holds it: colour and opacity of each, below that its tint.

    classes: the entries of a field object, by whose ids the indices of the field are found.
    """
    known = {entry.id: entry for entry in classes}
    colors, tints = [], []
    for number in range(256):
        entry = known.get(meta["class_ids"][number]) if number < len(meta["class_ids"]) else None
        colors += (*entry.color, entry.shown) if entry is not None else (*void, 1.0)
        tints += (entry.tint if entry is not None else 0.0, 0.0, 0.0, 1.0)
    return colors + tints
