"""The list of a batch: many captures, with the settings of `reconstruct` for each."""

from __future__ import annotations

import csv
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from ..config import make_config
from ..errors import InputError, SettingError, wrong_value
from ..params import ReconstructParams

PATHS = ("photos", "out", "labels", "masks", "classes", "blend", "report", "renders")


class Capture(NamedTuple):
    """A row of the list. Those of a higher priority are done first."""

    params: ReconstructParams
    priority: int = 0


def read_list(path: Path) -> list[Capture]:
    """The captures of a .csv with a header, or of a .json with an array of objects: settings of reconstruct by name.

    `photos` must be there. Relative paths start at the list's folder; without `out` a project is made beside the list,
    named after the photos. `priority` is a whole number, 0 by default: captures with a higher one come first, else they keep
    their order. In a .csv, empty cells are left out and `set` holds name=value words.

    Raises:
        InputError: it cannot be read, or holds no captures.
        SettingError: a row names an unknown setting or has a wrong value, or two rows have the same project.
    """
    captures = []
    for number, row in enumerate(_rows(path), 1):
        values = {key: value for key, value in row.items() if value not in (None, "")}
        for name in PATHS:
            if name in values:
                values[name] = path.absolute().parent / str(values[name])
        priority = _priority(values.pop("priority", 0), path, number)
        if "photos" in values:
            values.setdefault("out", path.absolute().parent / _name(values["photos"]))
        if isinstance(values.get("set"), str):
            values["set"] = dict(word.partition("=")[::2] for word in values["set"].split())
        try:
            capture = Capture(ReconstructParams.model_validate(values), priority)
            make_config(capture.params.preset, capture.params.set)
        except ValidationError as error:
            raise SettingError(
                f"{path}, capture {number}: {wrong_value(error.errors()[0])}.",
                "Columns are named like the options of `fieldwork reconstruct`.",
            ) from error
        except SettingError as error:
            raise SettingError(f"{path}, capture {number}: {error.message}", error.hint) from error
        captures.append(capture)
    if not captures:
        raise InputError(f"{path} lists no captures.", "Write one row for each, with its folder under “photos”.")
    outs = Counter(os.path.realpath(capture.params.out) for capture in captures)
    twice = next((out for out, count in outs.items() if count > 1), None)
    if twice is not None:
        raise SettingError(f"{path} has two captures with the project {twice}.", "Give each another “out”.")
    return sorted(captures, key=lambda capture: -capture.priority)


def _priority(value: Any, path: Path, number: int) -> int:
    try:
        return int(value)
    except (TypeError, ValueError) as error:
        raise SettingError(
            f"{path}, capture {number}: “priority” is {value!r}.", "Give a whole number: higher ones come first."
        ) from error


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.", "Give a .csv or .json file.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8: {error}.", "Save it as UTF-8.") from error
    if path.suffix.lower() == ".csv":
        rows = list(csv.DictReader(text.splitlines()))
        if any(None in row for row in rows):
            raise InputError(f"{path} has a row with more cells than its first line.", "Give each column a name.")
        return rows
    if path.suffix.lower() != ".json":
        raise InputError(f"{path} is neither a .csv nor a .json file.", "Write the list as one of these.")
    try:
        value = json.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is damaged: {error}.", "Write an array of objects.") from error
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        raise InputError(f"{path} holds no array of objects.", 'Write [{"photos": "folder"}, …].')
    return value


def _name(photos: Path) -> str:
    """Name of the project of a folder of photos or a video."""
    whole = photos.parent if photos.name.lower() in ("photos", "images", "rgb") else photos
    return f"{whole.stem if whole.suffix else whole.name}_fieldwork"
