"""Depth of the scene's objects in a viewport that has none itself.

With hidden overlays EEVEE leaves no depth behind, and Cycles none either in some versions: then what a viewport shows is
drawn here once more, as depth alone. A view that stands still among objects that do not change costs nothing.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import bpy

from .objects import SOLID, mesh_of

UNUSED = 30.0  # seconds after which what no viewport asked for is given up

VERTEX = "void main() { gl_Position = clip_from_object * vec4(position, 1.0); }"
FRAGMENT = "void main() { out_depth = vec4(gl_FragCoord.z, 0.0, 0.0, 1.0); }"


def lacks_depth(space: Any) -> bool:
    """Whether a 3D viewport's own depth cannot be relied on."""
    return not space.overlay.show_overlays and space.shading.type in ("MATERIAL", "RENDERED")


class Target:
    """What the depth of one viewport is drawn into."""

    def __init__(self, size: tuple[int, int]) -> None:
        import gpu

        self.size, self.used = size, 0.0
        self.buffer = gpu.types.GPUOffScreen(*size, format="RGBA32F")
        self.state: Any = None  # what it shows


class Shape(NamedTuple):
    """Triangles of an object on the card; `owners`: the names of the object and its data, whose changes end it."""

    owners: frozenset[str]
    batch: Any


class SceneDepth:
    """Depth of the scene's objects in each viewport; one for Blender."""

    def __init__(self) -> None:
        self._targets: dict[int, Target] = {}
        self._shapes: dict[tuple[str, int], Shape] = {}
        self._shader: Any = None
        self._none: Any = None
        self.changes = 0  # of the scene, counted

    def none(self) -> Any:
        """A texture that hides nothing, of one pixel."""
        import gpu

        if self._none is None:
            self._none = gpu.types.GPUTexture((1, 1), format="R32F", data=gpu.types.Buffer("FLOAT", 1, [1.0]))
        return self._none

    def texture(self, context: Any, region: Any, view3d: Any) -> Any:
        """Depth in [0, 1] (red, as large as the region) of what the view's objects cover, 1 where there are none."""
        _listen()
        size = region.width, region.height
        target = self._targets.get(region.as_pointer())
        if target is None or target.size != size:
            target = self._targets[region.as_pointer()] = Target(size)
        target.used = time.monotonic()
        state = (
            self.changes,
            tuple(value for row in view3d.perspective_matrix for value in row),
            context.space_data.shading.type,
        )
        if state != target.state:
            self._draw(target, context, view3d.perspective_matrix)
            target.state = state
        return target.buffer.texture_color

    def give_up(self, now: float) -> None:
        """Let go of what no viewport asks for any more."""
        self._targets = {key: one for key, one in self._targets.items() if now - one.used < UNUSED}
        if not self._targets:
            self._shapes = {}

    def changed(self, names: set[str] | None) -> None:
        """The scene changed; of the objects and data so called also the shape, None: of all."""
        self.changes += 1
        self._shapes = {} if names is None else {k: one for k, one in self._shapes.items() if not one.owners & names}

    def _draw(self, target: Target, context: Any, clip_from_scene: Any) -> None:
        import gpu

        self._shader = self._shader or _shader()
        with target.buffer.bind():
            gpu.state.active_framebuffer_get().clear(color=(1.0, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("LESS_EQUAL")
            gpu.state.depth_mask_set(True)
            self._shader.bind()
            for instance in context.evaluated_depsgraph_get().object_instances:
                if not _covers(instance, context.space_data):
                    continue
                batch = self._batch(instance.object)
                if batch is not None:
                    self._shader.uniform_float("clip_from_object", clip_from_scene @ instance.matrix_world)
                    batch.draw(self._shader)
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("NONE")

    def _batch(self, evaluated: Any) -> Any:
        """The triangles of an evaluated object on the card; None without any."""
        from gpu_extras.batch import batch_for_shader

        data = evaluated.data
        key = evaluated.original.name_full, data.as_pointer() if data is not None else 0
        found = self._shapes.get(key)
        if found is None:
            vertices, faces = mesh_of(evaluated)
            batch = None
            if len(faces):
                batch = batch_for_shader(self._shader, "TRIS", {"position": vertices}, indices=faces)
            names = {evaluated.original.name_full} | ({data.name_full} if data is not None else set())
            found = self._shapes[key] = Shape(frozenset(names), batch)
        return found.batch


def _covers(instance: Any, space: Any) -> bool:
    """Whether a viewport shows an instance as something that hides what is behind it."""
    obj = instance.object
    shown = (instance.parent or obj).original
    return (
        obj.type in SOLID
        and instance.show_self
        and obj.display_type not in ("BOUNDS", "WIRE")
        and shown.visible_in_viewport_get(space)
    )


def _shader() -> Any:
    import gpu

    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "clip_from_object")
    info.vertex_in(0, "VEC3", "position")
    info.fragment_out(0, "VEC4", "out_depth")
    info.vertex_source(VERTEX)
    info.fragment_source(FRAGMENT)
    return gpu.shader.create_from_info(info)


scene_depth = SceneDepth()


@bpy.app.handlers.persistent
def _updated(scene: Any, depsgraph: Any) -> None:
    scene_depth.changed({update.id.original.name_full for update in depsgraph.updates if update.is_updated_geometry})


@bpy.app.handlers.persistent
def _other_data(*_arguments: Any) -> None:
    scene_depth.changed(None)


HANDLERS = (
    ("depsgraph_update_post", _updated),
    ("frame_change_post", _updated),
    ("undo_post", _other_data),
    ("redo_post", _other_data),
    ("load_post", _other_data),
)


def _listen() -> None:
    """Hear of changes of the scene from now on."""
    if _updated not in bpy.app.handlers.depsgraph_update_post:
        for name, handler in HANDLERS:
            getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    for name, handler in HANDLERS:
        if handler in getattr(bpy.app.handlers, name):
            getattr(bpy.app.handlers, name).remove(handler)
    scene_depth.__init__()
