"""Scenes that see what another scene sees, and render it with an engine of their own."""

from __future__ import annotations

from typing import Any

import bpy

SHARED = (
    "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "use_border",
    "border_min_x", "border_max_x", "border_min_y", "border_max_y", "use_crop_to_border", "fps", "fps_base",
    "use_motion_blur", "motion_blur_shutter", "motion_blur_position", "use_multiview", "views_format",
)  # fmt: skip
VIEW = ("use", "camera_suffix", "file_suffix")  # of a view of stereo


FIELD_SCENE = "fieldwork_field_scene"  # on a scene: that of its fields
OWNER = "fieldwork_owner_scene"  # on a scene made here: the one that it was made for


def scene_of(scene: bpy.types.Scene, key: str, name: str) -> bpy.types.Scene:
    """The scene that another one names in its custom property `key`; made where there is none.

    A copy of a scene names that of its original, and gets one of its own.
    """
    made = scene.get(key)
    if made is None or made.get(OWNER) not in (None, scene):
        made = scene[key] = bpy.data.scenes.new(name)
    made[OWNER] = scene
    return made


def made_for(scene: bpy.types.Scene, key: str) -> bpy.types.Scene | None:
    """The scene of this key that was made for a scene; None where there is none."""
    made = scene.get(key)
    return made if isinstance(made, bpy.types.Scene) and made.get(OWNER) == scene else None


def share(scene: bpy.types.Scene, made: bpy.types.Scene) -> None:
    """Let a scene see what another one sees, with the same cameras and frames, without a background or a compositor."""
    share_settings(scene, made)
    made.render.film_transparent = True
    made.render.use_compositing = False
    _share_links(scene.collection.children, made.collection.children)
    _share_links(scene.collection.objects, made.collection.objects)
    made.view_layers[0].update()  # the view layer of a new scene has no collections before
    _share_collections(scene.view_layers[0].layer_collection, made.view_layers[0].layer_collection)


def share_settings(scene: bpy.types.Scene, made: bpy.types.Scene) -> None:
    """Let a scene have the cameras, frames and size of picture of another one; what is so already is not touched."""
    _share_markers(scene, made)
    _copy(scene, made, "camera", "world", "frame_start", "frame_end", "frame_step")  # the camera after the markers
    _copy(scene.unit_settings, made.unit_settings, "scale_length")
    _copy(scene.render, made.render, *SHARED)
    for view in made.render.views:
        if view.name not in scene.render.views:
            view.use = False
    for view in scene.render.views:
        _copy(view, made.render.views.get(view.name) or made.render.views.new(view.name), *VIEW)


def _copy(seen: Any, made: Any, *names: str) -> None:
    for name in names:
        if getattr(made, name) != getattr(seen, name):
            setattr(made, name, getattr(seen, name))


def _share_links(seen: Any, made: Any) -> None:
    """Let a collection hold the objects, or the collections, that another one holds, and no others."""
    wanted, there = set(seen), set(made)
    for item in there - wanted:
        made.unlink(item)
    for item in wanted - there:
        made.link(item)


def _share_markers(scene: bpy.types.Scene, made: bpy.types.Scene) -> None:
    """Let the timeline change cameras where that of another scene does."""
    if _markers(made) == _markers(scene):
        return
    made.timeline_markers.clear()
    for marker in scene.timeline_markers:
        made.timeline_markers.new(marker.name, frame=marker.frame).camera = marker.camera


def _markers(scene: bpy.types.Scene) -> list[tuple[Any, ...]]:
    return [(marker.name, marker.frame, marker.camera) for marker in scene.timeline_markers]


def _share_collections(seen: Any, made: Any) -> None:
    """Let the collections of a view layer be excluded, holdouts or seen by light alone in another one where they are so in the
    first."""
    for child in seen.children:
        other = made.children.get(child.name)
        if other is not None:
            other.exclude, other.holdout, other.indirect_only = child.exclude, child.holdout, child.indirect_only
            _share_collections(child, other)


def filter_width(scene: bpy.types.Scene) -> float:
    """Width in pixels of the filter of the scene's engine: edges are composited well only where both have the same."""
    if scene.render.engine == "CYCLES":
        cycles = scene.cycles
        return 0.0 if cycles.pixel_filter_type == "BOX" else cycles.filter_width
    return scene.render.filter_size
