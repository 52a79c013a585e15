"""Semantic classes: reading `classes.json` and giving every class a colour."""

from __future__ import annotations

import colorsys
import json
from pathlib import Path
from typing import Any

from ..errors import InputError
from .schema import SemanticClass

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
        InputError: the file is missing, not JSON or of another form.
    """
    hint = 'Write {"ignore_id": 0, "classes": {"1": "stone", "2": "wood"}} or a list of names.'
    try:
        value: Any = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"The classes file {path} does not exist.", hint) from error
    except (OSError, ValueError) as error:
        raise InputError(f"The classes file {path} cannot be read: {error}.", hint) from error
    try:
        if isinstance(value, list):
            ignore_id, entries = 0, dict(enumerate(value))
        elif isinstance(value, dict) and isinstance(value.get("classes"), list):
            ignore_id = int(value.get("ignore_id", 0))
            entries = {int(e.get("id", i)): e for i, e in enumerate(value["classes"])}
        else:
            ignore_id = int(value.get("ignore_id", 0))
            entries = {int(i): entry for i, entry in value["classes"].items()}
        names = {i: str(e["name"] if isinstance(e, dict) else e) for i, e in entries.items()}
        colors: dict[int, tuple[int, int, int]] = {}
        for i, entry in entries.items():
            if isinstance(entry, dict) and "color" in entry:
                red, green, blue = (int(c) for c in entry["color"])
                if not all(0 <= c <= 255 for c in (red, green, blue)):
                    raise ValueError(f"the colour of {names[i]} is not three numbers from 0 to 255")
                colors[i] = (red, green, blue)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"The classes file {path} has an unknown form ({error}).", hint) from error
    if any(i < 0 or i > 65535 for i in names):
        raise InputError(f"The classes file {path} has ids outside 0…65535.", hint)
    names.pop(ignore_id, None)
    return names, ignore_id, colors
