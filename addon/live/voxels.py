"""A baked field as the viewport reads it: the files of `runs/RUN/voxels`, and where it lies in its capture.

What the files hold stands in docs/bake.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from mathutils import Matrix

from ..project import snapshot

VERTICES = 9  # along a side of a block
COARSE = 5  # of them that have changes of the colour
TEXELS = {"T0": VERTICES, "T1": VERTICES, "T2": COARSE, "T3": COARSE, "T4": COARSE}  # texels along a side of a block
SLOT_BITS = 22  # of an entry of the index that number its block
SLOTS = 1 << 15  # more than there are blocks: a texture's float32 holds the number and, times this, the octants
VERSION = 2  # of the files


class Baked(NamedTuple):
    """Where a baked field is, and its meta.json; `key` changes whenever the files do."""

    folder: Path
    meta: dict[str, Any]
    key: tuple[str, int]


def baked(project: Path, run: str) -> Baked | None:
    """The baked field of a run; None where there is none that can be read."""
    folder = project / "runs" / run / "voxels"
    meta = snapshot.cached_json(folder / "meta.json")
    if not isinstance(meta, dict) or meta.get("version") != VERSION or meta.get("cells") != VERTICES - 1:
        return None
    return Baked(folder, meta, (str(folder), (folder / "meta.json").stat().st_mtime_ns))


def world_from_box(project: Path, meta: dict[str, Any]) -> Matrix:
    """From the field's cube [−1, 1]³ to the capture's own frame."""
    known = snapshot.frame(project).get("world_from_sfm")
    return (Matrix(known) if known else Matrix.Identity(4)) @ Matrix(meta["sfm_from_box"])


def texture_size(meta: dict[str, Any], name: str) -> tuple[int, int, int]:
    """Texels of a texture along x, y and z."""
    x, y, z = meta["across"]
    return TEXELS[name] * x, TEXELS[name] * y, TEXELS[name] * z


def read_texels(found: Baked, name: str) -> Any:
    """The bytes of a texture as numbers in [0, 1]: flat float32, x fastest. Raises one of UNREADABLE_ARRAYS: it is damaged."""
    import numpy as np

    array = np.load(found.folder / f"{name}.npy", mmap_mode="r")
    x, y, z = texture_size(found.meta, name)
    if array.shape != (z, y, x, 4) or array.dtype != np.uint8:
        raise ValueError(f"{name}.npy holds {array.dtype} {array.shape}")
    return np.multiply(array, np.float32(1 / 255), dtype=np.float32).reshape(-1)


def read_index(found: Baked) -> Any:
    """The index of the blocks as the shader takes it: flat float32, x fastest; minus a distance, or number of the block + 1 and
    `SLOTS` times which of its octants hold anything. Raises one of UNREADABLE_ARRAYS: it is damaged."""
    import numpy as np

    side = found.meta["side"]
    array = np.load(found.folder / "index.npy")
    if array.shape != (side,) * 3:
        raise ValueError(f"index.npy holds {array.shape}")
    block = (array & ((1 << SLOT_BITS) - 1)) + SLOTS * (array >> SLOT_BITS)
    return np.where(array > 0, block, array).astype(np.float32).reshape(-1)


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
