"""Files of OpenVDB, written without its library, which is not to be had for every Python that Fieldwork runs in.

File format 224 of OpenVDB (Museth, "VDB: High-Resolution Sparse Volumes with Dynamic Topology", 2013; the layout is that of
`openvdb/io` and `openvdb/tree`): trees of nodes with 32³, 16³ and 8³ children, of which nothing but the active voxels is written.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..files import atomic_path, disk_errors

MAGIC, FORMAT, LIBRARY = 0x56444220, 224, (10, 0)
ACTIVE_ONLY = 2  # of a grid's compression: inactive voxels are the background and are not written
LEAF, LOWER, UPPER = 3, 4, 5  # of the side of each kind of node the logarithm to base 2
SIDE = 1 << (LEAF + LOWER + UPPER)  # voxels along a side of the tree's largest node
KINDS = {1: "float", 3: "vec3s"}


@dataclass(frozen=True)
class Grid:
    """Active voxels of one grid: places (N, 3) int ≥ 0, each once; values (N,) or (N, 3) float32; 0 elsewhere."""

    name: str
    places: np.ndarray
    values: np.ndarray


def write_vdb(
    path: Path, grids: Iterable[Grid], world_from_index: np.ndarray, facts: dict[str, int] | None = None
) -> None:
    """Write grids into one file. A voxel's value is that at its index, which the matrix (4, 4) carries into the world; `facts`
    are metadata of the file.

    Raises:
        DiskError.
    """
    grids = list(grids)
    with disk_errors(path), atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<qIII?", MAGIC, FORMAT, *LIBRARY, True))
        file.write(str(uuid.uuid4()).encode())
        file.write(_metadata(facts or {}))
        file.write(struct.pack("<I", len(grids)))
        for grid in grids:
            _write_grid(file, grid, world_from_index)


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _metadata(values: Mapping[str, str | bool | int]) -> bytes:
    found = struct.pack("<I", len(values))
    for name, value in values.items():
        match value:
            case bool():
                kind, data = "bool", struct.pack("<?", value)
            case int():
                kind, data = "int32", struct.pack("<i", value)
            case str():
                kind, data = "string", value.encode()
        found += _text(name) + _text(kind) + struct.pack("<I", len(data)) + data
    return found


def _write_grid(file: BinaryIO, grid: Grid, world_from_index: np.ndarray) -> None:
    kind = KINDS[1 if grid.values.ndim == 1 else grid.values.shape[1]]
    file.write(_text(grid.name) + _text(f"Tree_{kind}_5_4_3") + _text(""))
    offsets = file.tell()
    file.write(bytes(24))
    begin = file.tell()
    file.write(struct.pack("<I", ACTIVE_ONLY))
    facts = {
        "class": "fog volume" if kind == "float" else "unknown",
        "name": grid.name,
        "is_saved_as_half_float": False,
    }
    file.write(_metadata(facts))
    # OpenVDB multiplies rows from the left.
    file.write(_text("AffineMap") + np.ascontiguousarray(world_from_index.T, "<f8").tobytes())
    file.write(struct.pack("<I", 1))  # buffers of each leaf
    tree = _Tree(grid)
    file.write(tree.topology())
    blocks = file.tell()
    for data in tree.buffers():
        file.write(data)
    end = file.tell()
    file.seek(offsets)
    file.write(struct.pack("<qqq", begin, blocks, end))
    file.seek(end)


class _Tree:
    """Voxels in the order of the file: by upper node, lower node, leaf, and place in the leaf."""

    def __init__(self, grid: Grid) -> None:
        places = np.ascontiguousarray(grid.places, np.int64)
        upper = places // SIDE
        levels = [
            _offset(upper, 21),
            _offset(places >> (LEAF + LOWER) & ((1 << UPPER) - 1), UPPER),
            _offset(places >> LEAF & ((1 << LOWER) - 1), LOWER),
            _offset(places & ((1 << LEAF) - 1), LEAF),
        ]
        order = np.lexsort(levels[::-1])
        self._levels = [level[order] for level in levels]
        self._places = places[order]
        self._values = np.ascontiguousarray(grid.values[order], "<f4")

    def _runs(self, depth: int, begin: int, end: int) -> Iterator[tuple[int, int, int]]:
        """(place in the parent, first voxel, end) of each child at this depth among some voxels."""
        keys = self._levels[depth][begin:end]
        cuts = np.flatnonzero(np.diff(keys)) + 1
        starts = [0, *cuts.tolist()] if len(keys) else []
        for first, last in zip(starts, [*starts[1:], len(keys)]):
            yield int(keys[first]), begin + first, begin + last

    def topology(self) -> bytes:
        width = self._values.shape[1] if self._values.ndim == 2 else 1
        uppers = list(self._runs(0, 0, len(self._places)))
        parts = [bytes(4 * width), struct.pack("<II", 0, len(uppers))]
        for _, begin, end in uppers:
            parts.append((self._places[begin] // SIDE * SIDE).astype("<i4").tobytes())
            lowers = list(self._runs(1, begin, end))
            parts.append(_inner([place for place, _, _ in lowers], UPPER))
            for _, low, high in lowers:
                leaves = list(self._runs(2, low, high))
                parts.append(_inner([place for place, _, _ in leaves], LOWER))
                parts += [self._mask(first, last) for _, first, last in leaves]
        return b"".join(parts)

    def buffers(self) -> Iterator[bytes]:
        for _, begin, end in self._runs(0, 0, len(self._places)):
            for _, low, high in self._runs(1, begin, end):
                for _, first, last in self._runs(2, low, high):
                    # 0: what is inactive is the background.
                    yield self._mask(first, last) + b"\0" + self._values[first:last].tobytes()

    def _mask(self, begin: int, end: int) -> bytes:
        return _bits(self._levels[3][begin:end], LEAF)


def _offset(places: np.ndarray, bits: int) -> np.ndarray:
    """The number of each child (N, 3) in its parent: z is fastest."""
    return places[:, 0] << 2 * bits | places[:, 1] << bits | places[:, 2]


def _bits(places: Iterable[int] | np.ndarray, log2: int) -> bytes:
    mask = np.zeros(1 << 3 * log2, bool)
    mask[np.asarray(places, np.int64)] = True
    return np.packbits(mask, bitorder="little").tobytes()


def _inner(children: list[int], log2: int) -> bytes:
    """An inner node without tiles: which children it has, that no value is active, and that there are none."""
    return _bits(children, log2) + _bits([], log2) + b"\0"
