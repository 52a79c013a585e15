"""The render engine “Fieldwork”: F12 and animations of the field, in a window and without one.

Everything is read from the scene at the start of `render`, which runs in a thread of Blender's or, without a window, in its
only one; the engine (frames.py) does the work in a process of its own, so the picture is only waited for here.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from mathutils import Vector

from .. import machine
from ..errors import EngineError, SceneError
from ..text import t
from . import camera, fields, passes
from .shared_scene import OWNER

if TYPE_CHECKING:
    from .frames import Frame, FrameEngine

ENGINE = "FIELDWORK"
IDLE_PERIOD = 10.0  # seconds between two looks at an engine that may have nothing to do


def _open_link() -> Any:
    python = machine.engine_python()
    if python is None:
        raise EngineError("missing", "The engine is not installed.", "Install it in the preferences of Fieldwork.")
    from ..engine.link import Link

    return Link(python, machine.engine_log().with_name(f"frames-{machine.engine_log().stem}.log"))


# Why fields are missing in composites: of scenes that are rendered for another one Blender tells the terminal alone.
untold: list[str] = []
_frames: FrameEngine | None = None
_making = threading.Lock()


def frames() -> FrameEngine:
    """The engine of this Blender's frames; it is started by the first of them."""
    global _frames
    with _making:
        if _frames is None:
            from .frames import FrameEngine  # not at the top: enabling the extension must be quick

            _frames = FrameEngine(_open_link)
        return _frames


def close_frames() -> None:
    """End the engine of frames, if there is one."""
    global _frames
    with _making:
        if _frames is not None:
            _frames.close()
            _frames = None


def working_space() -> str:
    """The space of the open file's colours."""
    known = getattr(bpy.data, "colorspace", None)
    return known.working_space if known is not None else "Linear Rec.709"


class FieldworkRenderEngine(bpy.types.RenderEngine):
    bl_idname = ENGINE
    bl_label = "Fieldwork"
    bl_use_preview = False
    bl_use_postprocess = True
    bl_use_shading_nodes_custom = False
    bl_use_eevee_viewport = True

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)

    def update_render_passes(self, scene: bpy.types.Scene = None, renderlayer: bpy.types.ViewLayer = None) -> None:
        for each in passes.wanted(scene, renderlayer):
            self.register_pass(scene, renderlayer, each.name, each.channels, each.letters, each.kind)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        try:
            self._render(depsgraph)
        except (SceneError, EngineError) as error:
            if getattr(error, "kind", "") != "cancelled":
                self._fail(str(error), depsgraph.scene)

    def _fail(self, message: str, scene: bpy.types.Scene) -> None:
        self.report({"ERROR"}, message)
        self.error_set(message)
        if OWNER in scene:
            untold.append(message)

    def _render(self, depsgraph: bpy.types.Depsgraph) -> None:
        layer = depsgraph.view_layer_eval
        asked = passes.wanted(depsgraph.scene_eval, layer)
        for each in asked[1:]:
            self.add_pass(each.name, each.channels, each.letters, layer=layer.name)
        # The two of stereo; else one, whose name is empty.
        for view in [view.name for view in self.get_result().views]:
            self.active_view_set(view)
            self._render_view(depsgraph, asked, view)

    def _render_view(self, depsgraph: bpy.types.Depsgraph, asked: list[passes.RenderPass], view: str) -> None:
        layer = depsgraph.view_layer_eval
        self.update_stats("", t("Reading the scene"))
        shot = self._shot(depsgraph, asked)
        x0, y0, x1, y1 = shot["border"]
        from .frames import Frame, Sizes

        sizes = Sizes(x1 - x0, y1 - y0, {each.name: each.channels for each in asked})
        space = working_space()

        result = self.begin_result(0, 0, sizes.width, sizes.height, layer=layer.name, view=view)

        def show(colors: Any) -> None:
            self._put(result, {"Combined": colors}, space)
            self.update_result(result)

        def tell(stage: str, share: float) -> None:
            self.update_progress(share if stage == "Rendering" else 0.0)
            self.update_stats("", t(stage) if stage else "")

        try:
            if (result.resolution_x, result.resolution_y) != (sizes.width, sizes.height):
                raise SceneError(
                    t("The border of this scene is not that of the render: press Composite with Objects again.")
                )
            if shot["fields"]:
                frame = frames().render(shot, sizes, self.test_break, tell, None if bpy.app.background else show)
            else:
                frame = Frame(passes.empty(sizes, shot["world"]), {})
            self._put(result, frame.passes, space)
        except BaseException:
            self.end_result(result, cancel=True)
            raise
        finally:
            if "occluders" in shot:
                Path(shot["occluders"]).unlink(missing_ok=True)
        self.end_result(result)
        self._note_names(frame, layer.name)

    def _put(self, result: Any, pixels: dict[str, Any], space: str) -> None:
        """Pixels into a result of Blender's."""
        views = self.active_view_get()
        (layer,) = result.layers
        for name, values in pixels.items():
            found = layer.passes.find_by_name(name, views)
            if found is not None:
                values = passes.working_space(values, space) if name in passes.LIGHT else values
                found.rect.foreach_set(values.reshape(-1))

    def _note_names(self, frame: Frame, layer: str) -> None:
        """The names behind the ids of a Cryptomatte, and the revision of the marks that the classes of each field are from, as
        metadata that nodes and files have."""
        result = self.get_result()
        for kind, manifest in (frame.facts.get("manifests") or {}).items():
            name = f"{layer}.{kind}"
            key = f"cryptomatte/{_hash7(name)}/"
            result.stamp_data_add_field(key + "name", name)
            result.stamp_data_add_field(key + "hash", "MurmurHash3_32")
            result.stamp_data_add_field(key + "conversion", "uint32_to_float32")
            result.stamp_data_add_field(key + "manifest", manifest)
        for name, revision in frame.facts.get("label_revisions", {}).items():
            result.stamp_data_add_field(f"label_revision/{name}", str(revision))

    def _shot(self, depsgraph: bpy.types.Depsgraph, asked: list[passes.RenderPass]) -> dict[str, Any]:
        """What is rendered, as nerfcore/film/shot.py describes it. Raises SceneError."""
        scene, layer = depsgraph.scene_eval, depsgraph.view_layer_eval
        live, render = scene.fieldwork_live, scene.render
        if scene.camera is None:
            raise SceneError(t("The scene has no active camera."))
        if scene.camera.type != "CAMERA":
            raise SceneError(t("“{}” is the active camera, but no camera.", scene.camera.name))
        width, height = self.resolution_x, self.resolution_y
        aspect = render.pixel_aspect_x, render.pixel_aspect_y

        def eye() -> bpy.types.Object:
            return self.camera_override.evaluated_get(depsgraph)  # that of the view

        if render.use_multiview and eye().data.type == "PANO" and eye().data.stereo.use_spherical_stereo:
            raise SceneError(t("Fieldwork does not render spherical stereo: switch it off in “{}”.", eye().data.name))
        lens = camera.lens(eye(), width, height, aspect, self.camera_shift_x(eye()))
        shot: dict[str, Any] = {
            "border": border(render, width, height),
            "samples": live.samples,
            "filter_width": render.filter_size if render.filter_size > 0.01 else 0.0,
            "fields": fields.rendered_items(depsgraph),
            "passes": [each.name for each in asked],
            "levels": layer.pass_cryptomatte_depth + layer.pass_cryptomatte_depth % 2,
            "world": None if render.film_transparent else passes.rec709(world_color(scene.world), working_space()),
            "sky": not render.film_transparent,
        }
        if live.objects_hide:
            from . import objects

            shot["occluders"] = str(objects.write_triangles(frames().folder() / "objects.npz", depsgraph))
        now = scene.frame_current + scene.frame_subframe
        times = camera.shutter_times(render, now)

        known = fields.rendered_parts(depsgraph)

        def poses() -> tuple[Any, ...]:
            placed = [fields.poses_of(part.field.evaluated_get(depsgraph), depsgraph, part.copy) for part in known]
            return camera.pose(self.camera_model_matrix(eye())), placed

        seen, placed = zip(*camera.in_time(poses, times, self.frame_set, now))
        lens["poses"] = camera.moving(list(seen))
        for number, item in enumerate(shot["fields"] if known else ()):
            for name, key in (("scene_from_capture", "motion"), ("crop", "crop_motion")):
                found = camera.moving([one[number].get(name) for one in placed])
                if len(found) > 1:
                    item[key] = found
        return {**shot, "lens": lens}

    # The viewport: the field is drawn in all shading modes (viewport.py), here is nothing else.

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        pass

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        import gpu

        color = world_color(depsgraph.scene_eval.world)
        gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))


