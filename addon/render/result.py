"""Rendered images in Blender: as image datablocks, behind the cameras they were rendered from, or on planes."""

from __future__ import annotations

import re
import shutil
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy

from ..roles import Owner, by_role
from .slot import MARK, load_render, render_slot

EVERY_FRAME = "every_frame"  # folder beside the pictures of an animation
OTHER_PASSES = ("_depth", "_labels", "_confidence", "_normal", "_unknown")  # ends of names of all but the color


def show_steps(
    scene: bpy.types.Scene | None, files: list[Path], show_as: str, photos: bool, owner: Owner
) -> Generator[tuple[float, str], None, list[tuple[bpy.types.Object, bpy.types.Image]]]:
    """Load the rendered files, and put the colored ones where the user wants them, a step for each file.

    Args:
        scene: may be None where `show_as` is "none".
        files: what the engine wrote.
        show_as: "none", "background" or "plane".
        photos: whether they were rendered from the photos' cameras rather than the scene's.
        owner: the project whose cameras are meant.
    Returns:
        the cameras that got an image, with it.
    """
    uid = scene.session_uid if scene is not None else 0
    for number, path in enumerate(files):
        yield number / len(files), path.name
        load_render(path)
    colored = colored_files(files)
    if show_as == "none" or not colored:
        return []
    pairs = []
    scene = _of_session(bpy.data.scenes, uid)
    for camera_uid, path in _places(scene, colored, photos, owner) if scene is not None else ():
        yield 1.0, path.name
        # Looked up again in each step: between two the user may do anything.
        scene = _of_session(bpy.data.scenes, uid)
        camera = _of_session(scene.objects, camera_uid) if scene is not None else None
        if camera is None:
            continue
        shown = [path] if photos else every_frame(colored)
        image = load_render(shown[0])
        if len(shown) > 1:
            image.source = "SEQUENCE"
        put = background if show_as == "background" else plane
        put(scene, camera, image, frame_number(path), len(shown))
        pairs.append((camera, image))
    return pairs


def colored_files(files: list[Path]) -> list[Path]:
    """The pictures of colors among rendered files; each frame has an EXR of its own name."""
    frames = {path.stem for path in files if path.suffix == ".exr"}
    pictures = [path for path in files if path.suffix == ".png"]
    if frames:
        return [path for path in pictures if path.stem in frames]
    stems = {path.stem for path in pictures}
    passes = {stem + ending for stem in stems for ending in OTHER_PASSES}
    return [path for path in pictures if path.stem not in passes]


def _of_session(items: Any, uid: int) -> Any:
    """The scene or object of this number, whatever it is called by now; None where it is gone."""
    return next((item for item in items if item.session_uid == uid), None)


def _places(scene: bpy.types.Scene, colored: list[Path], photos: bool, owner: Owner) -> list[tuple[int, Path]]:
    """Which cameras get which pictures, by their numbers in the session."""
    if not photos:
        return [(scene.camera.session_uid, colored[0])] if scene.camera else []
    known = by_role(scene.objects, owner)
    cameras = [(known.get(f"camera:{path.stem}"), path) for path in colored]
    return [(camera.session_uid, path) for camera, path in cameras if camera is not None]


def frame_number(path: Path) -> int:
    """The number at the end of a picture's name, which may be negative; 1 where there is none."""
    found = re.search(r"(?<=_)-\d+$|\d+$", path.stem)
    return int(found[0]) if found else 1


def every_frame(files: list[Path]) -> list[Path]:
    """The pictures of an animation with one for each frame.

    Blender plays pictures by their numbers, which cannot be negative, and shows nothing where one is missing. Where only
    every so many frames were rendered, or the animation begins before frame 0, a folder beside them gets a picture for
    each, numbered from 1 on in the latter case: the last one that was rendered.
    """
    numbers = [frame_number(path) for path in files]
    steps = {after - before for before, after in zip(numbers, numbers[1:])}
    step, negative = min(steps, default=1), len(files) > 1 and numbers[0] < 0
    if len(steps) > 1 or step < 1 or (step == 1 and not negative):
        return files
    before = numbers[0] - 1 if negative else 0
    folder = files[0].parent / EVERY_FRAME
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    held = []
    for path, number in zip(files, numbers):
        for frame in range(number, number + step):
            held.append(folder / f"frame_{frame - before:04}{path.suffix}")
            shutil.copyfile(path, held[-1])
    return held


def background(
    scene: bpy.types.Scene, camera: bpy.types.Object, image: bpy.types.Image, first: int, frames: int
) -> None:
    """Put the image over the camera's view, in place of an earlier one; photos behind it stay. A sequence of so many
    frames begins at the frame `first` of the scene."""
    slot = render_slot(camera.data)
    slot.image, slot.alpha, slot.display_depth, slot.frame_method = image, 1.0, "FRONT", "STRETCH"
    _play(slot.image_user, image, first, frames)
    camera.data.show_background_images = True


def plane(scene: bpy.types.Scene, camera: bpy.types.Object, image: bpy.types.Image, first: int, frames: int) -> None:
    """An image that fills the camera's view at the distance at which the camera itself is drawn; one for a camera."""
    empty = next((child for child in camera.children if MARK in child), None)
    if empty is None:
        empty = bpy.data.objects.new(f"Render · {camera.name}", None)
        empty[MARK] = True
        scene.collection.objects.link(empty)
        empty.parent = camera
    empty.empty_display_type, empty.data = "IMAGE", image
    _play(empty.image_user, image, first, frames)
    corners = camera.data.view_frame(scene=scene)
    depth = -corners[0].z
    # An image empty's longer side has the display size.
    size = max(abs(corners[0].x - corners[2].x), abs(corners[0].y - corners[2].y))
    middle = (corners[0] + corners[2]) / 2
    distance = max(camera.data.display_size, 2 * camera.data.clip_start)
    empty.empty_display_size = size / depth * distance
    empty.location = (middle.x / depth * distance, middle.y / depth * distance, -distance)
    empty.rotation_euler = (0.0, 0.0, 0.0)


def _play(user: bpy.types.ImageUser, image: bpy.types.Image, first: int, frames: int) -> None:
    if image.source == "SEQUENCE":
        user.frame_start, user.frame_duration = first, frames
        user.frame_offset = frame_number(Path(image.filepath)) - 1
        user.use_auto_refresh = True
