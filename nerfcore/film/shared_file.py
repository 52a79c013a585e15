"""The file in memory through which a frame's pixels go to Blender, who makes and removes it.

64 bytes of header, of which the first eight are a counter, then the passes one after the other, float32. The counter is odd
while pixels are written and one more afterwards, so that who reads them meanwhile knows.
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
