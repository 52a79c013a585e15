"""The child process of `fieldwork dataset`: photographs the active scene of any .blend from chosen places."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..errors import SceneError
from ..scene.lens import picture_size, pinhole
from .orbit import look_at, sphere
from .shoot import Lens, Shot, class_ids, has_denoiser, photograph

MARGIN = 1.05  # of the bounding sphere, so that nothing touches the edge of the picture


def dataset(request: dict[str, Any], emit: Callable[..., None]) -> dict[str, Any]:
    """Render what is missing into `request["folder"]`.

    Request: the fields of the engine's DatasetParams, and `folder`, `done` (names of the finished views). The result:
    frames (name, intrinsics, camera_to_world), classes, denoised.
    """
    emit(kind="stage", name="Opening the scene")
    bpy.ops.wm.open_mainfile(filepath=request["blend"], load_ui=False, use_scripts=False)
    scene = bpy.context.scene
    show_what_renders()
    shots = plan(scene, request)
    metre = scene.unit_settings.scale_length or 1.0
    emit(kind="plan", views=len(shots), metre=metre)
    emit(kind="stage", name="Photographing")
    pending = [shot for shot in shots if shot.name not in request["done"]]
    photograph(
        scene,
        pending,
        Path(request["folder"]),
        samples=request["samples"],
        labels=request["labels"],
        depth=request["depth"],
        transparent=request["transparent"],
        progress=lambda index, shot: emit(kind="view", name=shot.name),
    )
    to_metres = np.array([[1.0, 1.0, 1.0, metre]] * 3 + [[1.0] * 4])
    return {
        "frames": [
            {
                "name": s.name,
                "intrinsics": s.lens.intrinsics(),
                "camera_to_world": (np.asarray(s.camera_to_world) * to_metres).tolist(),
            }
            for s in shots
        ],
        "classes": {str(number): name for name, number in class_ids(scene, request["labels"]).items()},
        "denoised": has_denoiser(),
    }


def plan(scene: bpy.types.Scene, request: dict[str, Any]) -> list[Shot]:
    """The shots of a request (see `dataset`), in order.

    Raises:
        SceneError: with a sentence for the user: no camera, no curve, nothing to see.
    """
    if request["path"] == "camera":
        return camera_shots(scene, request["views"], request["size"])
    lens = scene_lens(scene, request["size"])
    center, extent = bounding_sphere(scene)
    if request["center"] is not None:
        center = np.array(request["center"])
    if request["path"] == "curve":
        poses = curve_poses(scene, request["curve"], request["views"], center)
    else:
        half_angle = math.atan(min(lens.width, lens.height) / 2 / lens.focal_px)
        radius = request["radius"] or MARGIN * extent / math.sin(half_angle)
        poses = sphere(request["views"], center, radius, request["path"] == "hemisphere")
    return [Shot(f"{index:04d}", pose, lens) for index, pose in enumerate(poses, 1)]


def scene_size(scene: bpy.types.Scene, size: list[int] | None) -> tuple[int, int]:
    return (size[0], size[1]) if size is not None else picture_size(scene.render)


def scene_lens(scene: bpy.types.Scene, size: list[int] | None) -> Lens:
    """The lens of the scene's camera, without its shift; a normal one where there is no perspective camera."""
    width, height = scene_size(scene, size)
    if not _is_perspective(scene.camera):
        return Lens(width, height, 1.2 * max(width, height))
    return Lens(width, height, camera_lens(scene.camera.data, width, height).focal_px)


def camera_lens(camera: bpy.types.Camera, width: int, height: int) -> Lens:
    """A Blender camera's focal length and principal point in pixels."""
    found = pinhole(camera, width, height)
    return Lens(width, height, found.fx, (found.cx, found.cy))


