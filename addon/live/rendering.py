"""A frame of the render engine: what of the scene is rendered, and the pixels that come into Blender's result.

Everything is read from the scene at the start of `render`, which runs in a thread of Blender's or, without a window, in its
only one; the engine (frames.py) does the work in a process of its own, so the picture is only waited for here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
from bpy.types import RenderEngine
from mathutils import Vector

from ..errors import SceneError
from ..text import t
from . import camera, fields, objects, passes
from .frames import Frame, FrameEngine, Sizes

Frames = Callable[[], FrameEngine]  # gives the engine, which it starts where there is none


def render_frame(engine: RenderEngine, depsgraph: bpy.types.Depsgraph, frames: Frames) -> None:
    """Render all views of a layer; `frames` gives the engine that does it. Raises SceneError and EngineError."""
    layer = depsgraph.view_layer_eval
    asked = passes.wanted(depsgraph.scene_eval, layer)
    for each in asked[1:]:
        engine.add_pass(each.name, each.channels, each.letters, layer=layer.name)
    # The two of stereo; else one, whose name is empty.
    for view in [view.name for view in engine.get_result().views]:
        engine.active_view_set(view)
        _render_view(engine, depsgraph, frames, asked, view)


def _render_view(
    engine: RenderEngine, depsgraph: bpy.types.Depsgraph, frames: Frames, asked: list[passes.RenderPass], view: str
) -> None:
    layer = depsgraph.view_layer_eval
    engine.update_stats("", t("Reading the scene"))
    shot = _shot(engine, depsgraph, frames, asked)
    x0, y0, x1, y1 = shot["border"]
    sizes = Sizes(x1 - x0, y1 - y0, {each.name: each.channels for each in asked})
    space = working_space()

    result = engine.begin_result(0, 0, sizes.width, sizes.height, layer=layer.name, view=view)

    def show(colors: Any) -> None:
        _put(engine, result, {"Combined": colors}, space)
        engine.update_result(result)

    def tell(stage: str, share: float) -> None:
        engine.update_progress(share if stage == "Rendering" else 0.0)
        engine.update_stats("", t(stage) if stage else "")

    try:
        if (result.resolution_x, result.resolution_y) != (sizes.width, sizes.height):
            raise SceneError(
                t("The border of this scene is not that of the render: press Composite with Objects again.")
            )
        if shot["fields"]:
            frame = frames().render(shot, sizes, engine.test_break, tell, None if bpy.app.background else show)
        else:
            frame = Frame(passes.empty(sizes, shot["world"]), {})
        _put(engine, result, frame.passes, space)
    except BaseException:
        engine.end_result(result, cancel=True)
        raise
    finally:
        if "occluders" in shot:
            Path(shot["occluders"]).unlink(missing_ok=True)
    engine.end_result(result)
    _note_names(engine, frame, layer.name)


def _put(engine: RenderEngine, result: Any, pixels: dict[str, Any], space: str) -> None:
    """Pixels into a result of Blender's."""
    views = engine.active_view_get()
    (layer,) = result.layers
    for name, values in pixels.items():
        found = layer.passes.find_by_name(name, views)
        if found is not None:
            values = passes.working_space(values, space) if name in passes.LIGHT else values
            found.rect.foreach_set(values.reshape(-1))


def _note_names(engine: RenderEngine, frame: Frame, layer: str) -> None:
    """The names behind the ids of a Cryptomatte, and the revision of the marks that the classes of each field are from, as
    metadata that nodes and files have."""
    result = engine.get_result()
    for kind, manifest in (frame.facts.get("manifests") or {}).items():
        name = f"{layer}.{kind}"
        key = f"cryptomatte/{_hash7(name)}/"
        result.stamp_data_add_field(key + "name", name)
        result.stamp_data_add_field(key + "hash", "MurmurHash3_32")
        result.stamp_data_add_field(key + "conversion", "uint32_to_float32")
        result.stamp_data_add_field(key + "manifest", manifest)
    for name, revision in frame.facts.get("label_revisions", {}).items():
        result.stamp_data_add_field(f"label_revision/{name}", str(revision))


def _shot(
    engine: RenderEngine, depsgraph: bpy.types.Depsgraph, frames: Frames, asked: list[passes.RenderPass]
) -> dict[str, Any]:
    """What is rendered, as nerfcore/film/shot.py describes it. Raises SceneError."""
    scene, layer = depsgraph.scene_eval, depsgraph.view_layer_eval
    live, render = scene.fieldwork_live, scene.render
    if scene.camera is None:
        raise SceneError(t("The scene has no active camera."))
    if scene.camera.type != "CAMERA":
        raise SceneError(t("“{}” is the active camera, but no camera.", scene.camera.name))
    width, height = engine.resolution_x, engine.resolution_y
    aspect = render.pixel_aspect_x, render.pixel_aspect_y

    def eye() -> bpy.types.Object:
        return engine.camera_override.evaluated_get(depsgraph)  # that of the view

    if render.use_multiview and eye().data.type == "PANO" and eye().data.stereo.use_spherical_stereo:
        raise SceneError(t("Fieldwork does not render spherical stereo: switch it off in “{}”.", eye().data.name))
    lens = camera.lens(eye(), width, height, aspect, engine.camera_shift_x(eye()))
    shot: dict[str, Any] = {
        "border": border(render, width, height),
        "samples": live.samples,
        "filter_width": render.filter_size if render.filter_size > 0.01 else 0.0,
        "fields": fields.rendered_items(depsgraph),
        "passes": [each.name for each in asked],
        "levels": layer.pass_cryptomatte_depth + layer.pass_cryptomatte_depth % 2,
        "world": None if render.film_transparent else passes.rec709(passes.world_color(scene.world), working_space()),
        "sky": not render.film_transparent,
    }
    if live.objects_hide:
        shot["occluders"] = str(objects.write_triangles(frames().folder() / "objects.npz", depsgraph))
    now = scene.frame_current + scene.frame_subframe
    times = camera.shutter_times(render, now)

    known = fields.rendered_parts(depsgraph)

    def poses() -> tuple[Any, ...]:
        placed = [fields.poses_of_part(part, depsgraph) for part in known]
        return camera.pose(engine.camera_model_matrix(eye())), placed

    seen, placed = zip(*camera.in_time(poses, times, engine.frame_set, now))
    lens["poses"] = camera.moving(list(seen))
    for number, item in enumerate(shot["fields"] if known else ()):
        for name, key in (("scene_from_capture", "motion"), ("crop", "crop_motion")):
            found = camera.moving([one[number].get(name) for one in placed])
            if len(found) > 1:
                item[key] = found
    return {**shot, "lens": lens}


def working_space() -> str:
    """The space of the open file's colours."""
    known = getattr(bpy.data, "colorspace", None)
    return known.working_space if known is not None else "Linear Rec.709"


def border(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int]:
    """The pixels that are rendered, from the upper left corner: Blender's count from below."""
    if not render.use_border:
        return 0, 0, width, height
    shares = (render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y)
    # In single precision, as Blender does: 0.9 of 80 pixels are 72, not 71.
    x0, x1, y0, y1 = (int((Vector((share, 0)) * side).x) for share, side in zip(shares, (width, width, height, height)))
    return x0, height - y1, x1, height - y0


def _hash7(name: str) -> str:
    from ...nerfcore.film.cryptomatte import murmur3

    return f"{murmur3(name.encode()):08x}"[:7]
