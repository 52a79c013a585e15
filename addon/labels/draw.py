"""Labels and marks over the photo in image editors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..project import classes, snapshot
from . import editor, journal, pending

VOID = (0.15, 0.15, 0.15)
ERASE = (1.0, 1.0, 1.0)
RIM = (1.0, 1.0, 1.0, 0.9)  # around marks, so that they stand out from their own class
RIM_WIDTH = 1.5  # pixels of the screen
CIRCLE = 24  # corners


class Live:
    """The stroke under the mouse: on which photo, parameters of `label stroke` but for its points, points in pixels;
    a stroke on the surface has no photo, and pieces of places in the scene (see trail.py)."""

    def __init__(self, photo: str, params: dict[str, Any], pieces: list[list[Any]] | None = None) -> None:
        self.photo, self.params = photo, params
        self.points: list[tuple[float, float]] = []
        self.pieces = pieces if pieces is not None else []


live: Live | None = None
_handle: Any = None
_textures: dict[tuple[Any, ...], Any] = {}
_linear: bool | None = None  # whether this Blender takes the colors of textures as linear; None: not known yet
KEPT = 4  # textures


def colors_of(folder: Path) -> dict[int, tuple[float, float, float]]:
    """sRGB in [0, 1] of the classes by id, as the list shows them."""
    return {value["id"]: tuple(value["color"]) for value in classes.shown(folder)}


def _draw() -> None:
    context = bpy.context
    settings, space, region = context.scene.fieldwork, context.space_data, context.region
    folder = snapshot.folder_of(settings)
    photo = editor.photo_of(space.image, folder)
    if folder is None or photo is None or context.area.ui_type != "IMAGE_EDITOR":
        return
    import gpu

    size, colors = (photo["width"], photo["height"]), colors_of(folder)
    gpu.state.blend_set("ALPHA")
    if settings.label_view != "photo":
        texture = _overlay(folder, settings, str(photo["name"]), colors)
        if texture is not None:
            _draw_texture(texture, region, settings.label_opacity)
    if settings.label_view == "parts":
        texture = _outlines(folder, settings, str(photo["name"]))
        if texture is not None:
            _draw_texture(texture, region, 1.0)
    if settings.label_strokes:
        for mark in marks_on(folder, str(photo["name"]), _erased(folder, settings.run)):
            _draw_mark(mark, mark["points"], region, tuple(mark.get("size") or size), colors)
    if live is not None and live.photo == photo["name"]:
        _draw_mark(live.params, live.points, region, size, colors)
    gpu.state.blend_set("NONE")


def marks_on(folder: Path, photo: str, erased: Collection[int] = ()) -> list[dict[str, Any]]:
    """The marks on a photo that are shown or on their way, but those that erase or are of `erased` revisions. One on the surface
    has no photo."""
    known = [m for m in journal.marks_at(folder, pending.shown(folder)) if m.get("revision") not in erased]
    return [m for m in [*known, *pending.marks_of(folder)] if m.get("photo") == photo and not m.get("erase")]


def _erased(folder: Path, run: str) -> Collection[int]:
    """The marks of which an eraser left nothing, at the revision that is shown."""
    from . import results  # not at the top: it needs numpy, and enabling the extension must be quick

    # Not `to_show`: labels by whole parts say nothing of marks.
    found = results.labelling(folder, run, results.nearest_computed(folder, run, pending.shown(folder)))
    return () if found is None else found.told.get("erased", ())


def _overlay(folder: Path, settings: Any, photo: str, colors: dict[int, tuple[float, float, float]]) -> Any:
    """The texture of a photo's labels, of the revision that is shown or the youngest that was propagated before it."""
    from . import results  # not at the top: it needs numpy, and enabling the extension must be quick

    found = results.to_show(folder, settings.run, pending.shown(folder))
    if found is None:
        return None
    confidence = settings.label_view == "confidence"
    key = (folder, settings.run, photo, found.revision, found.made, confidence, tuple(sorted(colors.items())))
    if key not in _textures:
        surfels = results.photo_map(folder, settings.run, photo)
        # A preparation that was made anew meanwhile has other surfels.
        if surfels is None or surfels.max(initial=-1) >= len(found.probability):
            return None
        picture = results.overlay(found, surfels, colors, results.void_of(folder), confidence)
        if takes_linear():
            picture[..., :3] = results.linear(picture[..., :3])
        _keep(key, texture_of(picture))
    return _textures[key]


def _outlines(folder: Path, settings: Any, photo: str) -> Any:
    """The texture of the outlines of the parts that a photo shows; None where the run was not prepared."""
    from . import results

    key = (folder, settings.run, photo, settings.label_level, results.prepared_at(folder, settings.run))
    if key not in _textures:
        picture = results.part_outlines(folder, settings.run, photo, settings.label_level)
        if picture is None:
            return None
        _keep(key, texture_of(picture))
    return _textures[key]