def camera_shots(scene: bpy.types.Scene, views: int, size: list[int] | None) -> list[Shot]:
    """One shot per frame of the scene's camera, at most `views`, spread over the frame range.

    Timeline markers may change the camera. Nothing else moves: what is animated stays as it is at the current frame.

    Raises:
        SceneError: a frame has no perspective camera.
    """
    width, height = scene_size(scene, size)
    numbers = list(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    chosen = sorted({numbers[round(i)] for i in np.linspace(0, len(numbers) - 1, min(views, len(numbers)))})
    current, camera = scene.frame_current, scene.camera
    try:
        return [_camera_shot(scene, number, width, height) for number in chosen]
    finally:
        scene.frame_set(current)
        scene.camera = camera


def _camera_shot(scene: bpy.types.Scene, number: int, width: int, height: int) -> Shot:
    """The shot of a frame; the scene is in that frame afterwards."""
    scene.frame_set(number)
    camera = scene.camera
    if not _is_perspective(camera):
        raise SceneError(f"The scene has no perspective camera in frame {number}: add one, or choose another path.")
    evaluated = camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return Shot(f"{number:04d}", unscaled(np.array(evaluated.matrix_world)), camera_lens(evaluated.data, width, height))


def _is_perspective(camera: bpy.types.Object | None) -> bool:
    """Whether a scene's active camera, which any object may be, is a perspective camera."""
    return camera is not None and camera.type == "CAMERA" and camera.data.type == "PERSP"


def unscaled(matrix: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a camera whose axes a scaled parent has stretched, sheared or mirrored.

    It looks where the camera looks, its up as far upwards as can be: a mirrored picture is that of no camera.
    """
    back = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    up = matrix[:3, 1] - back * (back @ matrix[:3, 1])
    up /= np.linalg.norm(up)
    pose = np.eye(4)
    pose[:3] = np.stack([np.cross(up, back), up, back, matrix[:3, 3]], 1)
    return pose


def show_what_renders() -> None:
    """Hide in the viewport what renders hide, and show the rest: classes and extents are those of what it shows."""
    for layer in bpy.context.scene.view_layers:
        layers = [layer.layer_collection]
        while layers:
            part = layers.pop()
            part.hide_viewport = False
            layers += part.children
        for item in layer.objects:
            item.hide_set(False, view_layer=layer)
    for item in [*bpy.data.objects, *bpy.data.collections]:
        if item.library is None:
            item.hide_viewport = item.hide_render


def curve_poses(scene: bpy.types.Scene, name: str | None, views: int, center: np.ndarray) -> list[np.ndarray]:
    """Poses evenly spread by length along a curve object, looking at `center`."""
    item = scene.objects.get(name or "")
    if item is None or item.type != "CURVE":
        raise SceneError(f"The scene has no curve “{name}”: name a curve object." if name else "Name a curve object.")
    mesh = item.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    points = np.array([item.matrix_world @ vertex.co for vertex in mesh.vertices])
    closed = any(spline.use_cyclic_u for spline in item.data.splines)
    item.to_mesh_clear()
    if closed:
        points = np.concatenate([points, points[:1]])
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    places = np.linspace(0, lengths[-1], views, endpoint=not closed)
    return [look_at(np.array([np.interp(place, lengths, points[:, k]) for k in range(3)]), center) for place in places]


def bounding_sphere(scene: bpy.types.Scene) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a sphere around everything that renders."""
    corners = []
    for item in bpy.context.evaluated_depsgraph_get().object_instances:
        if _is_solid(item.object) and item.show_self and not item.object.original.hide_render:
            corners += [np.array(item.matrix_world @ Matrix.Translation(c).translation) for c in item.object.bound_box]
    if not corners:
        raise SceneError("The scene shows nothing that could be photographed.")
    points = np.array(corners)
    center = (points.min(0) + points.max(0)) / 2
    return center, float(np.linalg.norm(points - center, axis=-1).max()) or 1.0


def _is_solid(item: bpy.types.Object) -> bool:
    if item.type == "CURVE":  # a bare curve, such as a path for the camera, does not render
        return bool(item.data.bevel_depth or item.data.extrude or item.data.bevel_object)
    return item.type in {"MESH", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD"}
