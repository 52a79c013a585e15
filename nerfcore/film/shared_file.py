"""Files in memory through which pixels go to Blender, who makes and removes them.

64 bytes of header, of which the first eight are a counter, then float32: the passes of a frame one after the other, or a
picture for the viewport. The counter is odd while pixels are written and one more afterwards, so that who reads them
meanwhile knows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError

HEADER = 64


class SharedFile:
    """Raises InputError: there is no such file, or it is not as large as the passes want (`shapes` by name)."""

    def __init__(self, path: Path, shapes: dict[str, tuple[int, int, int]]) -> None:
        bytes_wanted = HEADER + 4 * sum(int(np.prod(shape)) for shape in shapes.values())
        try:
            self._all = np.memmap(path, np.uint8, "r+")
        except (OSError, ValueError) as error:
            raise InputError(f"{path} cannot be written to: {error}.", "Render again.") from error
        if len(self._all) != bytes_wanted:
            raise InputError(f"{path} has {len(self._all)} bytes, not {bytes_wanted}.", "Render again.")
        self._counter = self._all[:8].view(np.int64)
        self._places, offset = {}, HEADER
        for name, shape in shapes.items():
            size = 4 * int(np.prod(shape))
            self._places[name] = self._all[offset : offset + size].view(np.float32).reshape(shape)
            offset += size

    def write(self, passes: dict[str, np.ndarray]) -> int:
        """Write some of the passes; returns the counter."""
        self._counter[0] += 1
        for name, pixels in passes.items():
            self._places[name][:] = pixels
        self._counter[0] += 1
        return int(self._counter[0])


class PictureFile:
    """A file that holds one picture of any size up to its own: the header goes on with the number of the request and the
    picture's width and height, int64; then its colours (H, W, 4) and depths (H, W), bottom row first.

    Raises InputError: there is no such file.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._all = np.memmap(path, np.uint8, "r+")
        except (OSError, ValueError) as error:
            raise InputError(f"{path} cannot be written to: {error}.", "Look again.") from error
        self._header = self._all[:HEADER].view(np.int64)
        self._values = self._all[HEADER : HEADER + (len(self._all) - HEADER) // 4 * 4].view(np.float32)

    @property
    def pixels(self) -> int:
        """How many it has room for."""
        return len(self._values) // 5

    def write(self, number: int, color: np.ndarray, depth: np.ndarray) -> None:
        """Write a picture: color (H, W, 4), depth (H, W). It must fit."""
        height, width = depth.shape
        self._header[0] += 1
        self._header[1:4] = number, width, height
        self._values[: color.size] = color.reshape(-1)
        self._values[color.size : color.size + depth.size] = depth.reshape(-1)
        self._header[0] += 1
