"""Arrays that a full disk or a bad copy damaged: every reader names the file and says what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fieldwork.addon.scene.package import PackageError
from fieldwork.addon.scene.package import _arrays as package_arrays
from fieldwork.nerfcore.data.readers import dtu
from fieldwork.nerfcore.errors import InputError, ProjectError
from fieldwork.nerfcore.images.arrays import read_array
from fieldwork.nerfcore.mesh.stored import COARSE, load_coarse, mesh_folder
from fieldwork.nerfcore.project.store import POINTS_FILE, load_points, load_visibility


def empty(path: Path) -> None:
    path.write_bytes(b"")


def halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def overwritten(path: Path) -> None:
    """The directory at the end is whole, what the entries hold is not."""
    data = bytearray(path.read_bytes())
    data[60 : len(data) // 2] = b"\xff" * (len(data) // 2 - 60)
    path.write_bytes(bytes(data))


DAMAGES = [empty, halved, overwritten]
READERS: dict[str, tuple[str, Callable[[Path], object], type[Exception]]] = {
    "depth map": ("depth.npz", lambda path: read_array(path), InputError),
    "DTU cameras": ("cameras.npz", lambda path: dtu.read(path.parent), InputError),
    "points": (POINTS_FILE, lambda path: load_points(path.parents[len(Path(POINTS_FILE).parts) - 1]), ProjectError),
    "visibility": (
        POINTS_FILE,
        lambda path: load_visibility(path.parents[len(Path(POINTS_FILE).parts) - 1]),
        ProjectError,
    ),
    "package": ("mesh.npz", package_arrays, PackageError),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("reader", READERS)
def test_damaged_arrays_are_told(tmp_path: Path, reader: str, damage: Callable[[Path], None]) -> None:
    name, read, error = READERS[reader]
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    np.savez_compressed(
        path, xyz=rng.normal(size=(500, 3)), rgb=np.zeros((500, 3)), error=np.zeros(500), view=np.zeros(9)
    )
    damage(path)
    with pytest.raises(error, match=path.name):
        read(path)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_mesh_is_told(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    folder = mesh_folder(tmp_path, "main")
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    np.savez_compressed(folder / COARSE, vertices=rng.normal(size=(500, 3)), faces=np.zeros((9, 3), int))
    damage(folder / COARSE)
    with pytest.raises(ProjectError, match=r"\.npz is damaged"):
        load_coarse(tmp_path, "main")
