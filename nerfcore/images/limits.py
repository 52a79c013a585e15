"""What Pillow may open, and what it raises where it cannot: for every module that opens pictures with it."""

from __future__ import annotations

import struct

from PIL import Image

# Stitched panoramas and large textures are beyond Pillow's decompression-bomb limit; ours is what a decode may take in memory.
Image.MAX_IMAGE_PIXELS = 600_000_000

# What decoders raise for damaged files; UnidentifiedImageError is an OSError.
UNDECODABLE = (
    OSError,
    EOFError,
    SyntaxError,
    ValueError,
    TypeError,
    RuntimeError,
    struct.error,
    Image.DecompressionBombError,
)
