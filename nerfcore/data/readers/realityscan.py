"""RealityScan (RealityCapture): XMP files beside the photos, written by "Export metadata (XMP)".

xcr:Rotation is world-to-camera, row by row, with OpenCV axes; xcr:Position the camera's centre. Lengths on the image
are in units of its longer side: focal length as 35 mm equivalent, principal point from the middle. Brown lenses act
on normalised coordinates. Source: RealityCapture's "XMP camera math". Its worlds have z up. Each component, photos that
were aligned with each other, has a world of its own, unless they are georeferenced.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.cameras import Camera
from ...geometry.frames import upright
from ...images.decode import image_size
from ...images.names import find_image, labels_and_masks, unique_names
from ...progress import shortened
from ..dataset import Dataset, DatasetView, require

METRIC = ("absolute",)


def matches(folder: Path) -> bool:
    return folder.is_dir() and bool(_files(folder))


def _files(folder: Path) -> list[Path]:
    found = []
    for place in (folder, folder / "images"):
        for path in sorted(place.glob("*.xmp")):
            if "xcr:Rotation" in path.read_text(encoding="utf-8", errors="replace"):
                found.append(path)
    return found


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    files, apart = _of_one_world(_files(folder))
    found, missing = [], []
    for file in files:
        image = next((p for d in (file.parent, folder / "images") if (p := find_image(d / file.stem))), None)
        if image is None:
            missing.append(file.stem)
        else:
            found.append((file, image))
    images = [image for _, image in found]
    names = unique_names(images, folder)
    views, coordinates = [], set()
    for name, (file, image), (label, mask) in zip(names, found, labels_and_masks(folder, images, names)):
        text = file.read_text(encoding="utf-8", errors="replace")
        coordinates.add(_text(text, "Coordinates"))
        rotation, position = _numbers(file, text, "Rotation", 9), _numbers(file, text, "Position", 3)
        pose = np.eye(4)
        pose[:3, :3] = np.array(rotation).reshape(3, 3).T
        pose[:3, 3] = position
        views.append(
            DatasetView(
                name=name,
                image=image,
                camera=_camera(file, text, image_size(image)),
                camera_to_world=pose,
                label=label,
                mask=mask,
            )
        )
    require(views, folder, missing)
    metric = coordinates <= set(METRIC)
    frame, confidence = (np.eye(4), None) if metric else upright([view.camera_to_world for view in views])
    if metric:
        # Geographic coordinates are far from the origin: bring the cameras near it, keeping metres.
        frame[:3, 3] = -np.mean([view.camera_to_world[:3, 3] for view in views], axis=0)
    warnings = [f"{len(missing)} photos of XMP files are missing (first: {missing[0]})."] if missing else []
    if apart:
        text = f"{len(apart)} photos are left out: they are of other components, and nothing says how these lie to each other"
        warnings.append(shortened(text, [file.stem for file in apart]))
    return Dataset("realityscan", views, frame, confidence, scale_known=metric, warnings=warnings)


def _of_one_world(files: list[Path]) -> tuple[list[Path], list[Path]]:
    """The files of georeferenced photos, else of the largest component; and the others."""
    texts = [file.read_text(encoding="utf-8", errors="replace") for file in files]
    metric = [_text(text, "Coordinates") in METRIC for text in texts]
    worlds = ["" if own else _text(text, "ComponentId") for own, text in zip(metric, texts)]
    kept = "" if any(metric) else next((w for w, _ in Counter(filter(None, worlds)).most_common(1)), None)
    inside = [world in (kept, None) for world in worlds]  # older files name no component
    return [f for f, one in zip(files, inside) if one], [f for f, one in zip(files, inside) if not one]


def _text(text: str, name: str) -> str | None:
    """The value of xcr:<name>, an element or an attribute."""
    found = re.search(rf"<xcr:{name}>([^<]*)</xcr:{name}>", text) or re.search(rf'xcr:{name}="([^"]*)"', text)
    return found.group(1).strip() if found else None


def _numbers(file: Path, text: str, name: str, count: int) -> list[float]:
    value = _text(text, name)
    try:
        numbers = [float(part) for part in (value or "").split()]
    except ValueError as error:
        raise InputError(f"{file} is damaged at xcr:{name}: {error}.", "Export the metadata again.") from error
    if len(numbers) != count:
        raise InputError(f"{file} has no xcr:{name} of {count} numbers.", "Export the metadata again.")
    return numbers


def _camera(file: Path, text: str, size: tuple[int, int]) -> Camera:
    width, height = size
    side = max(size)
    (focal,) = _numbers(file, text, "FocalLength35mm", 1)
    u, v = (float(_text(text, f"PrincipalPoint{axis}") or 0.0) for axis in "UV")
    aspect = float(_text(text, "AspectRatio") or 1.0)
    model = (_text(text, "DistortionModel") or "perspective").lower()
    f = focal / 36.0 * side
    placed: dict[str, Any] = {"fx": f, "fy": f * aspect, "cx": width / 2 + u * side, "cy": height / 2 + v * side}
    value = _text(text, "DistortionCoeficients") or _text(text, "DistortionCoefficients") or ""
    k1, k2, k3, k4, t1, t2 = ([float(part) for part in value.split()] + [0.0] * 6)[:6]
    if not any((k1, k2, k3, k4, t1, t2)) or model == "perspective":
        return Camera(width=width, height=height, **placed)
    if not model.startswith("brown"):
        raise InputError(f"{file} uses the distortion model {model}.", "Choose a Brown model, or export undistorted.")
    if k4:
        raise InputError(f"{file} uses a fourth radial term.", "Choose the model Brown3, or export undistorted.")
    distortion = (k1, k2, t1, t2) + ((k3,) if k3 else ())
    return Camera(model="OPENCV", width=width, height=height, distortion=distortion, **placed)
