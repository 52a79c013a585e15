"""Fields in the 3D viewport, in any shading mode, with depth: drawn by Blender's own GPU module after the scene.

Of a field in training the pictures of the training are shown (training.py), else the baked field.

A field is marched into a picture of its own, coarse while the view moves and then finer, in strips that hold the window up
only briefly; each redraw lays the picture over the view. Nothing of the GPU module is touched before the first field is
drawn.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix

from . import fields, thing_texels, things, voxels
from .assets import Asset, texture
from .redraw import redraw_views
from .scene_depth import lacks_depth, scene_depth
from .training import Textures, trainings

BUDGET = 0.05  # seconds of marching in a redraw once the view stands still, or as long as the rest of the redraw takes
LONGEST = 0.5  # seconds of marching in a redraw at most
COARSEST = 8  # pixels of the viewport on a side of one of the picture, while the view moves on a weak card
MOVED = 0.15  # seconds a picture may take while the view moves, before it is made coarser
STRIPS = 64  # redraws at most, in which a picture becomes fine: how long a few rows take says little
SETTLED = 0.15  # seconds without a change, after which pictures become finer
RETRY = 10.0  # seconds after which drawing what went wrong is tried again
UNUSED = 30.0  # seconds after which what no viewport shows is given up


class Picture:
    """Colour and depth of a field at some size."""

    def __init__(self, width: int, height: int) -> None:
        import gpu

        self.width, self.height = width, height
        self.color = gpu.types.GPUTexture((width, height), format="RGBA16F")
        self.depth = gpu.types.GPUTexture((width, height), format="R32F")
        self.buffer = gpu.types.GPUFrameBuffer(color_slots=[self.color, self.depth])
        self.rows = 0  # that are drawn, from below

    @property
    def done(self) -> bool:
        return self.rows >= self.height


class View:
    """What one region shows of one field: the picture that is laid over it, and a finer one in the making."""

    def __init__(self) -> None:
        self.state: Any = None  # what the pictures show
        self.changed = 0.0
        self.used = 0.0
        self.coarse = 2
        self.shown: Picture | None = None
        self.next: Picture | None = None
        self.row_seconds = 1e-3  # a row of the finest picture takes
        self.marched = 0.0  # seconds of the last whole coarse picture
        self.refined = False
        self._tables: tuple[Any, Any, Any] = (None, None, None)

    def tables(self, shows: Shown, told: thing_texels.Told | None) -> dict[str, Any]:
        """The looks, and the marks of blocks in which they are edited, as textures; new ones when they changed."""
        key = shows.rows, told
        if self._tables[0] is None or self._tables[0][0] != key[0] or self._tables[0][1] is not told:
            import numpy as np

            looks = texture((256, 2), "RGBA16F", np.array(shows.rows, np.float32))
            self._tables = key, looks, texture(voxels.MARKS, "R16F", voxels.marks(shows.looks, told))
        return {"lut": self._tables[1], "marks": self._tables[2]}


class Shown(NamedTuple):
    """How a field is shown: looks of its class indices, the same as rows of the table, the scene from its cube [−1, 1]³, and from
    the cube to which it is cut."""

    looks: list[voxels.Look]
    rows: list[float]
    box: Matrix
    crop: Matrix | None


class Viewport:
    """All that is drawn; one for Blender."""

    def __init__(self) -> None:
        self.assets: dict[tuple[str, int], Asset] = {}
        self.views: dict[tuple[int, str], View] = {}
        self.seconds: list[float] = []  # of Python in the last redraws
        self.frame_seconds: list[float] = []  # of whole redraws in which something was marched
        self._march: Any = None
        self._lay: Any = None
        self._batches: list[Any] = []
        self.error = ""
        self._again: dict[int, float] = {}  # when views that could not be drawn try again, by region
        self._ended = 0.0  # when the last redraw was done here
        self._rest = 0.0  # seconds that a redraw takes beside what is done here
        self._waited = 0.0  # seconds of this redraw in which the card did what was asked of it before
        self._looks: dict[str, list[voxels.Look]] = {}  # of the classes of fields, in this redraw

    def draw(self, context: bpy.types.Context, shown: list[fields.Part]) -> None:
        """Draw the fields of a view; what goes wrong is told in the panel, not in each redraw."""
        key = context.region.as_pointer()
        if time.monotonic() < self._again.get(key, 0.0):
            return
        try:
            self._draw(context, context.region, context.region_data, shown)
            self._again.pop(key, None)
            self.error = self.error if self._again else ""
        except Exception as error:  # noqa: BLE001 - a handler that raises in each redraw would fill the terminal
            self.error = f"{type(error).__name__}: {error}"
            self._again = {view: when for view, when in self._again.items() if when > time.monotonic() - RETRY}
            self._again[key] = time.monotonic() + RETRY

    def _draw(self, context: Any, region: Any, view3d: Any, shown: list[fields.Part]) -> None:
        begin = time.perf_counter()
        if self._march is None:
            self._prepare()
        now = time.monotonic()
        self._rest, self._waited, self._looks = min(now - self._ended, LONGEST), 0.0, {}
        scene_from_clip = view3d.perspective_matrix.inverted_safe()
        quality = int(context.scene.fieldwork_live.quality)
        objects = scene_depth.texture(context, region, view3d) if lacks_depth(context.space_data) else None
        unfinished, marched = False, 0.0
        # The farthest first: pixels at edges of nearer ones mix with what is behind.
        for part in sorted(shown, key=lambda one: _depth(view3d.view_matrix, one)):
            own = part.field.fieldwork
            project = fields.folder_of(own)
            if project is None:
                continue
            key = (region.as_pointer(), part.name)
            if part.copy is None:
                size = max(1, region.width // quality), max(1, region.height // quality)
                trained = trainings.textures(key, part, project, size, scene_from_clip)
                if trained is not None:
                    self._lay_over(trained, region, objects)
                    continue
            elif trainings.run_of(project) == own.run:
                continue
            baked = voxels.baked(project, own.run)
            if baked is None:
                continue
            asset = self.assets.setdefault(baked.key, Asset(baked))
            asset.used = now
            if not asset.ready:
                if not asset.error and not unfinished:
                    asset.load()
                unfinished = unfinished or not asset.error
                continue
            shows = self._placed(part, project, asset)
            if shows is None:
                continue
            state = (
                _numbers(view3d.perspective_matrix), _numbers(shows.box), shows.crop and _numbers(shows.crop), own.look,
                tuple(shows.rows), baked.key, id(asset.told), region.width, region.height, quality,
            )  # fmt: skip
            view = self.views.setdefault(key, View())
            view.used = now
            uniforms = _uniforms(baked.meta, view3d.perspective_matrix, scene_from_clip, shows, own.look)
            marched += self._bring_up(view, state, asset, shows, uniforms, (region.width, region.height), quality, now)
            unfinished = unfinished or not view.refined
            if view.shown is not None:
                self._lay_over(view.shown, region, objects)
        self._give_up(now)
        spent = time.perf_counter() - begin
        self.seconds = [*self.seconds[-99:], spent - marched - self._waited]
        if marched:
            self.frame_seconds = [*self.frame_seconds[-99:], spent]
        self._ended = time.monotonic()
        if unfinished:
            _redraw_soon()

    def _placed(self, part: fields.Part, project: Path, asset: Asset) -> Shown | None:
        """How a part is shown; None: a copy whose thing is not told apart yet."""
        field, own, meta = part.field, part.field.fieldwork, asset.found.meta
        looks = self._looks.get(field.name_full)
        if looks is None:
            looks = self._looks[field.name_full] = voxels.class_looks(meta, own.classes)
        world_from_box = voxels.world_from_box(project, meta)
        if part.copy is None:
            edited = things.looks(field)
            if edited:
                self._tell_apart(asset, project, own.run)
            if asset.told is not None:
                looks = voxels.thing_looks(looks, asset.told, edited)
            box = fields.crop_box(own)
            crop = part.carried() @ fields.crop_matrix(box) if box is not None else None
            return Shown(looks, voxels.rows(looks), part.carried() @ field.matrix_world @ world_from_box, crop)
        self._tell_apart(asset, project, own.run)
        told, thing = asset.told, part.copy.fieldwork_copy.thing
        place = part.carried() @ things.scene_from_capture(part.copy)
        if told is None or thing not in told.names:
            return None
        looks = voxels.alone(looks, told, thing, things.look_of_copies(field, thing).get(thing))
        cube = told.cubes[told.names.index(thing)]
        return Shown(looks, voxels.rows(looks), place @ world_from_box, place @ cube)

    def _tell_apart(self, asset: Asset, project: Path, run: str) -> None:
        """Give the things of a field class indices of their own, once the engine has found them."""
        told = thing_texels.answers.of(asset.found, project, run).told
        if told is not None and told is not asset.told:
            asset.tell_apart(told)

    def _prepare(self) -> None:
        from . import shaders

        self._march, self._lay = shaders.march_shader(), shaders.lay_shader()
        self._batches = [shaders.whole_view(self._march), shaders.whole_view(self._lay)]

    def _bring_up(
        self, view: View, state: Any, asset: Asset, shows: Shown, uniforms: dict[str, Any],
        size: tuple[int, int], quality: int, now: float,
    ) -> float:  # fmt: skip
        """March what is to be marched of a view in this redraw; returns the seconds that took."""
        tables = view.tables(shows, asset.told)
        if state != view.state:
            view.state, view.changed, view.refined, view.next = state, now, False, None
            scale = max(2 * quality, view.coarse)
            view.shown = _picture(view.shown, size, scale)
            view.marched = self._march_rows(view.shown, asset, tables, uniforms, view.shown.height)
            # A weak card gets a coarser picture the next time, a strong one a finer one.
            if view.marched > MOVED and view.coarse < COARSEST:
                view.coarse *= 2
            elif view.marched < MOVED / 8 and view.coarse > 2:
                view.coarse //= 2
            view.row_seconds = view.marched / max(view.shown.height, 1) * scale / quality
            return view.marched
        if view.refined or now - view.changed < SETTLED:
            return 0.0
        if view.next is None:
            view.next = _picture(None, size, quality)
        least = -(-view.next.height // STRIPS)
        count = max(least, int(max(BUDGET, self._rest) / max(view.row_seconds, 1e-6)))
        seconds = self._march_rows(view.next, asset, tables, uniforms, count)
        view.row_seconds = 0.5 * (view.row_seconds + seconds / count)
        if view.next.done:
            view.shown, view.next, view.refined = view.next, None, True
        return seconds

    def _march_rows(
        self, picture: Picture, asset: Asset, tables: dict[str, Any], uniforms: dict[str, Any], count: int
    ) -> float:
        """Draw the next rows of a picture; returns how many seconds they took."""
        import gpu

        shader, first = self._march, picture.rows if not picture.done else 0
        count = min(count, picture.height - first)
        gpu.state.blend_set("NONE")
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        with picture.buffer.bind():
            # Reading a pixel waits for the card: first for all that was drawn before, so that only the march is timed.
            waiting = time.perf_counter()
            picture.buffer.read_color(0, first, 1, 1, 4, 0, "FLOAT")
            begin = time.perf_counter()
            self._waited += begin - waiting
            gpu.state.scissor_test_set(True)
            gpu.state.scissor_set(0, first, picture.width, count)
            shader.bind()
            shader.uniform_sampler("index_", asset.index)
            for number, texture in enumerate(asset.texels):
                shader.uniform_sampler(f"t{number}", texture)
            for name, found in tables.items():
                shader.uniform_sampler(name, found)
            for name, value in uniforms.items():
                if isinstance(value, int):
                    shader.uniform_int(name, value)
                else:
                    shader.uniform_float(name, value)
            shader.uniform_float("size", (picture.width, picture.height))
            self._batches[0].draw(shader)
            gpu.state.scissor_test_set(False)
            picture.buffer.read_color(0, first, 1, 1, 4, 0, "FLOAT")
            spent = time.perf_counter() - begin
        picture.rows = first + count
        return spent

    def _lay_over(self, picture: Picture | Textures, region: Any, objects: Any) -> None:
        """Lay a picture over the view; `objects`: depth of its objects where the view itself has none."""
        import gpu

        gpu.state.blend_set("ALPHA_PREMULT")
        gpu.state.depth_test_set("LESS_EQUAL" if objects is None else "ALWAYS")
        gpu.state.depth_mask_set(True)
        self._lay.bind()
        self._lay.uniform_sampler("picture", picture.color)
        self._lay.uniform_sampler("depths", picture.depth)
        self._lay.uniform_sampler("objects", scene_depth.none() if objects is None else objects)
        self._lay.uniform_float("size", (region.width, region.height))
        self._batches[1].draw(self._lay)
        gpu.state.depth_mask_set(False)
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")

    def _give_up(self, now: float) -> None:
        """Let go of textures and pictures that nothing shows any more."""
        self.assets = {key: asset for key, asset in self.assets.items() if now - asset.used < UNUSED}
        self.views = {key: view for key, view in self.views.items() if now - view.used < UNUSED}
        scene_depth.give_up(now)


def _picture(old: Picture | None, size: tuple[int, int], scale: int) -> Picture:
    width, height = max(1, -(-size[0] // scale)), max(1, -(-size[1] // scale))
    if old is not None and (old.width, old.height) == (width, height):
        old.rows = 0
        return old
    return Picture(width, height)


def _depth(view_from_scene: Matrix, part: fields.Part) -> float:
    """How near the place of a part is, larger for nearer ones."""
    return (view_from_scene @ part.carried() @ part.object.matrix_world).translation.z


def _numbers(matrix: Matrix) -> tuple[float, ...]:
    return tuple(value for row in matrix for value in row)


def _uniforms(
    meta: dict[str, Any], clip_from_scene: Matrix, scene_from_clip: Matrix, shows: Shown, look: float
) -> dict[str, Any]:
    """What the march needs to know."""
    cell = (4.0 if meta["contracted"] else 2.0) / (meta["side"] * (voxels.VERTICES - 1))
    box, crop = shows.box, shows.crop
    edited = any(look.edited for look in shows.looks)
    return {
        "box_from_clip": box.inverted_safe() @ scene_from_clip,
        "clip_from_box": clip_from_scene @ box,
        "crop_from_box": crop.inverted_safe() @ box if crop is not None else Matrix.Identity(4),
        "step_": cell,
        "exponent": 1.0,
        "far": float(meta["far"]),
        "empty_distance": float(meta["empty_distance"]),
        "harmonic_range": float(meta["harmonic_range"]),
        "look": float(look),
        "blocks": int(meta["side"]),
        "contracted": int(meta["contracted"]),
        "cropped": int(crop is not None),
        "classes": len(meta["class_ids"]),
        "edited": int(edited),
    }


viewport = Viewport()


def _redraw_soon() -> None:
    if not bpy.app.timers.is_registered(redraw_views):
        bpy.app.timers.register(redraw_views, first_interval=0.01)


def unregister() -> None:
    if bpy.app.timers.is_registered(redraw_views):
        bpy.app.timers.unregister(redraw_views)
    viewport.__init__()