def _keep(key: tuple[Any, ...], texture: Any) -> None:
    while len(_textures) >= KEPT:
        del _textures[next(iter(_textures))]
    _textures[key] = texture


def takes_linear() -> bool:
    """Whether the colors of textures are taken as linear here: Blender changed that, while plain colors stayed sRGB. Found
    out by drawing the same grey both ways into the lower left corner; called while an editor is drawn."""
    global _linear
    if _linear is None:
        import gpu
        import numpy as np

        corner = [(0, 0), (2, 0), (2, 2), (0, 2)]
        grey, seen = (0.5, 0.5, 0.5, 1.0), []
        frame = gpu.state.active_framebuffer_get()
        left, bottom, *_ = gpu.state.viewport_get()
        for textured in (False, True):
            if textured:
                _textured(texture_of(np.full((2, 2, 4), grey, np.float32)), corner, 1.0)
            else:
                _fan(corner, grey)
            seen.append(frame.read_color(left, bottom, 1, 1, 3, 0, "FLOAT").to_list()[0][0][0])
        _linear = abs(seen[1] - seen[0]) > 0.1
    return _linear


def texture_of(picture: Any) -> Any:
    """A texture of a picture (H, W, 4) float32, rows from the bottom."""
    import gpu

    height, width = picture.shape[:2]
    return gpu.types.GPUTexture(
        (width, height), format="RGBA8", data=gpu.types.Buffer("FLOAT", picture.size, picture.reshape(-1))
    )


def _draw_texture(texture: Any, region: bpy.types.Region, opacity: float) -> None:
    """Draw the texture over the whole photo."""
    (left, bottom), (right, top) = (region.view2d.view_to_region(u, u, clip=False) for u in (0.0, 1.0))
    _textured(texture, [(left, bottom), (right, bottom), (right, top), (left, top)], opacity)


def _textured(texture: Any, corners: Sequence[Sequence[float]], opacity: float) -> None:
    """A texture between four corners, from the lower left against the clock."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("IMAGE_COLOR")
    batch = batch_for_shader(shader, "TRI_FAN", {"pos": corners, "texCoord": [(0, 0), (1, 0), (1, 1), (0, 1)]})
    shader.uniform_sampler("image", texture)
    shader.uniform_float("color", (1.0, 1.0, 1.0, opacity))
    batch.draw(shader)


def mark_color(mark: dict[str, Any], colors: dict[int, tuple[float, float, float]]) -> tuple[float, float, float]:
    if mark.get("erase"):
        return ERASE
    class_id = mark.get("class_id")
    return VOID if class_id is None else colors.get(class_id, ERASE)


def _draw_mark(
    mark: dict[str, Any],
    points: Sequence[Sequence[float]],
    region: bpy.types.Region,
    size: tuple[int, int],
    colors: dict[int, tuple[float, float, float]],
) -> None:
    scale = editor.zoom(region, size)
    width = max(2.0, mark["width"] * scale)
    places = [editor.place_of(region, size, x, y) for x, y in points]
    color = (*mark_color(mark, colors), 1.0)
    if mark.get("shape") in ("click", "part") or len(places) == 1:
        for x, y in places:
            _disc(x, y, width / 2 + RIM_WIDTH, RIM)
            _disc(x, y, width / 2, color)
        return
    if mark.get("shape") == "outline":
        width, places = 2.0, [*places, places[0]]
    for x, y in (places[0], places[-1]):
        _disc(x, y, width / 2 + RIM_WIDTH, RIM)
    _line(places, width + 2 * RIM_WIDTH, RIM, region)
    _line(places, width, color, region)
    for x, y in (places[0], places[-1]):
        _disc(x, y, width / 2, color)


def _line(places: Sequence[Sequence[float]], width: float, color: Sequence[float], region: bpy.types.Region) -> None:
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", (region.width, region.height))
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", color)
    batch_for_shader(shader, "LINE_STRIP", {"pos": [(x, y, 0.0) for x, y in places]}).draw(shader)


def _disc(x: float, y: float, radius: float, color: Sequence[float]) -> None:
    from math import cos, pi, sin

    _fan([(x + radius * cos(2 * pi * i / CIRCLE), y + radius * sin(2 * pi * i / CIRCLE)) for i in range(CIRCLE)], color)


def _fan(corners: Sequence[Sequence[float]], color: Sequence[float]) -> None:
    """A convex area in one color."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", color)
    batch_for_shader(shader, "TRI_FAN", {"pos": [(x, y, 0.0) for x, y in corners]}).draw(shader)


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister() -> None:
    global _handle, live
    if _handle is not None:
        bpy.types.SpaceImageEditor.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    live = None
    _textures.clear()
