"""The render engine “Fieldwork”: F12 and animations of the field, in a window and without one.

How a frame is rendered (rendering.py) is loaded with the first: enabling the extension must be quick.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import bpy

from .. import machine
from ..errors import EngineError, SceneError
from .shared_scene import OWNER

if TYPE_CHECKING:
    from .frames import FrameEngine

ENGINE = "FIELDWORK"
IDLE_PERIOD = 10.0  # seconds between two looks at an engine that may have nothing to do


def _open_link() -> Any:
    from ..engine.link import Link
    from ..jobs.queue import queue

    return Link(queue.engine_python(), machine.engine_log().with_name(f"frames-{machine.engine_log().stem}.log"))


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


def frames_run() -> bool:
    """Whether the engine of frames is there."""
    return _frames is not None and _frames.process is not None


def rest_frames() -> None:
    """End the engine of frames, and free its memory, until the next frame; one that is being rendered fails."""
    if _frames is not None:
        _frames.rest()


def close_frames() -> None:
    """End the engine of frames, if there is one."""
    global _frames
    with _making:
        if _frames is not None:
            _frames.close()
            _frames = None


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
        from . import passes

        for each in passes.wanted(scene, renderlayer):
            self.register_pass(scene, renderlayer, each.name, each.channels, each.letters, each.kind)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        from .rendering import render_frame

        try:
            render_frame(self, depsgraph, frames)
        except (SceneError, EngineError) as error:
            if getattr(error, "kind", "") != "cancelled":
                self._fail(str(error), depsgraph.scene)

    def _fail(self, message: str, scene: bpy.types.Scene) -> None:
        self.report({"ERROR"}, message)
        self.error_set(message)
        if OWNER in scene:
            untold.append(message)

    # The viewport: the field is drawn in all shading modes (viewport.py), here is nothing else.

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        pass

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        import gpu

        from .passes import world_color

        color = world_color(depsgraph.scene_eval.world)
        gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))


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
