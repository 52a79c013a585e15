"""The photos' cameras for other programs: transforms.json and COLMAP's text files, in the world (z up, metres when scaled)."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import trimesh
from PIL import Image
from trimesh.exchange.ply import export_ply

from ..data.scene import Scene, View
from ..errors import SettingError
from ..files import atomic_path, staged, write_json, write_text
from ..geometry.cameras import Camera, flip_camera_axes
from ..geometry.colmap_cameras import camera_to_colmap
from ..geometry.points import Points
from ..project.label_revision import label_facts

RADIAL = ("k1", "k2", "p1", "p2", "k3")  # in the order of Camera.distortion
FISHEYE = ("k1", "k2", "k3", "k4")


def write_transforms(out: Path, scene: Scene, metres: bool, label_revision: int | None = None) -> list[Path]:
    """A transforms.json as nerfstudio and Instant-NGP read it: camera-to-world with OpenGL axes, intrinsics of each frame
    in pixels, which photos are held out, what black in masks means, and the revision of the marks that label maps are from, if
    they are from any; beside it the sparse points, and classes.json where there are label maps. Where only some photos have
    masks the others get white ones beside it: nerfstudio wants all or none.

    Returns:
        the files written.
    Raises:
        SettingError: there are no keys for such a lens, or a classes.json of something else is in the way. DiskError: a file
        cannot be written.
    """
    # Their k4 is a fourth polynomial term, ours the first of a denominator.
    rational = next((v.name for v in scene.views if any(v.camera.distortion[len(RADIAL) :])), None)
    if rational is not None:
        raise SettingError(
            f"transforms.json has no keys for the lens of {rational}, whose distortion has a denominator.",
            "Export colmap, which has them.",
        )
    frames = [_frame(view, out.parent) for view in scene.views]
    head: dict[str, Any] = {"camera_convention": "OpenGL axes, z up" + (", metres" if metres else "")}
    models = {view.camera.model for view in scene.views}
    head |= {"camera_model": models.pop()} if len(models) == 1 else {}  # nerfstudio looks for it nowhere else
    head |= label_facts(label_revision)
    if scene.test:  # nerfstudio validates on "val", and takes no file that names some splits and not that one
        head |= {
            f"{split}_filenames": [frames[i]["file_path"] for i in indices]
            for split, indices in (("train", scene.train), ("val", scene.test), ("test", scene.test))
        }
    classes = _write_classes(frames, scene, out)
    head |= {"classes_path": classes.name} if classes else {}
    head |= {"mask_mode": scene.mask_mode} if any("mask_path" in frame for frame in frames) else {}
    files = [out, *([classes] if classes else []), *_white_masks(frames, out)]
    if len(scene.points.xyz):
        cloud = out.with_name(f"{out.stem}_points.ply")
        with atomic_path(cloud) as temporary:
            points = trimesh.PointCloud(scene.points.xyz, scene.points.rgb)
            temporary.write_bytes(export_ply(points))
        head["ply_file_path"] = cloud.name
        files.append(cloud)
    write_json(out, {**head, "frames": frames})
    return files


def _frame(view: View, folder: Path) -> dict[str, Any]:
    camera = view.camera
    frame: dict[str, Any] = {
        "file_path": _relative(view.image, folder),
        "transform_matrix": flip_camera_axes(view.camera_to_world).tolist(),
        "camera_model": camera.model,
        "w": camera.width,
        "h": camera.height,
    }
    if view.mask is not None:
        frame["mask_path"] = _relative(view.mask, folder)
    if view.label is not None:
        frame["semantic_path"] = _relative(view.label, folder)
    frame |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    if camera.model == "OPENCV_FISHEYE":
        frame["is_fisheye"] = True  # in Instant-NGP's words
    return frame | dict(zip(FISHEYE if camera.model == "OPENCV_FISHEYE" else RADIAL, camera.distortion))


def _write_classes(frames: list[dict[str, Any]], scene: Scene, out: Path) -> Path | None:
    """Write what the ids in label maps mean beside the file `out`; None where no frame has labels."""
    if not any("semantic_path" in frame for frame in frames):
        return None
    entries = {str(c.id): {"name": c.name, "color": [round(part * 255) for part in c.color]} for c in scene.classes}
    path, value = out.with_name("classes.json"), {"ignore_id": scene.ignore_id, "classes": entries}
    if path.exists() and not _says(path, None, value) and not _says(out, "classes_path", path.name):
        raise SettingError(
            f"{path} is there already and belongs to something else.", "Choose another folder with --out."
        )
    write_json(path, value)
    return path


def _says(path: Path, key: str | None, value: Any) -> bool:
    """Whether a JSON file holds a value, as a whole or under a key."""
    try:
        there = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return there == value if key is None else isinstance(there, dict) and there.get(key) == value


def _white_masks(frames: list[dict[str, Any]], out: Path) -> list[Path]:
    """Give frames without a mask a white one of their size, if others have one; the files written."""
    if not any("mask_path" in frame for frame in frames):
        return []
    written: list[Path] = []
    for frame in frames:
        if "mask_path" not in frame:
            path = out.with_name(f"{out.stem}_white_{frame['w']}x{frame['h']}.png")
            frame["mask_path"] = path.name
            if path not in written:
                with atomic_path(path) as temporary:
                    Image.new("L", (frame["w"], frame["h"]), 255).save(temporary)
                written.append(path)
    return written


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive of Windows
        return path.as_posix()


def write_colmap(out: Path, scene: Scene) -> list[Path]:
    """A COLMAP model in text files, OUT/sparse/0. Photos are named below the folder that holds them all.

    Returns:
        the files written.
    Raises:
        InputError: COLMAP has no such lens. DiskError: a file cannot be written.
    """
    cameras = list(dict.fromkeys(view.camera for view in scene.views))
    root = _photo_folder(scene.views)
    model = out / "sparse" / "0"
    texts = {
        "cameras.txt": _camera_rows(cameras),
        "images.txt": _image_rows(scene.views, cameras, root),
        "points3D.txt": _point_rows(scene.points),
    }
    with staged(model) as place:
        for name, rows in texts.items():
            write_text(place / name, "\n".join(rows) + "\n")
    return [model / name for name in texts]


def _photo_folder(views: Sequence[View]) -> Path:
    """The folder below which all photos lie."""
    return Path(os.path.commonpath([view.image.parent for view in views]))


def _camera_rows(cameras: Sequence[Camera]) -> list[str]:
    rows = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in enumerate(cameras, 1):
        model, parameters = camera_to_colmap(camera)
        rows.append(f"{number} {model} {camera.width} {camera.height} {_numbers(parameters)}")
    return rows


def _image_rows(views: Sequence[View], cameras: Sequence[Camera], root: Path) -> list[str]:
    rows = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, view in enumerate(views, 1):
        camera_from_world = np.linalg.inv(view.camera_to_world)
        x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(camera_from_world[:3, :3]).as_quat()
        pose = _numbers([w, x, y, z, *camera_from_world[:3, 3]])
        name = view.image.relative_to(root).as_posix()
        # The second line lists the image's points: which photo shows which is not told.
        rows += [f"{number} {pose} {cameras.index(view.camera) + 1} {name}", ""]
    return rows


def _point_rows(points: Points) -> list[str]:
    rows = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, (place, color, error) in enumerate(zip(points.xyz, points.rgb.tolist(), points.error), 1):
        rows.append(f"{number} {_numbers(place)} {' '.join(map(str, color))} {_numbers([error])}")
    return rows


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
