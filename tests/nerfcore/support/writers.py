"""Posed data sets in the words of each format, for reading them back."""

from __future__ import annotations

import json
import os
import zlib  # noqa: F401  (before pycolmap)
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from fieldwork.nerfcore.data.dataset import DatasetView
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes, project, rays
from fieldwork.tests.nerfcore.support.photos import picture
from PIL import Image


def bend(view: DatasetView, folder: Path) -> DatasetView:
    """The photo as a lens with distortion would have taken it, at two thirds of the size."""
    from scipy.ndimage import map_coordinates

    camera = Camera(
        model="OPENCV", width=1000, height=660, fx=905, fy=902, cx=493, cy=337, distortion=(-0.3, 0.08, 0.002, -0.003)
    )
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions, valid = rays(camera, np.stack([x.ravel(), y.ravel()], -1))
    assert valid.all()
    source = project(view.camera, directions) - 0.5
    with Image.open(view.image) as image:
        pixels = np.asarray(image.convert("RGB")).astype(np.float32)
    shape = (camera.height, camera.width)
    at = source[:, ::-1].T.reshape(2, *shape)
    bands = [map_coordinates(pixels[..., band], at, order=1, mode="nearest") for band in range(3)]
    path = folder / f"v{view.name}.png"
    Image.fromarray(np.stack(bands, -1).astype(np.uint8)).save(path, compress_level=1)
    return replace(view, name=path.stem, image=path, camera=camera)


