"""Cryptomatte (Friedman and Jones, 2015, specification 1.2.0): ids of names, ranked coverage, manifests."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable

import numpy as np

SLOTS = 16  # ids of one pixel that are told apart


def murmur3(data: bytes, seed: int = 0) -> int:
    """MurmurHash3_x86_32 (Appleby)."""
    c1, c2, mask = 0xCC9E2D51, 0x1B873593, 0xFFFFFFFF

    def rotate(value: int, by: int) -> int:
        return ((value << by) | (value >> (32 - by))) & mask

    h = seed
    whole = len(data) // 4 * 4
    for (k,) in struct.iter_unpack("<I", data[:whole]):
        h = rotate(h ^ (rotate(k * c1 & mask, 15) * c2 & mask), 13) * 5 + 0xE6546B64 & mask
    if data[whole:]:
        h ^= rotate(int.from_bytes(data[whole:], "little") * c1 & mask, 15) * c2 & mask
    h ^= len(data)
    h = (h ^ h >> 16) * 0x85EBCA6B & mask
    h = (h ^ h >> 13) * 0xC2B2AE35 & mask
    return h ^ h >> 16


def id_bits(name: str) -> int:
    """The 32 bits of a name's id, made a usable float: exponents 0 and 255 are avoided."""
    bits = murmur3(name.encode())
    return bits ^ 1 << 23 if bits >> 23 & 255 in (0, 255) else bits


def id_of(name: str) -> float:
    """The id of a name as pixels hold it (float32)."""
    return struct.unpack("<f", struct.pack("<I", id_bits(name)))[0]


def manifest(names: Iterable[str]) -> str:
    """The ids of names in hexadecimal, as metadata hold them."""
    return json.dumps({name: f"{id_bits(name):08x}" for name in names}, ensure_ascii=False, separators=(",", ":"))


class Coverage:
    """How much of each of N pixels which ids cover, sample after sample."""

    def __init__(self, pixels: int) -> None:
        self.ids = np.zeros((pixels, SLOTS), np.float32)
        self.shares = np.zeros((pixels, SLOTS), np.float32)

    def add(self, ids: np.ndarray, shares: np.ndarray) -> None:
        """A sample of every pixel: its id (N,), 0 for nothing, and its share (N,) of the pixel."""
        left = np.flatnonzero((ids != 0) & (shares > 0))
        for slot in range(SLOTS):
            if not len(left):
                return
            here = self.ids[left, slot]
            mine = (here == ids[left]) | (here == 0)
            rows = left[mine]
            self.ids[rows, slot] = ids[rows]
            self.shares[rows, slot] += shares[rows]
            left = left[~mine]

    def ranked(self, levels: int) -> list[np.ndarray]:
        """Pixels (N, 4) of each pair of ranks: id, coverage, id, coverage; the largest first."""
        order = np.argsort(-self.shares, axis=1, kind="stable")
        ids, shares = np.take_along_axis(self.ids, order, 1), np.take_along_axis(self.shares, order, 1)
        return [np.stack([ids[:, k], shares[:, k], ids[:, k + 1], shares[:, k + 1]], 1) for k in range(0, levels, 2)]
