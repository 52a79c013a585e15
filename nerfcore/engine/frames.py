"""Frames for Blender: rendered one after the other in a thread of their own, beside the jobs, from fields that stay loaded.

`frame {frame, …Shot}` answers {"seconds", "loaded", "manifests", "label_revisions"} when the pixels are in the shared file; meanwhile it sends
`progress {job: frame, …}` and `event {job: frame, kind: "pixels", counter}`. `cancel_frame {frame}` stops one, or all. A frame
neither holds its project nor leaves a trace in it.

`field_things {frame, project, run, file}` writes the texture that tells the things of a baked field apart, and answers what
film/thing_texture.py says of them.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from ..errors import wrong_value
from ..params import RunName
from ..progress import Reporter
from . import protocol as rpc

if TYPE_CHECKING:
    from ..film.fields import FieldStore

log = logging.getLogger("fieldwork.engine")
PERIOD = 0.1  # seconds between two notifications

Send = Callable[[dict[str, Any]], None]
Asked = TypeVar("Asked", bound=BaseModel)


class _FrameReporter(Reporter):
    def __init__(self, name: str, send: Send) -> None:
        super().__init__()
        self._name, self._send, self._stage, self._sent = name, send, "", 0.0

    def stage(self, name: str) -> None:
        self.check()
        self._stage = name
        self._tell(0.0)

    def progress(self, fraction: float, message: str = "") -> None:
        self.check()
        if time.monotonic() - self._sent > PERIOD:
            self._tell(fraction)

    def event(self, kind: str, **data: Any) -> None:
        self._send(rpc.notification("event", job=self._name, kind=kind, **data))

    def _tell(self, fraction: float) -> None:
        self._sent = time.monotonic()
        self._send(rpc.notification("progress", job=self._name, stage=self._stage, fraction=fraction))


class Frames:
    """The frames that Blender asked for."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._queue: queue.Queue[tuple[rpc.Request, _FrameReporter]] = queue.Queue()
        self._reporters: dict[str, _FrameReporter] = {}
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()

    def ask(self, request: rpc.Request) -> None:
        """Put a frame in the queue. Raises RpcError: it has no name, or that of another."""
        name = request.params.get("frame")
        with self._lock:
            if not isinstance(name, str) or not name or name in self._reporters:
                raise rpc.RpcError(rpc.INVALID_PARAMS, "“frame” is a name that no other frame has.")
            self._reporters[name] = reporter = _FrameReporter(name, self._send)
        self._queue.put((request, reporter))
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="frames", daemon=True)
            self._thread.start()

    def cancel(self, name: str | None = None) -> None:
        """Stop a frame, or all of them; one that is done already is no fault."""
        with self._lock:
            for own, reporter in self._reporters.items():
                if name in (None, own):
                    reporter.cancel()

    def _work(self) -> None:
        store = None
        while True:
            request, reporter = self._queue.get()
            try:
                reporter.check()
                if store is None:
                    from ..film.fields import FieldStore  # loads torch, which takes seconds

                    store = FieldStore()
                params = {name: value for name, value in request.params.items() if name != "frame"}
                message = rpc.answer(request.id, METHODS[request.method](params, reporter, store))
            except BaseException as error:
                tail = [line for block in traceback.format_exception(error)[-6:] for line in block.splitlines()]
                wrong = error if isinstance(error, rpc.RpcError) else rpc.as_rpc_error(error, None, tail)
                if wrong.code == rpc.INTERNAL_ERROR:
                    log.exception("a frame failed")
                message = rpc.failure(request.id, wrong)
            with self._lock:
                self._reporters.pop(request.params["frame"], None)
            if request.id is not None:
                self._send(message)


class _ThingsAsked(BaseModel):
    """What is asked for things of a baked field; file: where the texture goes."""

    model_config = ConfigDict(extra="forbid")

    project: Path
    run: RunName = "main"
    file: Path


def _valid(model: type[Asked], params: dict[str, Any], method: str) -> Asked:
    """The parameters of a request. Raises RpcError: one is wrong."""
    try:
        return model.model_validate(params)
    except ValidationError as error:
        clauses = [wrong_value(detail) for detail in error.errors(include_url=False)]
        raise rpc.RpcError(rpc.INVALID_PARAMS, f"{method}: {'; '.join(clauses)}.") from error


def _exposed(params: dict[str, Any], reporter: Reporter, store: FieldStore) -> dict[str, Any]:
    """Render a frame into its shared file."""
    from ..film.exposure import expose
    from ..film.shared_file import SharedFile
    from ..film.shot import Shot, channels_of

    begin, shot = time.perf_counter(), _valid(Shot, params, "frame")
    width, height = shot.size
    file = SharedFile(shot.file, {name: (height, width, channels_of(name)) for name in shot.passes})

    def show(pixels: Any) -> None:
        if "Combined" in shot.passes:
            reporter.event("pixels", counter=file.write({"Combined": pixels}))

    exposure = expose(shot, store, reporter, show)
    file.write(exposure.passes)
    return {
        "seconds": round(time.perf_counter() - begin, 3),
        "loaded": store.loaded,
        "manifests": exposure.manifests,
        "label_revisions": exposure.label_revisions,
    }


def _things(params: dict[str, Any], reporter: Reporter, store: FieldStore) -> dict[str, Any]:
    """Write the texture of a field's things."""
    from ..film.shot import FieldItem
    from ..film.thing_texture import write_thing_texture

    asked = _valid(_ThingsAsked, params, "field_things")
    here = [[float(row == column) for column in range(4)] for row in range(4)]
    item = FieldItem(name=asked.run, project=asked.project, run=asked.run, baked=True, scene_from_capture=here)
    return write_thing_texture(store.field(item, reporter), asked.file)


METHODS = {"frame": _exposed, "field_things": _things}