def link_images(views: list[DatasetView], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        os.symlink(view.image, folder / view.image.name)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w, x, y, z of a rotation."""
    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    return np.array([w, x, y, z])


def write_transforms(views: list[DatasetView], folder: Path, style: str) -> None:
    link_images(views, folder / "images")
    camera = views[0].camera
    k1, k2, p1, p2 = camera.distortion
    lens: dict[str, Any] = {
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
        "k1": k1, "k2": k2, "p1": p1, "p2": p2,
    }  # fmt: skip
    frames: list[dict[str, Any]] = [
        {
            "file_path": f"images/{view.image.name}",
            "transform_matrix": flip_camera_axes(view.camera_to_world).tolist(),
        }
        for view in views
    ]
    if style == "instant-ngp":
        head = {**lens, "aabb_scale": 16}
    else:  # nerfstudio, with intrinsics in every frame and a named split
        head = {"camera_model": "OPENCV", "train_filenames": [], "test_filenames": [frames[1]["file_path"]]}
        frames = [{**frame, **lens} for frame in frames]
    (folder / "transforms.json").write_text(json.dumps({**head, "frames": frames}))


def write_colmap_text(views: list[DatasetView], folder: Path) -> None:
    link_images(views, folder / "images")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    c = views[0].camera
    params = " ".join(str(p) for p in (c.fx, c.fy, c.cx, c.cy, *c.distortion))
    (model / "cameras.txt").write_text(f"# Camera list\n1 OPENCV {c.width} {c.height} {params}\n")
    lines = ["# Image list"]
    for i, view in enumerate(views, 1):
        w2c = np.linalg.inv(view.camera_to_world)
        values = [*quaternion(w2c[:3, :3]), *w2c[:3, 3]]
        lines += [f"{i} {' '.join(map(repr, map(float, values)))} 1 {view.image.name}", "" if i % 2 else "10 20 -1"]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("# Points\n7 1.5 2.5 3.5 10 20 30 0.25 1 0 2 3\n")


def write_colmap_binary(views: list[DatasetView], folder: Path) -> None:
    """By COLMAP itself, with all views as one rig of two cameras seen at several moments."""
    link_images(views, folder / "images")
    c = views[0].camera
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        params = [c.fx, c.fy, c.cx, c.cy, *c.distortion]
        model.add_camera(
            pycolmap.Camera(camera_id=number, model="OPENCV", width=c.width, height=c.height, params=params)
        )
    first, second = (np.linalg.inv(view.camera_to_world) for view in views[:2])
    between = second @ np.linalg.inv(first)
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), pycolmap.Rigid3d(between[:3]))
    model.add_rig(rig)
    lone = pycolmap.Rig(rig_id=2)
    model.add_camera(pycolmap.Camera(camera_id=3, model="OPENCV", width=c.width, height=c.height, params=params))
    lone.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 3))
    model.add_rig(lone)
    moments = [(1, [(1, views[0]), (2, views[1])])] + [(2, [(3, view)]) for view in views[2:]]
    image_id = 0
    for number, (rig_id, members) in enumerate(moments, 1):
        frame = pycolmap.Frame(frame_id=number, rig_id=rig_id)
        frame.rig_from_world = pycolmap.Rigid3d(np.linalg.inv(members[0][1].camera_to_world)[:3])
        images = []
        for camera_id, view in members:
            image_id += 1
            image = pycolmap.Image(name=view.image.name, camera_id=camera_id, image_id=image_id, frame_id=number)
            frame.add_data_id(image.data_id if hasattr(image, "data_id") else image_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
    model.add_point3D(np.array([1.5, 2.5, 3.5]), pycolmap.Track(), np.array([10, 20, 30], np.uint8))
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    for number in range(1, len(moments) + 1):
        model.register_frame(number)
    model.write_binary(str(target))


def write_scannet(views: list[DatasetView], folder: Path) -> None:
    link_images(views, folder / "color")
    for name in ("pose", "intrinsic", "depth", "label-filt"):
        (folder / name).mkdir()
    c = views[0].camera
    k = np.eye(4)
    # ScanNet counts pixel centres from zero.
    k[0, 0], k[1, 1], k[0, 2], k[1, 2] = c.fx, c.fy, c.cx - 0.5, c.cy - 0.5
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", k)
    for view in views:
        np.savetxt(folder / "pose" / f"{view.image.stem}.txt", view.camera_to_world)
        depth = np.full((330, 500), 2500, np.uint16)
        depth[:10] = 0
        Image.fromarray(depth).save(folder / "depth" / f"{view.image.stem}.png")
        Image.fromarray(np.full((660, 1000), 3, np.uint16)).save(folder / "label-filt" / f"{view.image.stem}.png")
    np.savetxt(folder / "pose" / f"{views[-1].image.stem}.txt", np.full((4, 4), -np.inf))


def write_replica(views: list[DatasetView], folder: Path) -> None:
    """NICE-SLAM's form of Replica: results/frame000000.png, traj.txt, cam_params.json in the parent folder."""
    results = folder / "office" / "results"
    results.mkdir(parents=True)
    for i, view in enumerate(views):
        os.symlink(view.image, results / f"frame{i:06d}.png")
        Image.fromarray(np.full((660, 1000), 13107, np.uint16)).save(results / f"depth{i:06d}.png")
    np.savetxt(folder / "office" / "traj.txt", [view.camera_to_world.ravel() for view in views])
    c = views[0].camera
    values = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": values}))


def write_dtu(views: list[DatasetView], folder: Path) -> None:
    link_images(views, folder / "image")
    c = views[0].camera
    k = np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])
    scale = np.diag([3.0, 3.0, 3.0, 1.0])
    scale[:3, 3] = 1, 2, 3
    matrices = {}
    for i, view in enumerate(views):
        world = np.eye(4)
        world[:3] = -2.0 * k @ np.linalg.inv(view.camera_to_world)[:3]  # projection matrices have no scale nor sign
        matrices[f"world_mat_{i}"], matrices[f"scale_mat_{i}"] = world, scale
    np.savez(folder / "cameras.npz", **matrices)


def write_metashape(views: list[DatasetView], folder: Path, geographic: bool = False) -> None:
    link_images(views, folder)
    c = views[0].camera
    k1, k2, p1, p2 = c.distortion
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" component_id="0" label="{view.image.stem}"><transform>'
        f"{' '.join(repr(float(v)) for v in view.camera_to_world.ravel())}</transform></camera>"
        for i, view in enumerate(views)
    )
    # Metashape's p1 and p2 are the other way round than OpenCV's, and its f is that of y.
    lens = (
        f"<f>{c.fy}</f><b1>{c.fx - c.fy}</b1><cx>{c.cx - c.width / 2}</cx><cy>{c.cy - c.height / 2}</cy>"
        f"<k1>{k1}</k1><k2>{k2}</k2><p1>{p2}</p1><p2>{p1}</p2>"
    )
    size = f'<resolution width="{c.width}" height="{c.height}"/>'
    place = ""
    if geographic:
        place = (
            "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>4000000 800000 4900000</translation>"
            "<scale>2.5</scale></transform>"
        )
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0"><chunk label="Chunk 1" enabled="1"><sensors>'
        f'<sensor id="0" label="x" type="frame">{size}<calibration type="frame" class="adjusted">{size}{lens}'
        f"</calibration></sensor></sensors><cameras>{cameras}"
        f'<camera id="99" sensor_id="0" label="not aligned"/></cameras>{place}</chunk></document>'
    )


