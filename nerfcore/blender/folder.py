"""Files that a photographed scene is delivered in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import disk_errors, write_json


def claim_folder(out: Path, file: str, settings: dict[str, Any], folders: list[str]) -> None:
    """Take a new or empty folder, or one that was begun with the same `settings`, noted in `out`/`file`.

    Raises:
        InputError: the folder holds something else.
        DiskError: it cannot be written.
    """
    path = out / file
    if path.is_file():
        try:
            there = json.loads(path.read_text("utf-8"))
        except ValueError:
            there = None
        if there != settings:
            raise InputError(
                f"{out} holds photos taken with other settings.", "Choose another folder, or remove this one."
            )
    elif out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out} is not empty and was not made by this step.", "Choose another folder.")
    with disk_errors(out):
        for name in folders:
            (out / name).mkdir(parents=True, exist_ok=True)
    write_json(path, settings)
