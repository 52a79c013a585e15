"""A mesh of the small ball on which its upper class is two things."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fieldwork.nerfcore.mesh.instances import Instance, write_instances


def write_halves(project: Path) -> None:
    """Give the ball a mesh whose upper class is two things: “left” where x < 0, and “right”."""
    folder = project / "exports" / "main"
    folder.mkdir(parents=True)
    turn, height = np.meshgrid(np.arange(48) / 48 * 2 * np.pi, np.linspace(-1, 1, 25), indexing="ij")
    flat = np.sqrt(1 - height**2)
    grid = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], -1).reshape(-1, 3) * 0.5
    number = np.arange(48 * 25).reshape(48, 25)
    a, b = number[:, :-1].ravel(), np.roll(number, -1, 0)[:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    middle = grid[faces].mean(1)
    upper = middle[:, 2] > 0
    arrays = {
        "vertices": grid,
        "faces": faces,
        "normals": grid * 2,
        "colors": np.zeros((len(grid), 3), np.uint8),
        "class_id": np.where(grid[:, 2] > 0, 1, 2).astype(np.int32),
        "face_class": np.where(upper, 1, 2),
        "face_instance": np.where(upper, np.where(middle[:, 0] < 0, 1, 2), 0).astype(np.uint32),
    }
    np.savez(folder / "mesh.npz", **arrays)  # pyright: ignore[reportArgumentType]
    write_instances(
        folder,
        [Instance(n + 1, name, 1, 0.4, (x, 0, 0.2)) for n, (name, x) in enumerate((("left", -0.2), ("right", 0.2)))],
    )
