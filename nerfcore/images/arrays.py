"""NumPy files from others: `.npy` and `.npz` with numbers, whose headers may claim anything."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy

from ..errors import InputError
from ..files import UNREADABLE_ARRAYS


def read_array(path: Path) -> np.ndarray:
    """The array of an .npy file, or the first one of an .npz.

    No memory is asked for before it is known that the file is as long as its header says.

    Raises:
        InputError: it cannot be read, holds no array of numbers or less than it claims. One clause, fit as a reason.
    """
    try:
        if path.suffix.lower() != ".npz":
            with open(path, "rb") as file:
                return _read(file, os.fstat(file.fileno()).st_size, path.name)
        with ZipFile(path) as archive:
            if not archive.infolist():
                raise InputError(f"{path.name} holds no array")
            first = archive.infolist()[0]
            with archive.open(first) as file:
                return _read(file, first.file_size, path.name)
    except (*UNREADABLE_ARRAYS, NotImplementedError) as error:
        raise InputError(f"{path.name} cannot be read: {error}") from error
    except MemoryError as error:
        raise InputError(f"{path.name} is larger than the memory") from error


def _read(file: IO[bytes], size: int, name: str) -> np.ndarray:
    """Read an array from a stream of `size` bytes."""
    version = npy.read_magic(file)
    shape, columns_first, kind = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if kind.hasobject or kind.kind not in "biuf":
        raise InputError(f"{name} holds no numbers")
    count = 1
    for side in shape:
        count *= side
    if count * kind.itemsize > size:
        raise InputError(f"{name} claims {count * kind.itemsize} bytes and has {size}: its end is missing")
    values = np.frombuffer(file.read(count * kind.itemsize), kind, count)
    return values.reshape(shape, order="F" if columns_first else "C")
