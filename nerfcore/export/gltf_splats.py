"""Gaussian splats as binary glTF with the extension KHR_gaussian_splatting (Khronos, ratified 2026): y up, points for readers
that do not know it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from ..files import atomic_path
from ..mesh.gltf import extras

EXTENSION = "KHR_gaussian_splatting"
C0 = 0.28209479177387814  # spherical harmonics of degree 0
FLOAT, ARRAY_BUFFER, POINTS = 5126, 34962, 0
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf_splats(path: Path, splats: np.ndarray, label_revision: int | None) -> None:
    """Write splats as `splats.py` makes them, z up, with their classes as the attributes _CLASS_ID and _CLASS_PROBABILITY, which are
    from a revision of the marks or from none.

    Raises DiskError.
    """
    attributes = _attributes(splats)
    views, accessors, places, blocks = [], [], {}, []
    offset = 0
    for name, values in attributes.items():
        block = np.ascontiguousarray(values, "<f4")
        accessor = {
            "bufferView": len(views),
            "componentType": FLOAT,
            "count": len(block),
            "type": KINDS[block.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": block.min(0).tolist(), "max": block.max(0).tolist()}
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": block.nbytes, "target": ARRAY_BUFFER})
        places[name] = len(accessors)
        accessors.append(accessor)
        blocks.append(block.tobytes())
        offset += block.nbytes
    tree = {
        "asset": {"version": "2.0", "generator": "Fieldwork", **extras(label_revision)},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": path.stem}],
        "meshes": [
            {
                "primitives": [
                    {
                        "mode": POINTS,
                        "attributes": places,
                        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
                    }
                ]
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", offset, b"BIN\0"))
        for block in blocks:
            file.write(block)


def _attributes(splats: np.ndarray) -> dict[str, np.ndarray]:
    """(N, components) of each attribute, in glTF's axes: x, z, −y of the world."""
    column = lambda name: splats[name].astype(np.float32)  # noqa: E731
    stack = lambda *names: np.stack([column(name) for name in names], 1)  # noqa: E731
    constant = stack("f_dc_0", "f_dc_1", "f_dc_2")
    # Degree 1 by order: −y, z, −x of the direction (N, 3 coefficients, rgb).
    first = np.stack([stack(*(f"f_rest_{3 * channel + n}" for channel in range(3))) for n in range(3)], 1)
    y, z, x = -first[:, 0], first[:, 1], -first[:, 2]
    turned_x, turned_y, turned_z = x, z, -y
    color = (0.5 + C0 * constant).clip(0, 1)
    opacity = 1 / (1 + np.exp(-column("opacity")))
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    found = {
        "POSITION": np.stack([column("x"), column("z"), -column("y")], 1),
        "COLOR_0": np.concatenate([linear, opacity[:, None]], 1),
        f"{EXTENSION}:ROTATION": np.tile(np.array([[0, 0, 0, 1]], np.float32), (len(splats), 1)),
        f"{EXTENSION}:SCALE": np.exp(stack("scale_0", "scale_2", "scale_1")),
        f"{EXTENSION}:OPACITY": opacity[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": constant,
        f"{EXTENSION}:SH_DEGREE_1_COEF_0": -turned_y,
        f"{EXTENSION}:SH_DEGREE_1_COEF_1": turned_z,
        f"{EXTENSION}:SH_DEGREE_1_COEF_2": -turned_x,
    }
    if (splats["class_id"] >= 0).any():
        found |= {"_CLASS_ID": column("class_id")[:, None], "_CLASS_PROBABILITY": column("class_probability")[:, None]}
    return found
