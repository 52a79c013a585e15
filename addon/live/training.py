"""Fields that are being trained, in the 3D viewport: the training makes pictures of what is looked at, coarse ones first.

Nothing is asked of the training but by files (nerfcore/project/live.py), so that it may run in any process of this
computer; a view that nobody draws any more is not made pictures of.
"""

from __future__ import annotations

import mmap
import time
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix

from . import fields, index
from .redraw import redraw_views

HEADER = 64  # as nerfcore/film/shared_file.py writes it
WATCHING, IDLE = 0.05, 0.5  # seconds between two looks for new pictures, and for trainings
SPACING = 0.04  # seconds between two requests
UNDRAWN = 3.0  # seconds after which what is not drawn any more is not asked for


class Textures(NamedTuple):
    """A picture as the viewport lays it over a view: colour (sRGB, associated alpha) and depth."""

    color: Any
    depth: Any


class Received(NamedTuple):
    """A picture of the training: number of its request, its size, colours (H·W·4) and depths (H·W), bottom row first."""

    number: int
    width: int
    height: int
    color: Any
    depth: Any


class PixelFile:
    """The file that pictures of one view come through. Raises OSError: there is no room for it."""

    def __init__(self, path: Path, pixels: int) -> None:
        from .frames import make_room  # not at the top: enabling the extension must be quick

        self.path, self.pixels = path, pixels
        with open(path, "w+b") as file:
            make_room(file, HEADER + 20 * pixels)
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.seen = 0  # counter of the picture that was read last

    def _counter(self) -> int:
        return int.from_bytes(self._map[:8], "little")

    @property
    def fresh(self) -> bool:
        """Whether there is a picture that was not read."""
        return self._counter() not in (0, self.seen)

    def read(self) -> Received | None:
        """The newest picture; None where there is none or it is being written."""
        import numpy as np

        counter = self._counter()
        if counter == 0 or counter % 2:
            return None
        number, width, height = np.frombuffer(self._map[8:32], np.int64).tolist()
        count = width * height
        if not 0 < count <= self.pixels:
            return None
        values = np.frombuffer(self._map[HEADER : HEADER + 20 * count], np.float32)
        if self._counter() != counter:
            return None
        self.seen = counter
        return Received(number, width, height, values[: 4 * count], values[4 * count :])

    def close(self) -> None:
        from ...nerfcore.project import live  # not at the top: enabling the extension must be quick

        self._map.close()
        live.remove(self.path)


class Watch:
    """What one region shows of one field in training."""

    def __init__(self, project: Path, file: PixelFile) -> None:
        self.project, self.file = project, file
        self.asked: dict[str, Any] = {}
        self.number = 0
        self.shown: Textures | None = None
        self.shown_number = 0
        self.size = (0, 0)  # of the picture that is shown
        self.drawn = 0.0


