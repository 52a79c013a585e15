"""Agisoft Metashape's camera export (XML): one file, with the photos beside it or in `images/`.

Poses are camera-to-world with OpenCV axes in the chunk's own frame, or in that of their component, of which a chunk has
several where its photos were not all aligned with each other. The transform of the chunk or component, where there is one,
leads to metres, and for geographic projects to geocentric coordinates, which are turned into a local frame with z up.
Lens source: appendix "Camera models" of the Metashape manual.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.cameras import Camera
from ...geometry.earth import up_at
from ...geometry.frames import rotation_to_z, upright
from ...geometry.similarity import make_similarity, transform_pose
from ...images.decode import image_size
from ...images.names import find_image, labels_and_masks, unique_names
from ...progress import shortened
from ..dataset import Dataset, DatasetView, lens_at_size, not_imported, require

EARTH = 5_000_000.0  # metres from the centre of the earth beyond which coordinates are geocentric: its radius is 6.4 million


def matches(folder: Path) -> bool:
    return _file(folder) is not None


def _file(folder: Path) -> Path | None:
    candidates = [folder] if folder.is_file() else sorted(folder.glob("*.xml"))
    for path in candidates:
        if path.suffix.lower() != ".xml":
            continue
        with open(path, "rb") as file:
            head = file.read(2000)
        if b"<document" in head and b"<chunk" in head:
            return path
    return None


def read(folder: Path) -> Dataset:
    """Read `folder` or the XML file. Raises InputError naming the file that is missing or damaged."""
    path = _file(folder)
    if path is None:
        raise InputError(f"{folder} has no Metashape camera export.", "Export cameras as Agisoft XML.")
    folder = path.parent
    try:
        chunk = ElementTree.parse(path).getroot().find("chunk")
        if chunk is None:
            raise ValueError("it has no chunk")
        sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        frames = {c.get("id"): _similarity(c.find("transform")) for c in chunk.iter("component")}
        whole = _similarity(chunk.find("transform"))
        scaled = next(chunk.iter("scale"), None) is not None
        entries, without = [], []
        for camera in chunk.iter("camera"):
            transform = camera.find("transform")
            if camera.get("enabled") in ("0", "false"):
                continue
            if transform is None or not transform.text:
                without.append(camera.get("label", ""))
                continue
            pose = np.array(transform.text.split(), np.float64).reshape(4, 4)
            entries.append(
                (camera.get("label", ""), sensors[camera.get("sensor_id")], pose, camera.get("component_id"))
            )
    except (OSError, ElementTree.ParseError, ValueError, KeyError) as error:
        raise InputError(f"{path} is damaged: {error}.", "Export the cameras from Metashape again.") from error
    reference, to_reference = _one_frame([component for *_, component in entries], frames, whole)
    warnings = [shortened(not_imported(len(without), path), without)] if without else []
    apart = [label for label, *_, component in entries if component not in to_reference]
    if apart:
        text = f"{len(apart)} photos are left out: nothing in {path.name} says how their component lies to that of the others"
        warnings.append(shortened(text, apart))
    found: dict[Path, tuple[ElementTree.Element, np.ndarray]] = {}
    missing = []
    for label, sensor, pose, component in entries:
        if component not in to_reference:
            continue
        image = next((p for d in (folder, folder / "images") if (p := find_image(d / label))), None)
        if image is None:
            missing.append(label)
        elif image in found:
            raise InputError(
                f"{path} has two cameras that are called {label}.",
                "Name them in Metashape by folder and file, for example left/0001, and export again.",
            )
        else:
            found[image] = sensor, transform_pose(to_reference[component], pose)
    images = list(found)
    names = unique_names(images, folder)
    views = [
        DatasetView(
            name=name,
            image=image,
            camera=_camera(sensor, image, path),
            camera_to_world=pose,
            label=label_map,
            mask=mask,
        )
        for name, (image, (sensor, pose)), (label_map, mask) in zip(
            names, found.items(), labels_and_masks(folder, images, names)
        )
    ]
    require(views, path, missing)
    warnings += [f"{len(missing)} photos of the export are missing (first: {missing[0]})."] if missing else []
    if reference is None or np.allclose(reference, np.eye(4)):  # which says nothing
        frame, confidence = upright([view.camera_to_world for view in views])
        return Dataset("metashape", views, frame, confidence, warnings=warnings)
    return Dataset("metashape", views, _local(reference, views), scale_known=scaled, warnings=warnings)


def _one_frame(
    components: Sequence[str | None], frames: Mapping[str | None, np.ndarray | None], whole: np.ndarray | None
) -> tuple[np.ndarray | None, dict[str | None, np.ndarray]]:
    """The frame that all poses are brought into, as its transform (4, 4) or None, and the similarity (4, 4) into it from that
    of each component. Components of which nothing says how they lie to it are left out, or all others where one of these
    has more cameras.

    Args:
        components: of each camera that has a pose. frames: transforms of components. whole: that of the chunk.
    """
    counts = Counter(components)
    placed = {
        c: whole if frames.get(c) is None or (whole is not None and len(counts) == 1) else frames[c] for c in counts
    }
    known = {component: transform for component, transform in placed.items() if transform is not None}
    loose = next((component for component, _ in counts.most_common() if component not in known), None)
    if not known or counts[loose] > sum(counts[component] for component in known):
        return None, {loose: np.eye(4)}
    reference = next(iter(known.values()))
    moved = {component: np.linalg.inv(reference) @ transform for component, transform in known.items()}
    return reference, moved | {c: np.eye(4) for c in known if np.array_equal(known[c], reference)}  # no digit is lost


def _similarity(element: ElementTree.Element | None) -> np.ndarray | None:
    """The chunk's or component's transform (4, 4), or None when it has none."""
    if element is None:
        return None
    rotation, translation, scale = (element.find(name) for name in ("rotation", "translation", "scale"))
    if rotation is None or not rotation.text or translation is None or not translation.text:
        return None
    factor = float(scale.text) if scale is not None and scale.text else 1.0
    matrix = np.array(rotation.text.split(), np.float64).reshape(3, 3)
    return make_similarity(factor, matrix, np.array(translation.text.split(), np.float64))


def _local(chunk: np.ndarray, views: list[DatasetView]) -> np.ndarray:
    """The chunk's transform; geocentric ones go on to a frame at the cameras with z up."""
    center = (chunk @ np.mean([view.camera_to_world[:, 3] for view in views], axis=0))[:3]
    if np.linalg.norm(center) < EARTH:
        return chunk
    to_local = np.eye(4)
    north = np.array([0.0, 0.0, 1.0])
    to_local[:3, :3] = rotation_to_z(up_at(center), north)
    to_local[:3, 3] = -to_local[:3, :3] @ center
    return to_local @ chunk


