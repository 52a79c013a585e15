"""Semantic classes: reading `classes.json` and giving every class a colour."""

from __future__ import annotations

import colorsys
import json
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from .schema import SemanticClass

T = TypeVar("T", bound=Hashable)

# Twelve colours told apart at a glance, also by most colour-blind people (the first seven after Okabe and Ito).
PALETTE = (
    "e69f00", "56b4e9", "009e73", "f0e442", "0072b2", "d55e00", "cc79a7", "8c564b", "7f7fff", "b2df8a", "17becf", "9467bd",
)  # fmt: skip
VOID_COLOR = (0.0, 0.0, 0.0)
GOLDEN_ANGLE = 0.381966  # (3 − √5) / 2 of a turn: multiples of it stay apart
MOST_CLASSES = 254  # ids go up to 65535, but pixels are kept as one byte of class index each, one of them for void


def class_color(class_id: int, ignore_id: int = 0) -> tuple[float, float, float]:
    """The fixed display colour of a class id: sRGB in [0, 1]; black for void."""
    if class_id == ignore_id:
        return VOID_COLOR
    index = class_id - 1 if class_id > ignore_id else class_id
    if 0 <= index < len(PALETTE):
        red, green, blue = (int(PALETTE[index][i : i + 2], 16) / 255 for i in (0, 2, 4))
        return red, green, blue
    # Beyond the hand-picked ones: hues by the golden angle, in three brightnesses.
    return colorsys.hsv_to_rgb(index * GOLDEN_ANGLE % 1.0, 0.45 + 0.2 * (index % 3), 0.95 - 0.18 * (index // 3 % 3))


def make_classes(
    names: dict[int, str], ignore_id: int = 0, colors: dict[int, tuple[int, int, int]] | None = None
) -> list[SemanticClass]:
    """Classes from names by id, sorted by id. The void id is not a class and is left out.

    Args:
        colors: sRGB 0–255 by id, as the classes file gives them; classes without one get their fixed colour.
    Raises:
        InputError: there are more classes than a field can tell apart.
    """
    if len(names.keys() - {ignore_id}) > MOST_CLASSES:
        raise InputError(
            f"The capture has {len(names.keys() - {ignore_id})} classes; a field tells at most {MOST_CLASSES} apart.",
            "Merge classes in the label maps.",
        )
    shown = {i: (r / 255, g / 255, b / 255) for i, (r, g, b) in (colors or {}).items()}
    return [
        SemanticClass(id=i, name=name, color=shown.get(i) or class_color(i, ignore_id), priority=1.0)
        for i, name in sorted(names.items())
        if i != ignore_id
    ]


def read_classes(path: Path) -> tuple[dict[int, str], int, dict[int, tuple[int, int, int]]]:
    """Read a classes file.

    Forms: `["void", "stone", …]` (index = id, 0 = void); `{"ignore_id": 0, "classes": {"1": "stone", …}}`; in the
    latter a class may also be `{"name": "stone", "color": [r, g, b]}` with 0–255 values, the colour that stands for
    it in RGB label maps and in views.

    Returns:
        names by id (void left out), the ignore id, and RGB colours by id (where given).
    Raises:
        InputError: the file is missing, not JSON or of another form, or an id or a name occurs twice.
    """
    hint = 'Write {"ignore_id": 0, "classes": {"1": "stone", "2": "wood"}} or a list of names.'
    try:
        value: Any = json.loads(Path(path).read_text(encoding="utf-8-sig"), object_pairs_hook=_without_repetition)
    except FileNotFoundError as error:
        raise InputError(f"The classes file {path} does not exist.", hint) from error
    except RecursionError as error:
        raise InputError(f"The classes file {path} is nested too deeply.", hint) from error
    except (OSError, ValueError) as error:
        raise InputError(f"The classes file {path} cannot be read: {error}.", hint) from error
    try:
        ignore_id, entries = _entries(value)
        names = {i: _name(i, entry) for i, entry in entries}
        colors = {i: _color(names[i], e["color"]) for i, e in entries if isinstance(e, dict) and "color" in e}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"The classes file {path} has an unknown form ({error}).", hint) from error
    if any(i < 0 or i > 65535 for i in names):
        raise InputError(f"The classes file {path} has ids outside 0…65535.", hint)
    names.pop(ignore_id, None)
    for what, twice in (("have the id", _repeated([i for i, _ in entries])), ("are called", _repeated(names.values()))):
        if twice is not None:
            which = f"“{twice}”" if isinstance(twice, str) else twice
            raise InputError(f"In the classes file {path}, two classes {what} {which}.", "Give every class its own.")
    return names, ignore_id, colors


def read_found_classes(path: Path, given: bool) -> tuple[dict[int, str], int, dict[int, tuple[int, int, int]]]:
    """`read_classes`, whose errors say so where nobody gave the file."""
    try:
        return read_classes(path)
    except InputError as error:
        found = "" if given else " The file was found by itself: rename it if it is something else."
        raise InputError(error.message, error.hint + found) from error


def unnamed_values(present: dict[int, list[str]], names: dict[int, str], ignore_id: int, file: Path) -> list[str]:
    """A sentence for each value of label maps that a classes file does not name.

    Args:
        present: the values that occur, each with the label maps in which it does.
        file: where the names come from.
    """
    told = []
    for value, maps in sorted(present.items()):
        if value not in names and value != ignore_id:
            where = maps[0] + (f" and {len(maps) - 1} more label maps" if len(maps) > 1 else "")
            told.append(
                f"The value {value} in {where} is not named in {file}: it is trained as “class {value}”. Name it there, "
                f"or give it the void id ({ignore_id}) in the maps."
            )
    return told


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object whose keys all differ; of equal ones Python would keep the last without a word."""
    twice = _repeated([key for key, _ in pairs])
    if twice is not None:
        raise ValueError(f"“{twice}” occurs twice")
    return dict(pairs)


def _repeated(values: Iterable[T]) -> T | None:
    """The first value that was there before."""
    seen: set[T] = set()
    for value in values:
        if value in seen:
            return value
        seen.add(value)
    return None


def _entries(value: Any) -> tuple[int, list[tuple[int, Any]]]:
    """The void id, and (id, entry) of each class, of either form of the file."""
    if isinstance(value, list):
        return 0, list(enumerate(value))
    ignore_id = int(value.get("ignore_id", 0))
    if isinstance(value.get("classes"), list):
        return ignore_id, [(int(e["id"]) if "id" in e else i, e) for i, e in enumerate(value["classes"])]
    return ignore_id, [(int(i), entry) for i, entry in value["classes"].items()]


def _name(class_id: int, entry: Any) -> str:
    name = entry["name"] if isinstance(entry, dict) else entry
    if not isinstance(name, str) or not name.strip():
        raise ValueError(f"the class {class_id} has no name")
    return name.strip()


def _color(name: str, values: Any) -> tuple[int, int, int]:
    color = [float(c) for c in values]
    if len(color) != 3 or not all(c.is_integer() and 0 <= c <= 255 for c in color):
        raise ValueError(f"the colour of {name} is not three whole numbers from 0 to 255")
    return int(color[0]), int(color[1]), int(color[2])
