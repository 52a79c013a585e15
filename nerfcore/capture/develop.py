"""Files that a photographed scene is delivered in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from ..errors import DiskError, InputError
from ..files import atomic_path, disk_errors, write_json


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


def write_depth(path: Path, depth: np.ndarray) -> None:
    """Atomically write a depth map (height, width) float32 as a one-channel EXR, channel "Z".

    Raises:
        DiskError: it cannot be written.
    """
    height, width = depth.shape
    spec = oiio.ImageSpec(width, height, 1, "float")
    spec.channelnames = ("Z",)
    spec.attribute("compression", "zip")
    with atomic_path(path) as temporary:
        out = oiio.ImageOutput.create(str(temporary))
        # OpenImageIO takes the last axis for the channels.
        pixels = np.ascontiguousarray(depth, np.float32)[..., None]
        if out is None or not (out.open(str(temporary), spec) and out.write_image(pixels) and out.close()):
            raise DiskError(f"{path} cannot be written: {oiio.geterror()}.", "Check the disk and the permissions.")
