"""COLMAP models, text or binary, with or without rigs: `sparse/0`, `sparse` or the folder itself, and `images/`.

Poses are world-to-camera quaternions (w, x, y, z) and translations. In models with rigs every image still carries its
own pose, so that rigs.bin and frames.bin need not be read. Format source: COLMAP's documentation.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.cameras import Camera
from ...geometry.colmap_cameras import MODELS, camera_from_colmap
from ...geometry.frames import upright
from ...geometry.points import Points
from ...images.decode import image_size
from ...images.names import find_image, labels_and_masks, list_images, unique_names
from ...progress import shortened
from ..dataset import Dataset, DatasetView, lens_at_size, not_imported, require

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "dense/sparse", ".")


@dataclass(frozen=True)
class ColmapImage:
    name: str
    camera: int
    camera_to_world: np.ndarray


def matches(folder: Path) -> bool:
    return _model_folder(folder) is not None


def _model_folder(folder: Path) -> Path | None:
    if not folder.is_dir():
        return None
    for place in PLACES:
        found = folder / place
        for suffix in (".bin", ".txt"):
            if (found / f"cameras{suffix}").is_file() and (found / f"images{suffix}").is_file():
                return found
    return None


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    model = _model_folder(folder)
    if model is None:
        raise InputError(f"{folder} has no COLMAP model.", "It needs cameras and images (.bin or .txt) in sparse/0.")
    cameras, images, points = read_model(model)
    found: list[tuple[Path, ColmapImage]] = []
    missing = []
    # The model itself may be given, whose photos, and what belongs to them, lie up to two folders above.
    places = [(folder / "images", folder), (folder, folder)]
    places += [(top / "images", top) for top in (model, model.parent, model.parent.parent)]
    roots = [folder] if any((folder / name).is_dir() for name in ("labels", "masks")) else []
    for image in images:
        path, top = next(((p, top) for place, top in places if (p := find_image(place / image.name))), (None, folder))
        if path is None:
            missing.append(image.name)
        else:
            found.append((path, image))
            roots.append(top)
    root = roots[0] if roots else folder
    names = unique_names([path for path, _ in found], root / "images")
    views = []
    companions = labels_and_masks(root, [path for path, _ in found], names)
    for name, (path, image), (label, mask) in zip(names, found, companions):
        views.append(
            DatasetView(
                name=name,
                image=path,
                camera=lens_at_size(cameras[image.camera], image_size(path), path),
                camera_to_world=image.camera_to_world,
                label=label,
                mask=mask,
            )
        )
    require(views, folder, missing)
    frame, confidence = upright([view.camera_to_world for view in views], points.xyz)
    warnings = [f"{len(missing)} images of the model are missing (first: {missing[0]})."] if missing else []
    placed = {path.resolve() for path, _ in found}
    without = [path.name for path in list_images(root / "images") if path.resolve() not in placed]
    if without:
        warnings.append(shortened(not_imported(len(without), model), without))
    return Dataset(
        format="colmap",
        views=views,
        world_from_sfm=frame,
        up_confidence=confidence,
        points=points,
        warnings=warnings,
        root=root,
    )


def read_model(model: Path) -> tuple[dict[int, Camera], list[ColmapImage], Points]:
    """Cameras by id, images by name, and points of a model folder. Raises InputError naming a damaged file."""
    binary = (model / "cameras.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    parsers: list[Callable[[Path], Any]] = (
        [_cameras_binary, _images_binary, _points_binary] if binary else [_cameras_text, _images_text, _points_text]
    )
    parts = []
    for name, parse in zip(("cameras", "images", "points3D"), parsers):
        path = model / f"{name}{suffix}"
        if name == "points3D" and not path.is_file():
            parts.append(Points.empty())
            continue
        try:
            parts.append(parse(path))
        except (OSError, ValueError, IndexError, KeyError, struct.error) as error:
            raise InputError(f"{path} is damaged: {error}.", "Export the model from COLMAP again.") from error
    cameras, images, points = parts
    without = next((image for image in images if image.camera not in cameras), None)
    if without is not None:
        raise InputError(
            f"{model / f'cameras{suffix}'} is damaged: it lacks camera {without.camera} of {without.name}.",
            "Export the model from COLMAP again.",
        )
    return cameras, sorted(images, key=lambda image: image.name), points


def pose_from_quaternion(quaternion: Sequence[float], translation: Sequence[float]) -> np.ndarray:
    """Camera-to-world (4, 4) from COLMAP's world-to-camera quaternion (w, x, y, z) and translation."""
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ np.array(translation)
    return pose


def _rows(path: Path, fields: int = -1) -> Iterator[list[str]]:
    """The rows of a file, split into words; what comes behind the first `fields` words stays together."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            yield line.split(maxsplit=fields)


def _cameras_text(path: Path) -> dict[int, Camera]:
    return {
        int(row[0]): camera_from_colmap(row[1], int(row[2]), int(row[3]), [float(p) for p in row[4:]])
        for row in _rows(path)
        if row
    }


def _images_text(path: Path) -> list[ColmapImage]:
    images = []
    rows = list(_rows(path, 9))  # names may hold spaces
    # Every second line lists the image's points, and may be empty.
    for row in rows[::2]:
        if not row:
            continue
        numbers = [float(value) for value in row[1:8]]
        pose = pose_from_quaternion(numbers[:4], numbers[4:])
        images.append(ColmapImage(row[9].rstrip(), int(row[8]), pose))
    return images


def _points_text(path: Path) -> Points:
    rows = [[float(value) for value in row[1:8]] for row in _rows(path) if row]
    if not rows:
        return Points.empty()
    values = np.array(rows)
    return Points(values[:, :3], values[:, 3:6].astype(np.uint8), values[:, 6])


class _Reader:
    """Little-endian values from a file read whole."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, format: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + format, self.data, self.at)
        self.at += struct.calcsize("<" + format)
        return values

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        value = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return value

    def skip(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise ValueError("it ends early")
        self.at += size


def _cameras_binary(path: Path) -> dict[int, Camera]:
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.take("Q")[0]):
        number, model, width, height = reader.take("iiQQ")
        if model not in MODELS:
            raise InputError(f"{path} has the unknown camera model {model}.", "Undistort the images with COLMAP first.")
        name, count = MODELS[model]
        cameras[number] = camera_from_colmap(name, width, height, reader.take(f"{count}d"))
    return cameras


def _images_binary(path: Path) -> list[ColmapImage]:
    reader = _Reader(path)
    images = []
    for _ in range(reader.take("Q")[0]):
        reader.take("i")
        values = reader.take("7d")
        camera = reader.take("i")[0]
        name = reader.text()
        reader.skip(24 * reader.take("Q")[0])
        images.append(ColmapImage(name, camera, pose_from_quaternion(values[:4], values[4:])))
    return images


def _points_binary(path: Path) -> Points:
    reader = _Reader(path)
    count = reader.take("Q")[0]
    xyz, rgb, error = np.zeros((count, 3)), np.zeros((count, 3), np.uint8), np.zeros(count)
    for i in range(count):
        _, *values = reader.take("Q3d3Bd")
        xyz[i], rgb[i], error[i] = values[:3], values[3:6], values[6]
        reader.skip(8 * reader.take("Q")[0])
    return Points(xyz, rgb, error)
