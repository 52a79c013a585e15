"""The process that unwraps: `python -m …mesh.uv_worker FOLDER NUMBERS…` reads FOLDER/in_<n>.npz, writes out_<n>.npz.

xatlas cannot be interrupted and may abort on a mesh it dislikes; a process can be killed, and its death is a sentence.
Its parent's death closes stdin, upon which it ends at once.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

import numpy as np
import xatlas


def charts(vertices: np.ndarray, faces: np.ndarray, texels_per_unit: float) -> dict[str, np.ndarray]:
    """Cut a mesh into charts: `faces` (F, 3) into `uv` (N, 2), which is in texels; vertices are split at seams."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    cut, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    cut.max_iterations = 1
    # xatlas always packs; coarsely and without padding that takes little time, and the place is thrown away.
    coarse = 16.0
    pack.padding, pack.texels_per_unit, pack.rotate_charts = 0, texels_per_unit / coarse, False
    atlas.generate(cut, pack)
    _, corners, uv = atlas[0]
    return {"faces": corners.astype(np.int32), "uv": uv * np.array([atlas.width, atlas.height], np.float32) * coarse}


def pack(uv: np.ndarray, faces: np.ndarray, resolution: int, padding: int) -> dict[str, np.ndarray]:
    """Place charts, which must not touch each other in `uv`, in one square: `corners` (F, 3, 2) in [0, 1];
    `utilization` ()."""
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(uv.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = resolution, padding
    atlas.generate(xatlas.ChartOptions(), options)
    _, corners, placed = atlas[0]
    return {"corners": placed[corners].astype(np.float32), "utilization": np.array(atlas.utilization)}


def _end_with_parent() -> None:
    while sys.stdin.buffer.read(4096):
        continue
    os._exit(0)


def main() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    folder = Path(sys.argv[1])
    for number in sys.argv[2:]:
        with np.load(folder / f"in_{number}.npz", allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        if "uv" in arrays:
            result = pack(arrays["uv"], arrays["faces"], int(arrays["resolution"]), int(arrays["padding"]))
        else:
            result = charts(arrays["vertices"], arrays["faces"], float(arrays["texels_per_unit"]))
        temporary = folder / f"part_{number}.npz"
        np.savez(temporary, **result)
        os.replace(temporary, folder / f"out_{number}.npz")
    # An orderly shutdown would wait for the thread that watches stdin.
    os._exit(0)


if __name__ == "__main__":
    main()
