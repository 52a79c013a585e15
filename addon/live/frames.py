"""The engine that renders frames for Blender: a process of its own beside that of the jobs, so that a training goes on.

`render()` of a render engine is called in a thread of Blender's; the link to this engine is used by one frame at a time,
whichever thread asks. No bpy here but where it says so.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import mmap
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import EngineError

if TYPE_CHECKING:
    from ..engine.link import Link

HEADER = 64  # as nerfcore/film/shared_file.py writes it
POLL = 0.05  # seconds between two looks at the engine
PATIENCE = 10.0  # seconds that a cancelled frame may take before its engine is ended
IN_MEMORY = "/dev/shm"  # where files never touch a disk, if there is such a place
ROOM = 1 << 30  # bytes that are free there, else the disk is better: containers often have 64 MB
PREFIX = "fieldwork-frames-"


class Sizes(NamedTuple):
    """Width and height of a frame, and the channels of its passes by name."""

    width: int
    height: int
    channels: dict[str, int]


class Frame(NamedTuple):
    """Pixels (H, W, channels) float32 of each pass, bottom row first, and what the engine says of them."""

    passes: dict[str, np.ndarray]
    facts: dict[str, Any]


def folder_for_frames() -> Path:
    """A new folder for this process's frames, in memory where that can be; folders of dead processes are removed."""
    from ...nerfcore.engine.status import process_exists  # not at the top: enabling the extension must be quick

    memory = os.path.isdir(IN_MEMORY) and os.access(IN_MEMORY, os.W_OK) and shutil.disk_usage(IN_MEMORY).free > ROOM
    place = Path(IN_MEMORY if memory else tempfile.gettempdir())
    for other in place.glob(f"{PREFIX}*"):
        number = other.name.removeprefix(PREFIX).split("-")[0]
        if number.isdecimal() and not process_exists(int(number)):
            _remove(other)
    return Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-", dir=place))


def make_room(file: Any, size: int) -> None:
    """Give an open file its size. Raises OSError: there is no room; of a file that is only said to be so large the system would
    end the process that writes it."""
    file.truncate(size)
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):  # else the file system only cannot tell
            file.truncate(0)
            raise


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