def write_realityscan(views: list[DatasetView], folder: Path) -> None:
    link_images(views, folder)
    for view in views:
        c = view.camera
        k1, k2, p1, p2 = c.distortion
        rotation = " ".join(repr(float(v)) for v in view.camera_to_world[:3, :3].T.ravel())
        position = " ".join(repr(float(v)) for v in view.camera_to_world[:3, 3])
        (folder / f"{view.image.stem}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xcr:Version="3" xcr:PosePrior="exact" xcr:Coordinates="absolute" '
            f'xcr:DistortionModel="brown3t2" xcr:FocalLength35mm="{c.fx * 36 / c.width!r}" xcr:Skew="0" '
            f'xcr:AspectRatio="{c.fy / c.fx!r}" xcr:PrincipalPointU="{(c.cx - c.width / 2) / c.width!r}" '
            f'xcr:PrincipalPointV="{(c.cy - c.height / 2) / c.width!r}" '
            'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">'
            f"<xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>{position}</xcr:Position>"
            f"<xcr:DistortionCoeficients>{k1} {k2} 0 0 {p1} {p2}</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )


def write_meshroom(views: list[DatasetView], folder: Path) -> None:
    link_images(views, folder / "images")
    c = views[0].camera
    k1, k2, p1, p2 = c.distortion
    value = {
        "version": ["1", "2", "6"],
        "views": [
            {"viewId": str(i), "poseId": str(i), "intrinsicId": "5", "path": f"/somewhere/else/{view.image.name}"}
            for i, view in enumerate(views)
        ],
        "intrinsics": [
            {
                "intrinsicId": "5", "width": str(c.width), "height": str(c.height), "sensorWidth": "36",
                "focalLength": repr(c.fx * 36 / c.width), "pixelRatio": repr(c.fy / c.fx), "type": "pinhole",
                "distortionType": "brown", "distortionParams": [str(v) for v in (k1, k2, 0.0, p1, p2)],
                "principalPoint": [repr(c.cx - c.width / 2), repr(c.cy - c.height / 2)],
            }
        ],
        "poses": [
            {
                "poseId": str(i),
                "pose": {
                    "transform": {
                        # Column by column of world-to-camera.
                        "rotation": [repr(float(v)) for v in view.camera_to_world[:3, :3].T.ravel(order="F")],
                        "center": [repr(float(v)) for v in view.camera_to_world[:3, 3]],
                    }
                },
            }
            for i, view in enumerate(views)
        ],
    }  # fmt: skip
    (folder / "cameras.sfm").write_text(json.dumps(value))


def write_llff(views: list[DatasetView], folder: Path) -> None:
    link_images(views, folder / "images")
    rows = []
    for view in views:
        right, down, ahead = view.camera_to_world[:3, :3].T
        matrix = np.stack([down, right, -ahead, view.camera_to_world[:3, 3], [660, 1000, view.camera.fx]], -1)
        rows.append([*matrix.ravel(), 1.0, 10.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def data_set(folder: Path, head: dict[str, Any] | None = None, count: int = 3, **frame: Any) -> Path:
    """Photos in a row with a transforms.json; what is given by name stands in the second frame."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(count):
        picture(i).save(folder / "images" / f"f{i}.png")
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append({"file_path": f"images/f{i}.png", "transform_matrix": pose.tolist(), **(frame if i == 1 else {})})
    text = json.dumps({"fl_x": 300.0, **(head or {}), "frames": frames})
    (folder / "transforms.json").write_text(text)
    return folder
