"""Scenes that see what another scene sees, and render it with an engine of their own."""

from __future__ import annotations

from typing import Any

import bpy

SHARED = (
    "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "use_border",
    "border_min_x", "border_max_x", "border_min_y", "border_max_y", "use_crop_to_border", "fps", "fps_base",
    "use_motion_blur", "motion_blur_shutter", "motion_blur_position",
)  # fmt: skip


def share(scene: bpy.types.Scene, made: bpy.types.Scene) -> None:
    """Let a scene see what another one sees, with the same camera and frames, without a background or a compositor."""
    made.camera, made.world = scene.camera, scene.world
    made.frame_start, made.frame_end, made.frame_step = scene.frame_start, scene.frame_end, scene.frame_step
    made.unit_settings.scale_length = scene.unit_settings.scale_length
    for name in SHARED:
        setattr(made.render, name, getattr(scene.render, name))
    made.render.film_transparent = True
    made.render.use_compositing = False
    for child in scene.collection.children:
        if child.name not in made.collection.children:
            made.collection.children.link(child)
    for obj in scene.collection.objects:
        if obj.name not in made.collection.objects:
            made.collection.objects.link(obj)
    made.view_layers[0].update()  # the view layer of a new scene has no collections before
    _share_collections(scene.view_layers[0].layer_collection, made.view_layers[0].layer_collection)


def _share_collections(seen: Any, made: Any) -> None:
    """Let the collections of a view layer be excluded, or holdouts, in another one where they are so in the first."""
    for child in seen.children:
        other = made.children.get(child.name)
        if other is not None:
            other.exclude, other.holdout = child.exclude, child.holdout
            _share_collections(child, other)


def filter_width(scene: bpy.types.Scene) -> float:
    """Width in pixels of the filter of the scene's engine: edges are composited well only where both have the same."""
    if scene.render.engine == "CYCLES":
        cycles = scene.cycles
        return 0.0 if cycles.pixel_filter_type == "BOX" else cycles.filter_width
    return scene.render.filter_size
