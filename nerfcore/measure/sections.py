"""Section profiles: where a plane cuts a surface."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..files import atomic_path
from ..mesh.surface import Surface
from ..project.label_revision import LABEL_REVISION
from .views import Projection


@dataclass(frozen=True)
class Profile:
    """Straight pieces of a section: segments (S, 2, 3) in the world, and the class id (S,) of the surface there."""

    segments: np.ndarray
    label: np.ndarray

    def lengths(self) -> dict[int, float]:
        """Length of the section by class id."""
        each = np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=1)
        return {int(c): float(each[self.label == c].sum()) for c in np.unique(self.label)}


def profile(surface: Surface, view: Projection, at: float) -> Profile:
    """The section of a surface by the plane across the third axis of a view, `at` along it."""
    import trimesh  # the library takes its time to load
    from trimesh.intersections import mesh_plane

    mesh = trimesh.Trimesh(surface.vertices.astype(np.float64), surface.faces, process=False)
    segments, face = mesh_plane(mesh, view.axes[2], view.axes[2] * at, return_faces=True)
    return Profile(np.asarray(segments).reshape(-1, 2, 3), surface.face_class[face])


def write_profile(path: Path, found: Profile, names: dict[int, str], label_revision: int | None) -> None:
    """Write the pieces of a section as .csv: class, both ends in the world, and the revision of the marks that the class is
    from, if any. Raises DiskError."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["class", "x0", "y0", "z0", "x1", "y1", "z1", LABEL_REVISION])
        for ends, label in zip(found.segments.reshape(-1, 6).round(6).tolist(), found.label.tolist()):
            table.writerow([names.get(label, label), *ends, label_revision])