def _camera(sensor: ElementTree.Element, image: Path, path: Path) -> Camera:
    size = image_size(image)
    calibration = next(
        (c for c in sensor.findall("calibration") if c.get("class") != "initial"), sensor.find("calibration")
    )
    resolution = sensor.find("resolution")
    if resolution is None:
        raise InputError(f"{path}: a sensor has no resolution.", "Export the cameras from Metashape again.")
    width, height = int(resolution.get("width", 0)), int(resolution.get("height", 0))
    kind = sensor.get("type", "frame")
    if kind == "spherical":
        (w, h), focal = size, size[0] / 2  # as in transforms.json: no ray depends on it
        return Camera(model="EQUIRECTANGULAR", width=w, height=h, fx=focal, fy=focal, cx=w / 2, cy=h / 2)
    if calibration is None:
        raise InputError(f"{path}: a sensor has no calibration.", "Align the photos in Metashape and export again.")
    values = {child.tag: float(child.text) for child in calibration if child.text and child.tag != "resolution"}
    if "f" not in values:
        raise InputError(f"{path}: a calibration has no focal length.", "Export the cameras from Metashape again.")
    f, k1, k2, k3, k4 = (values.get(name, 0.0) for name in ("f", "k1", "k2", "k3", "k4"))
    p1, p2, b1, b2 = (values.get(name, 0.0) for name in ("p1", "p2", "b1", "b2"))
    if abs(b2) * max(width, height) / f > 1.0:
        raise InputError(f"{path} has a skewed lens (b2 = {b2:g}).", "Align in Metashape without fitting b2.")
    placed: dict[str, Any] = {
        "fx": f + b1,
        "fy": f,
        "cx": width / 2 + values.get("cx", 0.0),
        "cy": height / 2 + values.get("cy", 0.0),
    }
    if kind == "fisheye":
        moved = 3 * max(abs(p1), abs(p2)) * (width**2 + height**2) / 4 / f  # pixels, at the corners
        if moved > 1.0:
            raise InputError(
                f"{path} fits p1 and p2 of a fisheye lens, which move its corners by up to {moved:.0f} pixels.",
                "Align in Metashape without fitting them, or undistort the photos.",
            )
        camera = Camera(model="OPENCV_FISHEYE", width=width, height=height, distortion=(k1, k2, k3, k4), **placed)
    elif kind == "frame":
        if k4 or any(values.get(name) for name in ("p3", "p4")):
            raise InputError(f"{path} fits k4, p3 or p4.", "Align in Metashape without them, or undistort the photos.")
        # Metashape's p1 and p2 are OpenCV's p2 and p1.
        distortion = (k1, k2, p2, p1) + ((k3,) if k3 else ())
        distorted = any(distortion)
        camera = Camera(
            model="OPENCV" if distorted else "PINHOLE",
            width=width,
            height=height,
            distortion=distortion if distorted else (),
            **placed,
        )
    else:
        raise InputError(f"{path} has the lens type {kind}.", "Undistort the photos in Metashape and export again.")
    return lens_at_size(camera, size, image)
