"""Photographs any Blender scene: one colour picture, one exact label map and one depth map per camera pose.

The scene's own render settings are put back afterwards.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import bpy
import numpy as np
from mathutils import Matrix

from ..errors import SceneError
from .pixels import read_exr, write_index_png

LabelSource = Literal["material", "object", "collection", "none"]
SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
MAX_ID = 32767  # Blender's largest pass index
FAR = 1e9  # Cycles writes 1e10 where a ray meets nothing


@dataclass(frozen=True)
class Lens:
    """Pinhole camera with square pixels: image size, focal length and principal point in pixels (None: the centre)."""

    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float] | None = None

    def intrinsics(self) -> dict[str, Any]:
        """The lens in the words of transforms.json."""
        cx, cy = self.center_px or (self.width / 2, self.height / 2)
        return {"w": self.width, "h": self.height, "fl_x": self.focal_px, "fl_y": self.focal_px, "cx": cx, "cy": cy}


@dataclass(frozen=True)
class Shot:
    """One picture to take. `camera_to_world` (4, 4): OpenGL axes, scene units; file names without a suffix."""

    name: str
    camera_to_world: np.ndarray
    lens: Lens


def class_ids(scene: bpy.types.Scene, source: LabelSource) -> dict[str, int]:
    """Names and ids (1 …) of the classes that `source` distinguishes in the scene, in a stable order.

    "material" and "object": what has a pass index set keeps it (several may share one: the first name wins); if none
    has, they are numbered by name. "collection": the collections directly below the scene's, with what they
    hold instances of; what lies in none of them is void.
    """
    if source == "none":
        return {}
    if source == "collection":
        return {c.name: number for number, c in enumerate(sorted(scene.collection.children, key=lambda c: c.name), 1)}
    items = _items(scene, source)
    if any(item.pass_index for item in items):
        found: dict[int, str] = {}
        for item in items:
            if item.pass_index:
                found.setdefault(item.pass_index, item.name)
        return {name: number for number, name in sorted(found.items())}
    return {name: number for number, name in enumerate(sorted({item.name for item in items}), 1)}


def _items(scene: bpy.types.Scene, source: LabelSource) -> list[Any]:
    """The objects that render, or their materials, by name; also those that come in by instancing, and from other files, where
    they may be called as those here."""
    instances = (each.object.original for each in bpy.context.evaluated_depsgraph_get().object_instances)
    found = {item for item in instances if item.type in SURFACES and not item.hide_render}
    if source != "object":
        found = {slot.material for item in found for slot in item.material_slots if slot.material}
    return sorted(found, key=lambda item: item.name_full)


def photograph(
    scene: bpy.types.Scene,
    shots: list[Shot],
    out: Path,
    *,
    samples: int = 24,
    labels: LabelSource = "material",
    depth: bool = True,
    transparent: bool = False,
    progress: Callable[[int, Shot], None] = lambda index, shot: None,
) -> None:
    """Render `shots` into out/NAME.png (8-bit sRGB), out/NAME.label.png (class ids) and out/NAME.depth.npy.

    Depth is the float32 distance along the viewing axis in scene units, 0 where there is nothing. Labels and depth
    are taken at pixel centres, one ray each, so that ids are never mixed; ids above 255 make maps of 16 bits. `progress` hears of each finished shot.

    Args:
        samples: Cycles samples per pixel of the colour picture.
        labels: what tells classes apart, see `class_ids`.
        transparent: RGBA pictures, alpha 0 where there is nothing, instead of the world's background.
    Raises:
        SceneError: there are more classes than Blender has pass indices for.
    """
    largest = max(class_ids(scene, labels).values(), default=0)
    if largest > MAX_ID:
        raise SceneError(
            f"A class of the scene has the number {largest}; pass indices and classes go up to {MAX_ID}: tell classes "
            "apart by something else."
        )
    dtype = np.dtype(np.uint8 if largest < 256 else np.uint16)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    with _settings_kept(scene), _indexed(scene, labels), _camera(scene):
        render = scene.render
        render.engine = "CYCLES"
        render.resolution_percentage, render.pixel_aspect_x, render.pixel_aspect_y = 100, 1.0, 1.0
        render.use_border = render.use_motion_blur = False
        render.film_transparent = transparent
        render.use_persistent_data = True
        render.use_compositing = render.use_sequencer = False
        render.use_stamp = render.use_multiview = False
        # One change of the camera per shot and two passes over the list would lose the finished shots of a
        # cancelled run, so both renders of a shot are made in turn.
        for index, shot in enumerate(shots):
            _aim(scene, shot)
            _render_colour(scene, out / f"{shot.name}.png", samples, transparent)
            if labels != "none" or depth:
                _render_data(scene, out, shot.name, labels, depth, dtype)
            progress(index, shot)


def _aim(scene: bpy.types.Scene, shot: Shot) -> None:
    lens, data = shot.lens, scene.camera.data
    scene.render.resolution_x, scene.render.resolution_y = lens.width, lens.height
    data.lens = lens.focal_px * data.sensor_width / lens.width
    intrinsics = lens.intrinsics()
    data.shift_x = (lens.width / 2 - intrinsics["cx"]) / lens.width
    data.shift_y = (intrinsics["cy"] - lens.height / 2) / lens.width
    scene.camera.matrix_world = Matrix(np.asarray(shot.camera_to_world).tolist())


def _render_colour(scene: bpy.types.Scene, path: Path, samples: int, transparent: bool) -> None:
    _set_format(scene, "PNG")
    scene.render.image_settings.color_mode = "RGBA" if transparent else "RGB"
    scene.render.image_settings.color_depth = "8"
    scene.render.image_settings.compression = 15
    cycles = scene.cycles
    cycles.samples, cycles.use_adaptive_sampling = samples, samples > 16
    cycles.adaptive_threshold = 0.05
    cycles.filter_width, cycles.pixel_filter_type = 1.5, "BLACKMAN_HARRIS"
    cycles.use_denoising = has_denoiser()
    if cycles.use_denoising:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_prefilter = "FAST"
    for layer in scene.view_layers:
        layer.use_pass_combined = True
        layer.use_pass_z = layer.use_pass_material_index = layer.use_pass_object_index = False
    _render(scene, path)


def _render_data(
    scene: bpy.types.Scene, out: Path, name: str, labels: LabelSource, depth: bool, dtype: np.dtype
) -> None:
    _set_format(scene, "OPEN_EXR_MULTILAYER")
    scene.render.image_settings.exr_codec = "NONE"
    scene.render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = 1, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 0.01
    for layer in scene.view_layers:
        layer.use_pass_z = True
        layer.use_pass_material_index = labels == "material"
        layer.use_pass_object_index = labels in {"object", "collection"}
    path = out / f"{name}.data.exr"
    _render(scene, path)
    channels = read_exr(path)
    path.unlink()
    z = np.minimum.reduce([_pass(channels, c, ("Depth", "Z")) for c in _layers(channels)]).astype(np.float32)
    empty = z > FAR
    if depth:
        np.save(out / f"{name}.depth.npy", np.where(empty, 0, z))
    if labels != "none":
        passes = ("IndexMA", "Material Index") if labels == "material" else ("IndexOB", "Object Index")
        index = np.maximum.reduce([_pass(channels, c, passes) for c in _layers(channels)])
        write_index_png(out / f"{name}.label.png", np.where(empty, 0, np.rint(index)).astype(dtype))


def _layers(channels: dict[str, np.ndarray]) -> list[str]:
    """View layers that have a depth channel; the names look like "ViewLayer.Depth.V", and a layer's own may have dots."""
    parts = [name.rsplit(".", 2) for name in channels]
    return sorted({part[0] for part in parts if part[1:2] in (["Depth"], ["Z"])})


