"""Pictures of a field for viewports while it is trained: a coarse one at once, then finer ones, between steps of the training.

Requests and pictures go through files (`project/live.py`, `shared_file.py`), so that any Blender may watch any training on
its computer.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..errors import FieldworkError, InputError
from ..kernels.runtime import run_parallel
from ..params import LARGEST_PICTURE
from ..project import live
from ..render.image import CPU_RAYS, LEAST
from ..render.unfinished import Unfinished
from .fields import LoadedField, PlacedField, described
from .shared_file import PictureFile
from .shot import FieldItem, Matrix

log = logging.getLogger("fieldwork")
# Not tuned.
FIRST = 0.12  # seconds that the first picture of a view may take, by what earlier ones took
LONGEST = 0.5  # seconds that any picture may take
SHARE = 0.08  # of the time goes into pictures of views that stand still
MOVING_SHARE = 0.3  # of the time goes into them while views move
FINER = 2  # each picture has so many times the pixels of the one before along a side
GUESS = 6e-5  # seconds a ray takes, before any was measured
LEAST_PIXELS = 256  # of a picture
GPU_RAYS = 1 << 15


class LiveRequest(BaseModel):
    """What one region of Blender shows of a field: the region's size in pixels, the matrix from its clip space (−1 … 1, as
    OpenGL has it) to the scene, and the file for the pictures. `number` is another one for each change."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    version: Literal[1] = 1
    number: int
    width: int = Field(gt=0, le=LARGEST_PICTURE)
    height: int = Field(gt=0, le=LARGEST_PICTURE)
    scene_from_clip: Matrix
    field: FieldItem
    file: Path


@dataclass
class _View:
    """How far the pictures of one request are: the pixels of the last one, and the training step it shows."""

    request: LiveRequest
    pixels: int = 0
    step: int = -1


