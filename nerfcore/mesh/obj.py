"""Wavefront OBJ: a group for each feature, its material and texture beside it; written in bands, so that it can be stopped.

Format: Wavefront "Object Files (.obj)", Appendix B1 of the Advanced Visualizer manual; colours behind the places of
vertices, as MeshLab, Blender and trimesh read them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import TextIO

import numpy as np

from ..files import atomic_path, write_text
from ..project.label_revision import label_facts
from .features import Features
from .parts import Part

BAND = 50_000  # lines that are written at once
MATERIAL = """newmtl {name}
Ka 1.0 1.0 1.0
Kd 1.0 1.0 1.0
Ks 0.0 0.0 0.0
Ns 1.0
map_Kd {name}.png
"""


def write_obj(path: Path, part: Part, features: Features, png: bytes | None, check: Callable[[], None]) -> list[Path]:
    """Write a part, y up, and where it has a texture (`png`: its file) NAME.mtl and NAME.png; the files written.

    Raises:
        DiskError: a file cannot be written. What `check` raises, between bands of lines.
    """
    # Several objects may lie in one folder, or be brought into one scene: all of their names are their own.
    name = _word(path.stem)
    order = np.argsort(part.face_feature, kind="stable")
    ordered = part.face_feature[order]
    starts = [0, *(np.flatnonzero(np.diff(ordered)) + 1).tolist(), len(order)]
    with atomic_path(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"# {fact} {value}\n" for fact, value in label_facts(features.label_revision).items())
        if png is None:
            _lines(file, "v %.9g %.9g %.9g %.4f %.4f %.4f\n", np.hstack([part.vertices, part.colors / 255]), check)
        else:
            file.write(f"mtllib {name}.mtl\nusemtl {name}\n")
            _lines(file, "v %.9g %.9g %.9g\n", part.vertices, check)
            assert part.uv is not None
            _lines(file, "vt %.8g %.8g\n", part.uv, check)
        _lines(file, "vn %.6f %.6f %.6f\n", part.normals, check)
        corner = "%d//%d" if png is None else "%d/%d/%d"
        for first, last in pairwise(starts):
            file.write(f"g {_word(features.rows[ordered[first]].name)}\n")
            numbers = np.repeat(part.faces[order[first:last]] + 1, corner.count("%"), axis=1)
            _lines(file, f"f {corner} {corner} {corner}\n", numbers, check)
    if png is None:
        return [path]
    library, picture = path.with_name(f"{name}.mtl"), path.with_name(f"{name}.png")
    write_text(library, MATERIAL.format(name=name))
    with atomic_path(picture) as temporary:
        temporary.write_bytes(png)
    return [path, library, picture]


def _lines(file: TextIO, line: str, values: np.ndarray, check: Callable[[], None]) -> None:
    """Write values (N, C) in a line each."""
    for first in range(0, len(values), BAND):
        check()
        band = values[first : first + BAND]
        file.write((line * len(band)) % tuple(band.reshape(-1).tolist()))


def _word(name: str) -> str:
    """A name as one word: white space ends it, and a backslash at the end of a line joins the next one to it."""
    return re.sub(r"[\s\\]+", "_", name)