def border(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int]:
    """The pixels that are rendered, from the upper left corner: Blender's count from below."""
    if not render.use_border:
        return 0, 0, width, height
    shares = (render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y)
    # In single precision, as Blender does: 0.9 of 80 pixels are 72, not 71.
    x0, x1, y0, y1 = (int((Vector((share, 0)) * side).x) for share, side in zip(shares, (width, width, height, height)))
    return x0, height - y1, x1, height - y0


def world_color(world: bpy.types.World | None) -> tuple[float, float, float]:
    """The colour of a world that has one, linear: that of its background node where nothing is linked to it."""
    if world is None:
        return 0.0, 0.0, 0.0
    if world.node_tree is not None and world.use_nodes:
        output = world.node_tree.get_output_node("ALL")
        links = output.inputs["Surface"].links if output is not None else ()
        node = links[0].from_node if links else None
        if node is None or node.type != "BACKGROUND" or node.mute:
            return 0.0, 0.0, 0.0
        color, strength = node.inputs["Color"], node.inputs["Strength"]
        if color.is_linked or strength.is_linked:
            return 0.0, 0.0, 0.0
        red, green, blue = (channel * strength.default_value for channel in color.default_value[:3])
        return red, green, blue
    red, green, blue = world.color
    return red, green, blue


def _hash7(name: str) -> str:
    from ...nerfcore.film.cryptomatte import murmur3

    return f"{murmur3(name.encode()):08x}"[:7]


def _end_when_idle() -> float:
    minutes = machine.preferences().idle_minutes
    if minutes and _frames is not None and _frames.idle_seconds > 60 * minutes:
        _frames.rest()
    return IDLE_PERIOD


def _panels() -> list[type]:
    """Blender's own panels that say something about this engine too."""
    excluded = {"VIEWLAYER_PT_filter", "VIEWLAYER_PT_layer_passes"}
    return [
        panel
        for panel in bpy.types.Panel.__subclasses__()
        if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ()) and panel.__name__ not in excluded
    ]


CLASSES = [FieldworkRenderEngine]


def register() -> None:
    for panel in _panels():
        panel.COMPAT_ENGINES.add(ENGINE)
    if not bpy.app.background:
        bpy.app.timers.register(_end_when_idle, first_interval=IDLE_PERIOD, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_end_when_idle):
        bpy.app.timers.unregister(_end_when_idle)
    for panel in bpy.types.Panel.__subclasses__():
        if ENGINE in getattr(panel, "COMPAT_ENGINES", ()):
            panel.COMPAT_ENGINES.discard(ENGINE)
    close_frames()
