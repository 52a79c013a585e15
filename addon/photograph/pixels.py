"""Reading Blender's uncompressed multilayer EXR and writing index PNG with numpy and the standard library alone."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

_TYPES = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """All channels (height, width) of an uncompressed scan-line EXR, by name; of all parts when it has several.

    Format: "OpenEXR File Layout" (openexr.com). Blender 4 writes one part with all channels, Blender 5 one part a pass.

    Raises:
        ValueError: it is compressed, tiled or no EXR.
    """
    data = Path(path).read_bytes()
    magic, version = struct.unpack_from("<Ii", data)
    if magic != 20000630 or version & 0x200:
        raise ValueError(f"{path} is not a scan-line EXR file")
    multipart = bool(version & 0x1000)
    at, headers = 8, []
    while True:
        header, at = _header(data, at)
        if not header:
            break
        if header["compression"][0] != 0:
            raise ValueError(f"{path} is compressed")
        headers.append(header)
        if not multipart:
            break
    layout = [(_channels(header), struct.unpack("<4i", header["dataWindow"])) for header in headers]
    counts = [y1 - y0 + 1 for _, (_, y0, _, y1) in layout]
    out: dict[str, np.ndarray] = {}
    names = []
    for header, (channels, (x0, y0, x1, y1)) in zip(headers, layout):
        # A part's own name repeats the layer and pass; the channel name alone may be just "V".
        part = header.get("name", b"").rstrip(b"\0").decode() if multipart else ""
        names.append([name if not part or name.startswith(part) else f"{part}.{name}" for name, _ in channels])
        for name, (_, dtype) in zip(names[-1], channels):
            out[name] = np.zeros((y1 - y0 + 1, x1 - x0 + 1), dtype)
    offsets = np.frombuffer(data, "<u8", sum(counts), at)
    for offset in offsets.tolist():
        part = struct.unpack_from("<i", data, offset)[0] if multipart else 0
        start = offset + (4 if multipart else 0)
        y = struct.unpack_from("<i", data, start)[0]
        start += 8
        channels, (x0, y0, x1, _) = layout[part]
        for name, (_, dtype) in zip(names[part], channels):
            out[name][y - y0] = np.frombuffer(data, dtype, x1 - x0 + 1, start)
            start += dtype.itemsize * (x1 - x0 + 1)
    return out


def write_index_png(path: Path, index: np.ndarray) -> None:
    """Write (height, width) uint8 or uint16 as a greyscale PNG of 8 or 16 bits whose values are the indices."""
    height, width = index.shape
    bits = 8 * index.dtype.itemsize
    rows = np.zeros((height, index.dtype.itemsize * width + 1), np.uint8)  # each row begins with its filter type, 0
    rows[:, 1:] = np.ascontiguousarray(index, index.dtype.newbyteorder(">")).view(np.uint8)
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, body in (
            (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)),
            (b"IDAT", zlib.compress(rows.tobytes(), 6)),
            (b"IEND", b""),
        ):
            file.write(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)))


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


def _header(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    attributes: dict[str, bytes] = {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    return attributes, at + 1


def _channels(header: dict[str, bytes]) -> list[tuple[str, np.dtype]]:
    data, at, channels = header["channels"], 0, []
    while data[at]:
        name, at = _text(data, at)
        channels.append((name, _TYPES[struct.unpack_from("<i", data, at)[0]]))
        at += 16
    return channels