class Trainings:
    """All views of fields in training; one for Blender."""

    def __init__(self) -> None:
        self.views: dict[tuple[int, str], Watch] = {}
        self.pictures = 0  # that came
        self._runs: dict[Path, tuple[float, str | None]] = {}  # when a project was looked at, and what it trains
        self._files = 0
        self._dirty: set[Path] = set()
        self._written: dict[Path, float] = {}

    def run_of(self, project: Path) -> str | None:
        """The run that a project trains at the moment."""
        from ...nerfcore.project import live

        if not bpy.app.background and not bpy.app.timers.is_registered(tick):
            bpy.app.timers.register(tick, first_interval=IDLE, persistent=True)
        looked, run = self._runs.get(project, (0.0, None))
        if time.monotonic() - looked > IDLE:
            run = live.training_run(project)
            self._runs[project] = time.monotonic(), run
        return run

    def textures(
        self, key: tuple[int, str], part: fields.Part, project: Path, size: tuple[int, int], scene_from_clip: Matrix
    ) -> Textures | None:
        """What there is to be laid over a view (`key`: region and part) of this size; None where the field is not in
        training, or no picture has come yet. Asks for pictures. Raises OSError: there is no room for them."""
        if self.run_of(project) != part.field.fieldwork.run:
            self._forget(key)
            return None
        watch = self.views.get(key)
        if watch is not None and (watch.project != project or watch.file.pixels != size[0] * size[1]):
            last = watch.shown
            self._forget(key)
            watch = None
        else:
            last = None
        if watch is None:
            watch = self.views[key] = self._new(project, size)
            watch.shown = last
        watch.drawn = time.monotonic()
        asked = {
            "width": size[0],
            "height": size[1],
            "scene_from_clip": fields.rows(scene_from_clip),
            "field": fields.item_of(part.field, False) | fields.poses_of_part(part),
            "file": str(watch.file.path),
        }
        if asked != watch.asked:
            watch.asked, watch.number = asked, watch.number + 1
            self._dirty.add(project)
        if watch.file.fresh:
            self._take(watch)
        self.tell(watch.drawn)
        return watch.shown

    def _new(self, project: Path, size: tuple[int, int]) -> Watch:
        from .engine import frames

        self._files += 1
        return Watch(project, PixelFile(frames().folder() / f"view-{self._files}.pixels", size[0] * size[1]))

    def _take(self, watch: Watch) -> None:
        import gpu

        got = watch.file.read()
        if got is None:
            return
        buffers = (gpu.types.Buffer("FLOAT", len(values), values) for values in (got.color, got.depth))
        size = got.width, got.height
        kinds = ("RGBA16F", "R32F")
        watch.shown = Textures(*(gpu.types.GPUTexture(size, format=f, data=b) for f, b in zip(kinds, buffers)))
        watch.shown_number, watch.size = got.number, size
        self.pictures += 1

    def tell(self, now: float) -> None:
        """Write what is asked for, not too often, and give a sign of life."""
        from ...nerfcore.project import live

        for project in {watch.project for watch in self.views.values()}:
            since = now - self._written.get(project, 0.0)
            if project in self._dirty and since > SPACING:
                asked = [
                    {**watch.asked, "number": watch.number} for watch in self.views.values() if watch.project == project
                ]
                if live.write(live.views_file(project), {"views": asked}):
                    self._dirty.discard(project)
                self._written[project] = now
            elif since > live.TOUCH:
                live.touch(live.views_file(project))
                self._written[project] = now

    def look(self) -> bool:
        """Called by the timer: whether there is something new to be drawn."""
        now = time.monotonic()
        for key in [key for key, watch in self.views.items() if now - watch.drawn > UNDRAWN]:
            # A view that stands still is not drawn again; its region says whether it is still there.
            if not _is_there(key):
                self._forget(key)
        known = {project: run for project, (_, run) in self._runs.items()}
        changed = any(self.run_of(project) != run for project, run in known.items())
        self.tell(now)
        return changed or any(watch.file.fresh for watch in self.views.values())

    def _forget(self, key: tuple[int, str]) -> None:
        watch = self.views.pop(key, None)
        if watch is None:
            return
        watch.file.close()
        if any(other.project == watch.project for other in self.views.values()):
            self._dirty.add(watch.project)
        else:
            from ...nerfcore.project import live

            live.remove(live.views_file(watch.project))
            self._dirty.discard(watch.project)

    def close(self) -> None:
        """Look at nothing any more."""
        for key in list(self.views):
            self._forget(key)


def _is_there(key: tuple[int, str]) -> bool:
    """Whether a region still shows a field: it is in a window, and fields are drawn."""
    for window in bpy.context.window_manager.windows:
        if not window.scene.fieldwork_live.viewport:
            continue
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and any(region.as_pointer() == key[0] for region in area.regions):
                layer = window.view_layer
                name = key[1].partition("\n")[0]  # of a part: that of the scene's object
                found = index.current().objects
                obj = next((obj for obj in found if obj.name_full == name), None)  # also linked ones
                return obj is not None and obj.visible_get(view_layer=layer)
    return False


trainings = Trainings()


def tick() -> float:
    """What the timer does: redraw views when a picture has come, or a training has begun or ended."""
    changed = trainings.look()
    if changed:
        redraw_views()  # views that begin to look at a training do so while they are drawn, after this
    return WATCHING if changed or trainings.views else IDLE


def unregister() -> None:
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    trainings.close()