def _pass(channels: dict[str, np.ndarray], layer: str, names: tuple[str, ...]) -> np.ndarray:
    for name, values in channels.items():
        if name.rpartition(".")[0] in [f"{layer}.{one}" for one in names]:
            return values
    raise RuntimeError(f"Cycles wrote no {names[0]} pass; it wrote {', '.join(sorted(channels))}.")


def _render(scene: bpy.types.Scene, path: Path) -> None:
    temporary = path.with_name("writing" + path.suffix)
    scene.render.use_file_extension = False
    scene.render.filepath = str(temporary)
    bpy.ops.render.render(write_still=True, scene=scene.name)
    os.replace(temporary, path)


def _set_format(scene: bpy.types.Scene, file_format: str) -> None:
    """Blender 5 sorts formats by medium and refuses the format of another one."""
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE" if file_format == "OPEN_EXR_MULTILAYER" else "IMAGE"
    settings.file_format = file_format


def has_denoiser() -> bool:
    """Whether this Blender was built with OpenImageDenoise (Debian's is not)."""
    import _cycles

    return bool(getattr(_cycles, "with_openimagedenoise", False))


@contextmanager
def _camera(scene: bpy.types.Scene) -> Iterator[None]:
    data = bpy.data.cameras.new("Fieldwork photographer")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.clip_start, data.clip_end = 0.001, 1e6
    camera = bpy.data.objects.new(data.name, data)
    scene.collection.objects.link(camera)
    before = scene.camera
    # Rendering makes the camera of a timeline marker the scene's, and so does changing a marker.
    bound = [(marker, marker.camera) for marker in scene.timeline_markers]
    for marker, _ in bound:
        marker.camera = None
    scene.camera = camera
    try:
        yield
    finally:
        for marker, marked in bound:
            marker.camera = marked
        scene.camera = before
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(data)