class FrameEngine:
    """The engine of frames. `open_link` gives a link to an engine that is started by the first request."""

    def __init__(self, open_link: Callable[[], Link]) -> None:
        self._open_link = open_link
        self._lock = threading.Lock()
        self._link: Link | None = None
        self._folder: Path | None = None
        self._numbers = itertools.count(1)
        self._left: dict[str, float] = {}  # frames that were cancelled and not answered yet, since when

    @property
    def process(self) -> Any:
        """The engine's process; None when there is none."""
        return self._link.process if self._link is not None else None

    @property
    def idle_seconds(self) -> float:
        """How long ago the engine was last used; 0 where there is none or a frame is rendered."""
        if self._link is None or self._lock.locked():
            return 0.0
        return time.monotonic() - self._link.last_used

    def folder(self) -> Path:
        """Where files for the engine may be put; removed by `close`."""
        if self._folder is None:
            self._folder = folder_for_frames()
        return self._folder

    def render(
        self,
        shot: dict[str, Any],
        sizes: Sizes,
        stop: Callable[[], bool],
        tell: Callable[[str, float], None],
        show: Callable[[np.ndarray], None] | None = None,
    ) -> Frame:
        """Render a frame and wait for it.

        Args:
            shot: as nerfcore/film/shot.py describes it, without the file.
            stop: asked many times a second; true ends the wait at once, and the frame soon after.
            tell: is given the stage and its share that is done.
            show: is given the colours (H, W, 4) so far.
        Raises:
            EngineError: it cannot be rendered, it was stopped ("cancelled"), or the engine died ("died").
        """
        while not self._lock.acquire(timeout=POLL):
            if stop():
                raise EngineError("cancelled", "Cancelled.")
        try:
            return self._render(shot, sizes, stop, tell, show)
        finally:
            self._lock.release()

    def _render(
        self,
        shot: dict[str, Any],
        sizes: Sizes,
        stop: Callable[[], bool],
        tell: Callable[[str, float], None],
        show: Callable[[np.ndarray], None] | None,
    ) -> Frame:
        link, name = self._usable_link(), f"frame-{os.getpid()}-{next(self._numbers)}"
        with _SharedPixels(self.folder() / name, sizes) as pixels:
            outcome: list[tuple[dict[str, Any] | None, EngineError | None]] = []

            def heard(kind: str, data: dict[str, Any]) -> None:
                if data.get("job") != name or pixels.closed:  # the engine had said it before it heard of the cancelling
                    return
                if kind == "progress":
                    tell(str(data.get("stage") or ""), float(data.get("fraction") or 0.0))
                elif kind == "event" and show is not None:
                    colors = pixels.whole("Combined")
                    if colors is not None:
                        show(colors)

            def ended(result: dict[str, Any] | None, error: EngineError | None) -> None:
                self._left.pop(name, None)
                outcome.append((result, error))

            link.request("frame", {**shot, "frame": name, "file": str(pixels.path)}, ended, heard)
            while not outcome:
                if stop():
                    self._left[name] = time.monotonic()
                    if link.alive:
                        link.request("cancel_frame", {"frame": name})
                    raise EngineError("cancelled", "Cancelled.")
                link.pump(POLL)
                if link.process is None and not outcome:  # nobody will answer
                    raise EngineError("stopped", "The engine was stopped.", "Render again.")
            result, error = outcome[0]
            if error is not None:
                raise error
            return Frame({part: pixels.copy(part) for part in sizes.channels}, result or {})

    def ask(
        self, method: str, params: dict[str, Any], ended: Callable[[dict[str, Any] | None, EngineError | None], None]
    ) -> bool:
        """Send a request that `pump`, or a frame that is waited for, hands the answer of to `ended`; it is never called when the
        engine is ended before. False: a frame is being rendered; ask again. Raises EngineError: there is no engine."""
        if not self._lock.acquire(blocking=False):
            return False
        try:
            name = f"{method}-{os.getpid()}-{next(self._numbers)}"
            self._usable_link().request(method, {**params, "frame": name}, ended)
        finally:
            self._lock.release()
        return True

    def pump(self) -> None:
        """Hand out what the engine said; a frame that is being rendered does so itself."""
        if self._link is not None and self._lock.acquire(blocking=False):
            try:
                self._link.pump()
            finally:
                self._lock.release()

    def _usable_link(self) -> Link:
        if self._link is not None:
            self._link.pump()
            now = time.monotonic()
            if any(now - since > PATIENCE for since in self._left.values()):
                self._end(at_once=True)  # it does not come back from what it was to stop
        if self._link is None or not self._link.alive:
            self._left.clear()
            self._link = self._open_link()
        return self._link

    def rest(self) -> None:
        """End the engine until the next frame. Its folder stays: views of a training have files there."""
        self._end(at_once=False)

    def close(self) -> None:
        """End the engine and remove its files. A frame that is being rendered is stopped."""
        self._end(at_once=False)
        if self._folder is not None:
            _remove(self._folder)
            self._folder = None

    def _end(self, at_once: bool) -> None:
        link, self._link = self._link, None
        if link is None:
            return
        if at_once and link.process is not None:
            link.process.kill()
        link.close(timeout=2.0)


class _SharedPixels:
    """The file through which a frame comes; it is removed in the end."""

    def __init__(self, path: Path, sizes: Sizes) -> None:
        self.path, self._sizes = path, sizes
        self._file: Any = None
        self._map: mmap.mmap | None = None

    def __enter__(self) -> _SharedPixels:
        count = sum(self._sizes.channels.values()) * self._sizes.width * self._sizes.height
        try:
            self._file = open(self.path, "w+b")
            make_room(self._file, HEADER + 4 * count)
            self._map = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            self.__exit__()
            raise EngineError(
                "disk", f"There is no room for a frame in {self.path.parent}: {error.strerror}.", "Free some memory."
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._map is not None:
            self._map.close()
        if self._file is not None:
            self._file.close()
        with contextlib.suppress(OSError):  # Windows keeps it while the engine looks at it; the folder goes in the end
            self.path.unlink()

    @property
    def closed(self) -> bool:
        return self._map is None or self._map.closed

    def _counter(self) -> int:
        assert self._map is not None
        return int.from_bytes(self._map[:8], "little")

    def copy(self, part: str) -> np.ndarray:
        """A pass as it is in the file."""
        assert self._map is not None
        width, height, channels = self._sizes
        offset = HEADER
        for name, count in channels.items():
            size = 4 * width * height * count
            if name == part:
                return np.frombuffer(self._map[offset : offset + size], np.float32).reshape(height, width, count)
            offset += size
        raise KeyError(part)

    def whole(self, part: str) -> np.ndarray | None:
        """The same, None where it is being written."""
        if part not in self._sizes.channels:
            return None
        before = self._counter()
        pixels = self.copy(part)
        return pixels if before % 2 == 0 and self._counter() == before else None
