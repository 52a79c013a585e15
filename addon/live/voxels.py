"""A baked field as the viewport reads it: the files of `runs/RUN/voxels`, and where it lies in its capture.

What the files hold stands in docs/bake.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mathutils import Matrix

from ..project import snapshot

if TYPE_CHECKING:
    from .thing_texels import Told

VERTICES = 9  # along a side of a block
COARSE = 5  # of them that have changes of the colour
TEXELS = {"T0": VERTICES, "T1": VERTICES, "T2": COARSE, "T3": COARSE, "T4": COARSE}  # texels along a side of a block
SLOT_BITS = 22  # of an entry of the index that number its block
SLOTS = 1 << 15  # more than there are blocks: a texture's float32 holds the number and, times this, the octants
VERSION = 2  # of the files
BLACK = (0.0, 0.0, 0.0)


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
    return numbers(array, found.meta, name)


def numbers(array: Any, meta: dict[str, Any], name: str) -> Any:
    """The bytes of a texture (Z, Y, X, 4) as numbers in [0, 1]: flat float32. Raises ValueError: they are not those of it."""
    import numpy as np

    x, y, z = texture_size(meta, name)
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


class Look(NamedTuple):
    """How a class index is shown: colour that it is tinted with, opacity, tint, and colour among the labels."""

    color: tuple[float, ...]
    opacity: float
    tint: float
    label: tuple[float, ...]

    @property
    def edited(self) -> bool:
        """Whether it is shown other than it is."""
        return self.opacity < 1 or self.tint > 0


HIDDEN = Look(BLACK, 0.0, 0.0, BLACK)


def class_looks(meta: dict[str, Any], classes: Any) -> list[Look]:
    """The looks of a field's class indices. classes: the entries of a field object, by whose ids the indices are found."""
    known = {entry.id: entry for entry in classes}
    found = []
    for number in meta["class_ids"]:
        entry = known.get(number)
        if entry is None:
            found.append(Look(BLACK, 1.0, 0.0, BLACK))
        else:
            color = tuple(entry.color)
            found.append(Look(color, entry.shown, entry.tint, color))
    return found


def thing_look(look: Look, own: dict[str, Any] | None) -> Look:
    """How a thing of a class of this look is shown, `own` of which is its own (`FieldworkFieldThing.look`), as
    nerfcore/film/fields.py has it."""
    if own is None:
        return look
    color, tint = (own["color"], own["tint"]) if own["tint"] > 0 else (look.color, look.tint)
    return Look(color, own["opacity"] * look.opacity, tint, look.label)


def thing_looks(classes: list[Look], told: Told, edited: dict[str, dict[str, Any]]) -> list[Look]:
    """The looks of class indices with those of things after them. edited: what is their own by name (`things.looks`)."""
    return [
        *classes, *(thing_look(classes[index], edited.get(name)) for name, index in zip(told.names, told.of_class))
    ]  # fmt: skip


def alone(classes: list[Look], told: Told, thing: str, own: dict[str, Any] | None) -> list[Look]:
    """The same where one thing alone is shown."""
    number = told.names.index(thing)
    found = [HIDDEN] * (len(classes) + len(told.names))
    found[len(classes) + number] = thing_look(classes[told.of_class[number]], own)
    return found


MARKS = (256, 86)  # texels of the texture of marks, one a block: 28³ at most


def marks(looks: list[Look], told: Told | None) -> Any:
    """Which blocks have something of edited indices, all of them where that is not known: flat float32, as the texture holds it."""
    import numpy as np

    found = np.ones(MARKS[0] * MARKS[1], np.float32)
    if told is not None:
        edited = [number for number, look in enumerate(looks) if look.edited]
        found[: len(told.marks)] = told.marks[:, edited].any(1)
    return found


def rows(looks: list[Look]) -> list[float]:
    """Looks as the texture 256 × 2 holds them: colour and opacity of each, below that tint and colour among the labels."""
    upper, lower = [], []
    for look in looks:
        upper += (*look.color, look.opacity)
        lower += (look.tint, *look.label)
    rest = 256 - len(looks)
    return [*upper, *(*BLACK, 1.0) * rest, *lower, *(0.0,) * 4 * rest]