def _members(collection: bpy.types.Collection) -> dict[bpy.types.Object, None]:
    """The objects of a collection, those below it, and those of collections of which they are instances."""
    found, left, seen = {}, [collection], {collection}
    while left:
        objects = left.pop().all_objects
        found |= dict.fromkeys(objects)
        inside = {item.instance_collection for item in objects if item.instance_type == "COLLECTION"} - {None, *seen}
        seen |= inside
        left += inside
    return found


@contextmanager
def _indexed(scene: bpy.types.Scene, source: LabelSource) -> Iterator[None]:
    """Give materials or objects the pass index of their class while the block runs."""
    ids = class_ids(scene, source)
    items: list[tuple[Any, int]] = []
    if source == "collection":
        number = {o: ids[c.name] for c in scene.collection.children for o in _members(c)}
        # Where an object lies itself counts before where it is instanced.
        number |= {o: ids[c.name] for c in scene.collection.children for o in c.all_objects}
        items = [(o, number.get(o, 0)) for o in bpy.data.objects]
    elif source in {"material", "object"}:
        found = _items(scene, source)
        if not any(item.pass_index for item in found):
            items = [(item, ids[item.name]) for item in found]
    before = [(item, item.pass_index) for item, _ in items]
    for item, number in items:
        item.pass_index = number
    try:
        yield
    finally:
        for item, number in before:
            item.pass_index = number


@contextmanager
def _settings_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Put the render settings that `photograph` touches back to what they were."""
    targets = [
        (scene.render, ("engine", "resolution_x", "resolution_y", "resolution_percentage", "use_persistent_data")),
        (scene.render, ("use_compositing", "use_sequencer", "use_file_extension", "filepath")),
        (scene.render, ("use_stamp", "use_multiview")),
        (scene.render, ("pixel_aspect_x", "pixel_aspect_y", "use_border", "use_motion_blur", "film_transparent")),
        (scene.cycles, ("samples", "use_adaptive_sampling", "adaptive_threshold", "filter_width")),
        (scene.cycles, ("pixel_filter_type", "use_denoising", "denoiser")),
        (scene.cycles, ("denoising_input_passes", "denoising_prefilter")),
        (
            scene.render.image_settings,
            ("media_type", "file_format", "color_mode", "color_depth", "exr_codec", "compression"),
        ),
    ]
    names = ("use_pass_combined", "use_pass_z", "use_pass_material_index", "use_pass_object_index")
    targets += [(layer, names) for layer in scene.view_layers]
    before = [
        (target, name, getattr(target, name)) for target, names in targets for name in names if hasattr(target, name)
    ]
    try:
        yield
    finally:
        for target, name, value in before:
            if value != "":  # a choice among none, such as the denoiser of a build without one
                setattr(target, name, value)
