"""A viewport that watches a training, without a Blender."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
from fieldwork.nerfcore.film.shared_file import HEADER
from fieldwork.nerfcore.project import live


def perspective(eye: tuple[float, float, float], near: float = 0.1, far: float = 100.0) -> np.ndarray:
    """Clip space from the scene (4, 4) of a square view along y with a field of view of 90°, z up."""
    camera = np.eye(4)
    camera[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # columns: right, up, backwards
    camera[:3, 3] = eye
    clip = np.zeros((4, 4))
    clip[0, 0] = clip[1, 1] = 1
    clip[2, 2], clip[2, 3], clip[3, 2] = (far + near) / (near - far), 2 * far * near / (near - far), -1
    return clip @ np.linalg.inv(camera)


class Viewer:
    """Asks for pictures of a run and reads them."""

    def __init__(self, project: Path, folder: Path, side: int = 96, run: str = "main") -> None:
        self.project, self.run, self.side, self.number = project, run, side, 0
        self.file = folder / "view.pixels"
        self.file.write_bytes(bytes(HEADER + 20 * side * side))
        with open(self.file, "rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._seen = 0

    def ask(self, clip_from_scene: np.ndarray, **field) -> None:
        """Look from somewhere."""
        self.number += 1
        item = {"name": "ball", "project": str(self.project), "run": self.run, **field}
        item.setdefault("scene_from_capture", np.eye(4).tolist())
        request = {
            "number": self.number,
            "width": self.side,
            "height": self.side,
            "scene_from_clip": np.linalg.inv(clip_from_scene).tolist(),
            "field": item,
            "file": str(self.file),
        }
        assert live.write(live.views_file(self.project), {"views": [request]})

    def look(self) -> tuple[int, np.ndarray, np.ndarray] | None:
        """The number, colours and depths of a picture that was not read before; None where there is none."""
        counter, number, width, height = np.frombuffer(self._map[:32], np.int64)
        if counter == self._seen:
            return None
        assert counter % 2 == 0
        self._seen = counter
        values = np.frombuffer(self._map[HEADER : HEADER + 20 * width * height], np.float32)
        return (
            int(number),
            values[: 4 * width * height].reshape(height, width, 4),
            values[4 * width * height :].reshape(height, width),
        )
