"""Frames for Blender: rendered one after the other in a thread of their own, beside the jobs, from fields that stay loaded.

`frame {frame, …Shot}` answers {"seconds", "loaded", "manifests"} when the pixels are in the shared file; meanwhile it sends
`progress {job: frame, …}` and `event {job: frame, kind: "pixels", counter}`. `cancel_frame {frame}` stops one, or all. A frame
neither holds its project nor leaves a trace in it.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from ..errors import wrong_value
from ..progress import Reporter
from . import protocol as rpc

if TYPE_CHECKING:
    from ..film.fields import FieldStore

log = logging.getLogger("fieldwork.engine")
PERIOD = 0.1  # seconds between two notifications

Send = Callable[[dict[str, Any]], None]


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
                message = rpc.answer(request.id, _exposed(request.params, reporter, store))
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


def _exposed(params: dict[str, Any], reporter: Reporter, store: FieldStore) -> dict[str, Any]:
    """Render a frame into its shared file."""
    from ..film.exposure import expose
    from ..film.shared_file import SharedFile
    from ..film.shot import Shot, channels_of

    begin = time.perf_counter()
    try:
        shot = Shot.model_validate({name: value for name, value in params.items() if name != "frame"})
    except ValidationError as error:
        clauses = [wrong_value(detail) for detail in error.errors(include_url=False)]
        raise rpc.RpcError(rpc.INVALID_PARAMS, f"frame: {'; '.join(clauses)}.") from error
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
    }
