"""The one form in which photos, poses, labels and masks reach training, whatever they came from."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..geometry.cameras import Camera
from ..geometry.points import Points
from ..geometry.similarity import transform_points, transform_pose


@dataclass(frozen=True)
class View:
    """One posed photo. Paths are absolute; `None` where there is no such file."""

    name: str
    camera: Camera
    camera_to_world: np.ndarray  # (4, 4), OpenCV axes
    image: Path
    label: Path | None = None
    mask: Path | None = None
    depth: Path | None = None
    confidence: Path | None = None
    gain: tuple[float, float, float] | None = None  # of its colours, see `photo.photo_of`


@dataclass(frozen=True)
class ClassInfo:
    """One semantic class. `color` is sRGB in [0, 1]; `priority` ≥ 0 steers samples (see sampling)."""

    id: int
    name: str
    color: tuple[float, float, float]
    priority: float = 1.0


@dataclass(frozen=True)
class Scene:
    """Posed views of one place in one frame.

    `frame` says which: "sfm" (as estimated or imported) or "world" (Blender's: z up, metres when scaled).
    `train` and `test` index `views`. `bounds` (2, 3) is the region of interest when the capture names one.
    `white_background`: transparent pixels of the photos are white in evaluation.
    """

    views: list[View]
    train: list[int]
    test: list[int]
    classes: list[ClassInfo] = field(default_factory=list)
    ignore_id: int = 0
    points: Points = field(default_factory=Points.empty)
    bounds: np.ndarray | None = None
    mask_mode: str = "ignore"
    frame: str = "sfm"

    def unseen_by(self, trained_on: Collection[str]) -> Scene:
        """The scene whose held-out views are those that a run was not trained on, by the names of its photos: which ones are
        held out changes where photos are added or left out later."""
        return replace(self, test=[i for i in self.test if self.views[i].name not in trained_on])

    def transformed(self, similarity: np.ndarray, frame: str) -> Scene:
        """The same scene seen from another frame; `similarity` (4, 4) maps this frame to the new one."""
        views = [
            View(**{**vars(view), "camera_to_world": transform_pose(similarity, view.camera_to_world)})
            for view in self.views
        ]
        points = Points(transform_points(similarity, self.points.xyz), self.points.rgb, self.points.error)
        bounds = self.bounds
        if bounds is not None:
            corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3)
            moved = transform_points(similarity, corners)
            bounds = np.stack([moved.min(0), moved.max(0)])
        return Scene(views, self.train, self.test, self.classes, self.ignore_id, points, bounds, self.mask_mode, frame)
