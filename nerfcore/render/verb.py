"""The verb `render`: images, depth, labels and multilayer EXR from held-out, given or orbiting cameras."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ..data.box import Box, box_poses
from ..data.load import class_inputs, load_scene, view_inputs
from ..data.pixels import training_size
from ..data.readers.transforms import frame_camera
from ..data.scene import Scene, View
from ..errors import InputError, SettingError, wrong_value
from ..files import atomic_path, disk_errors, write_json
from ..geometry.cameras import Camera, flip_camera_axes, pose_matrix
from ..geometry.frames import focus_point
from ..geometry.orbit import orbit_angles
from ..geometry.similarity import similarity_scale
from ..images.encode import write_layers, write_picture
from ..images.names import frame_names
from ..images.picture import Picture, to_linear
from ..params import RenderParams
from ..progress import Reporter
from ..project.fingerprints import (
    Earlier,
    Fingerprint,
    alignment,
    compare,
    digest,
    files_digest,
    read_made,
    write_made,
)
from ..project.label_revision import label_facts
from ..project.runs import INSTANCES, MESH_RECORD, checkpoint_id
from ..project.schema import step
from ..project.store import load_project
from . import parts
from .baked import META, BakedField, load_baked, voxels_folder
from .image import Frame, background_of, render_view
from .model import Model
from .pictures import colorize_depth, colorize_labels, depth_range, pass_name
from .run import RunInfo, load_info, load_trained, without_seen
from .sparse_rays import sparse_rays

OF_CLASSES = ("semantic", "confidence")  # passes
ORBIT_PIXELS = 800  # longest side of orbit frames unless a size is asked for


def render(params: RenderParams, report: Reporter, shown: Model | BakedField | None = None) -> dict[str, Any]:
    """Render a run from some cameras; existing frames are overwritten, but for those of parts of the same render.

    `shown` is rendered in the place of the run's field.

    Depth PNGs are coloured for viewing, and NAME_depth.json says what the colours mean; the EXR holds the values: depth in world
    units along the optical axis, of a panorama along the ray, class ids, confidence, world-space normals.

    Returns:
        {"frames": [paths], "ms_per_frame", "label_revision": of the marks that classes are from, or None}
    Raises:
        InputError: no cameras were asked for, or the camera file is unusable. SettingError: the baked field has not
        all of the passes, or there are no frames of the range. ProjectError, DiskError.
    """
    folder, out = Path(params.project), Path(params.out)
    project, info = load_project(folder), load_info(folder, params.run)
    scene = load_scene(folder, info.holdout)
    if params.test and scene.test:
        scene = without_seen(scene, info, report)
    if params.baked and "unknown" in params.passes:
        raise SettingError("A baked field has no pass “unknown”.", "Leave it out of --passes, or leave out --baked.")
    shown = shown or _shown(params, info)
    inputs = render_inputs(params)
    box = info.box(project)
    cameras = chosen_cameras(params, scene)
    if params.size is not None:
        # Pictures of photos' cameras are laid over the photos; all others keep their pixels square.
        photos = params.camera is None and params.orbit is None
        for name, camera, _ in cameras:
            if (
                camera.model == "EQUIRECTANGULAR"
                and not photos
                and params.size[0] * camera.height != params.size[1] * camera.width
            ):
                raise SettingError(
                    f"“{name}” is a panorama of {camera.width}×{camera.height}, which cannot be cut to "
                    f"{params.size[0]}×{params.size[1]}.",
                    "Give `--size` the panorama's proportions.",
                )
        cameras = [
            (name, (camera.resized if photos else camera.reframed)(*params.size), pose)
            for name, camera, pose in cameras
        ]
    planned = cameras  # of all parts, which are to look alike
    cameras = _part(cameras, params.frame_range)
    kept = {} if params.frame_range else parts.rendered_parts(out, inputs, [name for name, _, _ in cameras])
    if kept:
        report.note(f"{len(kept)} of {len(cameras)} frames are there already, rendered as parts.")
    todo = [camera for camera in cameras if camera[0] not in kept]
    report.stage("Preparing")
    if isinstance(shown, Model) and todo:
        poses = box_poses([View(name, camera, pose, Path()) for name, camera, pose in planned], box.box_from_world)
        shown.refine(math.inf, report.check, sparse_rays([camera for _, camera, _ in planned], poses, shown.device))
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        parts.forget_overwritten(out, inputs, [name for name, _, _ in todo])
    colors = {c.id: c.color for c in scene.classes}
    names = {name.casefold() for name, _, _ in planned}
    frames, seconds = [path for made in kept.values() for path in made], 0.0
    report.stage("Rendering")
    for number, (name, camera, pose) in enumerate(todo):
        report.progress(number / len(todo), name)
        view = View(name, camera, pose, Path())
        begin = time.perf_counter()
        frame = render_view(
            shown,
            camera,
            box_poses([view], box.box_from_world)[0],
            background_of(info),
            check=report.check,
            unknown="unknown" in params.passes,
        )
        seconds += time.perf_counter() - begin
        frames += write_frame(out, name, frame, params.passes, info, scene.ignore_id, colors, box, names)
    result: dict[str, Any] = {"frames": [str(path) for path in sorted(frames)] if kept else [str(p) for p in frames]}
    result["ms_per_frame"] = round(seconds / max(len(todo), 1) * 1e3, 1)
    result["label_revision"] = info.label_revision
    made = step("render", params.model_dump(mode="json"), result, inputs, inputs["trained field"])
    write_made(out / parts.record_name(params.frame_range), made)
    return result


def _part(cameras: list[tuple[str, Camera, np.ndarray]], frames: tuple[int, int] | None) -> list:
    """The cameras of a range of frames. Raises SettingError where the render has none of them."""
    if frames is None:
        return cameras
    if frames[0] >= len(cameras):
        raise SettingError(
            f"--frame-range {frames[0]} {frames[1]}: the render has the frames 0 to {len(cameras) - 1}.",
            "Give a range of these.",
        )
    return cameras[frames[0] : frames[1] + 1]


def _shown(params: RenderParams, info: RunInfo) -> Model | BakedField:
    """What is rendered. Raises ProjectError."""
    if not params.baked:
        return load_trained(params.project, params.run).model
    return load_baked(params.project, params.run, info)


def render_inputs(params: RenderParams) -> Fingerprint:
    """What renders depend on. Raises ProjectError."""
    folder = Path(params.project)
    info = load_info(folder, params.run)
    scene = load_scene(folder, info.holdout)
    chosen = params.model_dump(mode="json", exclude={"project", "run", "out", "frame_range"})
    return {
        "trained field": checkpoint_id(folder, params.run),
        "alignment": alignment(load_project(folder)),
        "classes": class_inputs(scene),
        "settings": digest([chosen, info.config.render.model_dump(mode="json")]),
        **({"baked field": files_digest([("meta", voxels_folder(folder, params.run) / META)])} if params.baked else {}),
        "camera file": files_digest([("camera", params.camera)]),
        **({"edits": _edit_inputs(params)} if params.edits else {}),
        **view_inputs(scene, list(range(len(scene.views))), files=False),
    }


def _edit_inputs(params: RenderParams) -> str:
    """A digest of the edits and of the mesh whose things they name."""
    exports = Path(params.project) / "exports" / params.run
    return files_digest([("edits", params.edits), *((name, exports / name) for name in (MESH_RECORD, INSTANCES))])


def rendered(params: RenderParams) -> Earlier:
    """The renders that are there, if they are of the present field and cameras."""
    made = read_made(params.out / parts.record_name(params.frame_range))
    if made is None:
        return Earlier()
    frames = [params.out / Path(frame).name for frame in made.result.get("frames", [])]
    made.result["frames"] = [str(path) for path in frames]
    return compare(made, render_inputs(params), frames)


def chosen_cameras(params: RenderParams, scene: Scene) -> list[tuple[str, Camera, np.ndarray]]:
    """(name, camera, camera-to-world) of every frame asked for."""
    if params.camera is not None:
        return read_cameras(params.camera)
    if params.orbit is not None:
        return orbit_cameras(scene, params.orbit)
    indices = list(range(len(scene.views))) if params.all else scene.test if params.test else []
    if not indices:
        advice = "Use --test (with held-out photos), --all, --camera FILE or --orbit N."
        raise InputError("No cameras to render from.", advice)
    size = 1600
    return [
        (v.name, v.camera.resized(*training_size(v.camera, size)), v.camera_to_world)
        for v in (scene.views[i] for i in indices)
    ]


def read_cameras(path: Path) -> list[tuple[str, Camera, np.ndarray]]:
    """Cameras of a transforms.json-like file in the world frame: OpenGL axes, lenses per file or per frame.

    Raises:
        InputError: the file is missing, not JSON, has no frames, or one of them has no lens or pose.
    """
    needed = "It needs w, h, fl_x and frames with transform_matrix."
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        frames = [{**data, **frame} for frame in data["frames"]]
        posed = [_posed(frame) for frame in frames]
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.", "Give a cameras file.") from error
    except KeyError as error:
        raise InputError(f"{path} is not a cameras file: “{error.args[0]}” is missing.", needed) from error
    except ValidationError as error:
        raise InputError(f"{path} is not a cameras file: {wrong_value(error.errors()[0])}.", needed) from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} is not a cameras file: {error}.", needed) from error
    except InputError as error:
        raise InputError(f"{path}: {error.message}", error.hint) from error
    if not posed:
        raise InputError(f"{path} has no frames.", needed)
    # Tools on Windows write backslashes.
    places = [str(frame.get("file_path", f"{number:04d}")).replace("\\", "/") for number, frame in enumerate(frames)]
    return [(name, *camera) for name, camera in zip(frame_names(places), posed)]


def _posed(frame: dict[str, Any]) -> tuple[Camera, np.ndarray]:
    """Lens and pose of a frame. Raises KeyError, TypeError, ValueError, InputError: it lacks one."""
    given = {name: value for name, value in frame.items() if value is not None}
    camera = frame_camera(given, int(given["w"]), int(given["h"]))
    if not (np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all() and min(camera.fx, camera.fy) > 0):
        raise ValueError(f"a focal length of {camera.fx:g} pixels cannot be")
    pose = pose_matrix(given["transform_matrix"])
    if pose is None or not np.isfinite(pose).all():
        raise ValueError("a “transform_matrix” is not 4 × 4 numbers")
    u, size, vt = np.linalg.svd(pose[:3, :3])
    if size[2] <= 1e-6 * size[0]:
        raise ValueError("a “transform_matrix” scales to nothing")
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = u @ vt, pose[:3, 3]  # directions have unit length, whatever the scale of the camera
    return camera, flip_camera_axes(found)


def orbit_cameras(scene: Scene, count: int) -> list[tuple[str, Camera, np.ndarray]]:
    """`count` cameras around the focus of the training views, at their median distance and height: on a circle, or on
    the arc where photos were taken if they leave much of the circle open, as before a facade."""
    views = [scene.views[i] for i in scene.train]
    focus = focus_point([view.camera_to_world for view in views])
    offsets = np.stack([v.camera_to_world[:3, 3] for v in views]) - focus
    height, radius = float(np.median(offsets[:, 2])), float(np.median(np.linalg.norm(offsets[:, :2], axis=1)))
    camera = views[0].camera.undistorted()
    camera = camera.resized(*training_size(camera, ORBIT_PIXELS))
    frames = []
    for number, angle in enumerate(orbit_angles(np.arctan2(offsets[:, 1], offsets[:, 0]), count)):
        center = focus + [radius * np.cos(angle), radius * np.sin(angle), height]
        frames.append((f"orbit_{number:04d}", camera, look_at(center, focus)))
    return frames


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """Camera-to-world pose (4, 4), OpenCV axes, at `center` looking at `target` with `up` (default +z) upwards; looking along
    `up`, the axis that is farthest from it is upwards in the picture."""
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = center
    return pose


def depth_legend(frame: Frame, scale: float) -> dict[str, Any]:
    """What the colours of a depth picture mean: depths in world units that are drawn red and dark blue."""
    drawn = depth_range(frame.depth, frame.opacity)
    near, far = (None, None) if drawn is None else (round(drawn[0] * scale, 6), round(drawn[1] * scale, 6))
    return {"near": near, "far": far, "near_color": "red", "far_color": "blue", "colors": "turbo", "empty": "black"}


def write_frame(
    out: Path,
    name: str,
    frame: Frame,
    passes: list,
    info: RunInfo,
    void: int,
    colors: dict[int, tuple[float, float, float]],
    box: Box,
    names: Collection[str] = (),
) -> list[Path]:
    """Write NAME.png, NAME_depth.png, … and NAME.exr with all asked passes. Returns the paths of these pictures.
    `names`: of all frames, which no picture of a pass takes (`pass_name`).

    The PNG shows the field on its background; the EXR has the field alone, linear and with associated alpha, to be put
    over anything, and beside it the environment, if the run has one; `label_revision` in its
    header, and in the PNGs of classes, names the marks that the classes are from, if they are from any.
    """
    scale = similarity_scale(box.world_from_box)
    rotation = box.world_from_box[:3, :3] / scale
    label = frame.label(info.class_ids, void)
    unknown = np.zeros(frame.depth.shape, np.float32) if frame.unknown is None else frame.unknown
    world_normal = frame.normal() @ rotation.T
    pictures = {
        "rgb": frame.color,
        "depth": colorize_depth(frame.depth, frame.opacity),
        "semantic": colorize_labels(label, colors),
        "confidence": frame.confidence()[..., None],
        "normal": world_normal * 0.5 + 0.5,
        "unknown": unknown[..., None],
    }
    layers: dict[str, np.ndarray] = {}
    values = {
        "rgb": ("", ["R", "G", "B", "A"], to_linear(frame.picture).pixels),
        "depth": ("Depth.", ["Z"], np.nan_to_num(frame.depth * scale, nan=1e10)[..., None]),
        "semantic": ("Label.", ["ID"], label[..., None]),
        "confidence": ("Confidence.", ["V"], frame.confidence()[..., None]),
        "normal": ("Normal.", ["X", "Y", "Z"], world_normal),
        "unknown": ("Unknown.", ["V"], unknown[..., None]),
    }
    written, facts = [], label_facts(info.label_revision)
    for kind in passes:
        path = out / f"{pass_name(name, kind, names)}.png"
        with atomic_path(path) as temporary:
            write_picture(temporary, pictures[kind], facts=facts if kind in OF_CLASSES else None)
        written.append(path)
        if kind == "depth":
            write_json(path.with_suffix(".json"), depth_legend(frame, scale))
        prefix, channels, value = values[kind]
        for index, channel in enumerate(channels):
            layers[prefix + channel] = value[..., index]
    if "rgb" in passes and isinstance(frame.background, np.ndarray):
        environment = to_linear(Picture(frame.background)).pixels
        layers |= {f"Environment.{channel}": environment[..., index] for index, channel in enumerate("RGB")}
    path = out / f"{name}.exr"
    with atomic_path(path) as temporary:
        write_layers(temporary, layers, facts)
    return [*written, path]
