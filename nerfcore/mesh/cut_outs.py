"""What masks leave out, on a surface: scraps of surroundings that some photos' masks let in and others' do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ..data.scene import View
from ..geometry.cameras import project
from ..images.working import nearest, read_image
from ..progress import Reporter

MANY = 0.25  # of the photos that have a place in their frame, whose masks must leave it out
AROUND = 2  # pixels around a mask that are not outside of it


def left_out(vertices: np.ndarray, faces: np.ndarray, views: Sequence[View], report: Reporter) -> np.ndarray:
    """Triangles (F,) bool in whose middle many masks say that nothing is there; two masks at least.

    Args:
        vertices: (V, 3) in the world frame, faces (F, 3). views: photos whose masks are black where nothing is.
    Raises:
        InputError: a mask cannot be read. What `report` raises to stop.
    """
    middle = vertices[faces].mean(1, dtype=np.float64)
    asked, empty = np.zeros(len(faces), np.int32), np.zeros(len(faces), np.int32)
    for view in views:
        report.check()
        if view.mask is None:
            continue
        camera, pose = view.camera, view.camera_to_world
        mask = nearest(read_image(view.mask)[..., 0], camera.width, camera.height) > 0
        mask = scipy.ndimage.binary_dilation(mask, iterations=AROUND)
        place = project(camera, (middle - pose[:3, 3]) @ pose[:3, :3])
        inside = np.flatnonzero(np.isfinite(place).all(1) & ((place >= 0) & (place < mask.shape[::-1])).all(1))
        column, row = place[inside].astype(int).T
        asked[inside] += 1
        empty[inside] += ~mask[row, column]
    return (empty >= 2) & (empty > MANY * asked)