def view_rays(request: LiveRequest, width: int, height: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Origins and unit directions (N, 3) and lengths (N,) of the rays of a picture of this size, bottom row first, between
    the planes that clip the view; float64, on the host."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    across, up = (x.reshape(-1).double() + 0.5) / width * 2 - 1, (y.reshape(-1).double() + 0.5) / height * 2 - 1
    matrix = torch.tensor(request.scene_from_clip, dtype=torch.float64)
    ends = []
    for depth in (-1.0, 1.0):
        point = torch.stack([across, up, torch.full_like(up, depth), torch.ones_like(up)], 1) @ matrix.T
        ends.append(point[:, :3] / point[:, 3:])
    way = ends[1] - ends[0]
    length = way.norm(dim=1)
    return ends[0], way / length[:, None], length


@torch.no_grad()
def view_picture(
    field: LoadedField, request: LiveRequest, width: int, height: int, check: Callable[[], None] = lambda: None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours (H, W, 4), sRGB with associated alpha, and depths (H, W) in [0, 1] as the region's depth buffer has them, bottom
    row first.

    `check` is called before every tile and may raise to stop. Raises ProjectError: the field is scaled to nothing.
    """
    # Few rays, and packed anew for each picture: not worth the compilation of the fused kernel.
    placed = PlacedField(field, request.field, 0)
    origins, directions, lengths = view_rays(request, width, height)
    clip = torch.linalg.inv(torch.tensor(request.scene_from_clip, dtype=torch.float64))

    @torch.no_grad()
    def tile(rows: torch.Tensor) -> torch.Tensor:
        check()
        o, d = origins[rows], directions[rows]
        begin = torch.zeros(len(rows))
        origin, direction, first, last = (x.float().to(placed.device) for x in (o, d, begin, lengths[rows]))
        seen = placed.rays(origin, direction, first, last)
        # Depths on the host: Apple's GPUs have no float64.
        point = o + d * seen.distance.cpu().double()[:, None]
        place = torch.cat([point, torch.ones_like(point[:, :1])], 1) @ clip.T
        depth = (place[:, 2] / place[:, 3] * 0.5 + 0.5).nan_to_num(1.0).clamp(0, 1).float()
        color = torch.cat([seen.color, seen.opacity[:, None]], 1).cpu()
        solid = color[:, 3] > LEAST
        return torch.cat([color * solid[:, None], torch.where(solid, depth, 1.0)[:, None]], 1)

    size = CPU_RAYS if placed.device.type == "cpu" else GPU_RAYS
    rows = torch.arange(width * height)
    found = torch.cat(run_parallel([partial(tile, part) for part in rows.split(size)], placed.device))
    return found[:, :4].reshape(height, width, 4), found[:, 4].reshape(height, width)


class _Changed(Exception):
    """What is looked at has changed: the picture in the making is of no use."""


class TrainingView:
    """Shows a training to those who ask; `after_step` is called between its steps.

    Pictures take `SHARE` of the time at most, `MOVING_SHARE` while a view moves, and nothing where nobody looks.
    """

    def __init__(self, training: Unfinished, check: Callable[[], None]) -> None:
        self._field = described(training.model, training.project, training.run, training.info, training.scene)
        self._run, self._check = training.run, check
        self._training, self._requests = live.training_file(training.project), live.views_file(training.project)
        self._views: dict[Path, _View] = {}
        self._read: tuple[int, int, int] | None = None  # the state of the requests' file that was read
        self._looking = threading.Lock()
        self._ray_seconds = GUESS
        self._free = {
            True: 0.0,
            False: 0.0,
        }  # from when on there may be another picture: of a view without one, of others
        self._touched = 0.0
        self._steps = 0
        self._told: set[str] = set()

    def begin(self) -> None:
        """Let those who may want to look know."""
        live.remove(self._requests)  # of an earlier training
        live.write(self._training, {"run": self._run, "pid": os.getpid()})

    def end(self) -> None:
        """There is nothing to be seen any more."""
        live.remove(self._training)

    def after_step(self) -> None:
        """Show what is asked for, if it is time for it. Raises what `check` raises."""
        now, self._steps = time.perf_counter(), self._steps + 1
        if now - self._touched > live.TOUCH:
            self._touched = now
            live.touch(self._training)
        self._look()
        for view in sorted(self._views.values(), key=lambda v: (v.pixels, v.step)):
            if time.perf_counter() < self._free[view.pixels == 0] or view.step == self._steps:
                continue
            try:
                self._show(view)
            except _Changed:
                return
            except FieldworkError as error:
                self._views.pop(view.request.file, None)
                if not isinstance(error, InputError):  # files go when nobody looks any more
                    self._tell(str(error))

    def _tell(self, message: str) -> None:
        if message not in self._told:
            self._told.add(message)
            log.warning("The training cannot be shown: %s", message)

    def _look(self) -> None:
        """Read the requests anew where they changed; what is asked for as before keeps its pictures."""
        with self._looking:
            try:
                stat = self._requests.stat()
            except OSError:
                self._views, self._read = {}, None
                return
            if abs(time.time() - stat.st_mtime) > live.STALE:
                self._views = {}
                return
            state = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
            value = live.read(self._requests) if state != self._read else None
            if value is None:
                return
            self._read = state
            try:
                asked = [LiveRequest.model_validate(one) for one in value["views"]]
            except (ValidationError, KeyError, TypeError) as error:
                self._views = {}
                return self._tell(f"{self._requests} is not what Blender writes: {error}")
            before, self._views = self._views, {}
            for one in asked:
                if one.field.run == self._run:
                    known = before.get(one.file)
                    self._views[one.file] = known if known is not None and known.request == one else _View(one)

    def _show(self, view: _View) -> None:
        """Make the next picture of a view. Raises InputError, _Changed."""
        request, first = view.request, view.pixels == 0
        file = PictureFile(request.file)
        most = min(file.pixels, request.width * request.height)
        if first:
            count = max(FIRST / self._ray_seconds, LEAST_PIXELS)
        else:
            # Not coarser than before where rays became dearer, unless by far.
            count = min(view.pixels * FINER**2, max(LONGEST / self._ray_seconds, 0.5 * view.pixels))
        scale = math.sqrt(min(count, most) / (request.width * request.height))
        width, height = max(1, int(request.width * scale)), max(1, int(request.height * scale))

        def check() -> None:
            self._check()
            if not first:
                self._look()
                if self._views.get(request.file) is not view:
                    raise _Changed

        begin = time.perf_counter()
        color, depth = view_picture(self._field, request, width, height, check)
        file.write(request.number, color.numpy(), depth.numpy())
        end = time.perf_counter()
        view.pixels, view.step = width * height, self._steps
        self._ray_seconds = (end - begin) / view.pixels
        # A view that moves must not wait for a fine picture's share of the time, and no view for a moment in which the
        # machine was busy with something else.
        self._free = {
            True: end + min(end - begin, FIRST) * (1 / MOVING_SHARE - 1),
            False: end + min(end - begin, LONGEST) * (1 / SHARE - 1),
        }


@contextmanager
def watched(training: Unfinished, check: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Show a training while the context lasts, between the steps after which its function is called."""
    view = TrainingView(training, check)
    view.begin()
    try:
        yield view.after_step
    finally:
        view.end()
