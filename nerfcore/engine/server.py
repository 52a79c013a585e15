"""The engine: reads requests from stdin, runs one verb at a time in a worker thread, answers on stdout.

Requests: every verb of `verbs.py` (its parameters, and two of the engine's own: `job`, an id the caller chooses,
and `detach`, true when the job is to outlive the caller); `cancel {job}`, `detach {job}`, `ping`, `status`,
`shutdown`; `frame`, `field_things` and `cancel_frame` for pictures (frames.py). `classes` and `region` are no jobs: they are done at once, in order, also while a job works on the same
project. Notifications: `progress {job, stage, fraction, message, eta_s}`, `event {job, kind, …}`,
`log {level, text}`.

When stdin ends the caller is gone: running jobs are cancelled (they leave a checkpoint) unless they were detached,
then the process ends.
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, BinaryIO

import psutil

from .. import __version__
from ..errors import Cancelled, FieldworkError
from ..files import name_problem
from ..kernels.host import give_back_memory, give_way
from ..progress import Reporter
from ..project.lock import project_lock
from ..verbs import VERBS, load_verb, run_verb
from . import protocol as rpc
from .frames import METHODS, Frames
from .jobs import Job

log = logging.getLogger("fieldwork.engine")

GRACE = 10.0  # seconds a cancelled job has to come to an end before the process is ended under it
TICK = 0.5  # seconds between two looks of the clock thread


class _Stop(BaseException):
    """Raised by a signal handler inside the reading loop, where a request that is being answered must not catch it."""


class Server:
    def __init__(self, requests: BinaryIO, answers: BinaryIO) -> None:
        self._requests, self._answers = requests, answers
        self._write_lock = threading.Lock()
        self._jobs: dict[str, Job] = {}  # queued and running
        self._jobs_lock = threading.RLock()
        self._queue: queue.Queue[Job | None] = queue.Queue()
        self._edits: queue.Queue[rpc.Request | None] = queue.Queue()
        self._frames = Frames(self.send)
        self._count = 0
        self._connected = True

    def serve(self) -> int:
        """Answer requests until stdin ends or `shutdown`. Returns the exit status."""
        worker = threading.Thread(target=self._work, name="worker", daemon=True)
        worker.start()
        editor = threading.Thread(target=self._edit, name="editor", daemon=True)
        editor.start()
        threading.Thread(target=self._clock, name="clock", daemon=True).start()
        told_to_stop = False
        try:
            for line in self._requests:
                if line.strip() and not self._handle(line):
                    break
        except _Stop:
            told_to_stop = True
        self._edits.put(None)
        editor.join(GRACE)
        self._close(worker, told_to_stop)
        return 0

    # Reading

    def _handle(self, line: bytes) -> bool:
        """Answer one line; false after `shutdown`."""
        request = None
        try:
            request = rpc.parse_request(line)
            if request.method in VERBS and VERBS[request.method].immediate:
                self._edits.put(request)
                return True
            if request.method in VERBS:
                self._enqueue(request)
                return True
            if request.method in METHODS:
                self._frames.ask(request)
                return True
            method = getattr(self, f"_do_{request.method}", None)
            if method is None:
                methods = [*VERBS, "cancel", "detach", *METHODS, "cancel_frame", "ping", "status", "shutdown"]
                raise rpc.RpcError(
                    rpc.METHOD_NOT_FOUND, f"There is no method “{request.method}”. Methods: {', '.join(methods)}."
                )
            result = method(request.params)
            if request.id is not None:
                self.send(rpc.answer(request.id, result))
            return request.method != "shutdown"
        except rpc.RpcError as error:
            self.send(rpc.failure(request.id if request else error.request, error))
            return True
        except Exception as error:
            log.exception("a request failed")
            tail = traceback.format_exception(error)[-6:]
            self.send(rpc.failure(request.id if request else None, rpc.as_rpc_error(error, None, tail)))
            return True

    def _enqueue(self, request: rpc.Request) -> None:
        values = dict(request.params)
        name, detach = values.pop("job", None), values.pop("detach", False)
        if not isinstance(detach, bool):
            raise rpc.RpcError(rpc.INVALID_PARAMS, "“detach” is true or false.")
        wrong = name_problem(name) if isinstance(name, str) else name is not None and "it is text"
        if wrong:
            raise rpc.RpcError(rpc.INVALID_PARAMS, f"“job”: {wrong}.")
        params = rpc.parse_params(request.method, values)
        with self._jobs_lock:
            self._count += 1
            name = (
                name
                or f"{request.method.replace(' ', '-')}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}-{self._count}"
            )
            if name in self._jobs:
                raise rpc.RpcError(rpc.INVALID_PARAMS, f"There is a job “{name}” already.")
            job = Job(name, request.method, params, request.id, self.send, detach)
            self._jobs[name] = job
        job.write()
        self._queue.put(job)

    def _do_ping(self, params: dict[str, Any]) -> dict[str, Any]:
        return {"pid": os.getpid(), "version": __version__, "protocol": rpc.VERSION}

    def _do_status(self, params: dict[str, Any]) -> dict[str, Any]:
        memory = psutil.Process().memory_info().rss / 2**20
        with self._jobs_lock:
            jobs = [vars(j.status) | {"detached": j.detached} for j in self._jobs.values() if not j.status.finished]
        return {**self._do_ping({}), "memory_mb": round(memory), "gpu_memory_mb": gpu_memory_mb(), "jobs": jobs}

    def _do_cancel(self, params: dict[str, Any]) -> dict[str, Any]:
        for job in self._named(params):
            self._cancel(job)
        return {}

    def _do_detach(self, params: dict[str, Any]) -> dict[str, Any]:
        for job in self._named(params):
            job.detached = True
        return {}

    def _do_cancel_frame(self, params: dict[str, Any]) -> dict[str, Any]:
        self._frames.cancel(params.get("frame"))
        return {}

    def _do_shutdown(self, params: dict[str, Any]) -> dict[str, Any]:
        return {}

    def _named(self, params: dict[str, Any]) -> list[Job]:
        """The job a request names, all jobs when it names none."""
        with self._jobs_lock:
            name = params.get("job")
            if name is None:
                return list(self._jobs.values())
            if name not in self._jobs:
                raise rpc.RpcError(rpc.INVALID_PARAMS, f"There is no running or queued job “{name}”.")
            return [self._jobs[name]]

    def _cancel(self, job: Job) -> None:
        """Let a running job come to its end; one that waits has none to come to, and is answered at once."""
        with self._jobs_lock:
            job.cancel()
            waits = job.status.state == "queued"
        if waits:
            self._fail(job, Cancelled())

    # Writing

    def send(self, message: dict[str, Any]) -> None:
        line = rpc.encode(message)
        with self._write_lock:
            if not self._connected:
                return
            try:
                self._answers.write(line)
                self._answers.flush()
            except (OSError, ValueError):
                # The caller is gone; the end of stdin will tell what becomes of the jobs.
                self._connected = False

    # Working

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            self._run(job)
            give_back_memory()

    def _edit(self) -> None:
        """Verbs that take no time, in the order they came, beside the running job."""
        while (request := self._edits.get()) is not None:
            try:
                params = rpc.parse_params(request.method, request.params)
                message = rpc.answer(request.id, run_verb(request.method, params, Reporter()))
            except BaseException as error:  # noqa: BLE001 - everything a verb raises is answered
                tail = traceback.format_exception(error)[-6:]
                wrong = error if isinstance(error, rpc.RpcError) else rpc.as_rpc_error(error, None, tail)
                message = rpc.failure(request.id, wrong)
            if request.id is not None:
                self.send(message)

    def _run(self, job: Job) -> None:
        try:
            job.check()
            with project_lock(job.lockable, job.verb):
                with self._jobs_lock:
                    job.check()  # from here on a cancel finds it running
                    job.begin()
                with _logged(job):
                    _loaded(job)
                    self._answer(job, "done", result=run_verb(job.verb, job.params, job))
        except BaseException as error:  # noqa: BLE001 - everything a job raises is answered
            self._fail(job, error)
        finally:
            with self._jobs_lock:
                self._jobs.pop(job.status.id, None)

    def _fail(self, job: Job, error: BaseException) -> None:
        tail = traceback.format_exception(error)[-6:]
        lines = [line for block in tail for line in block.rstrip().splitlines()]
        answer = rpc.as_rpc_error(error, job.status.log or None, lines)
        state = "cancelled" if answer.code == rpc.CANCELLED else "failed"
        self._answer(job, state, error=answer)

    def _answer(self, job: Job, state: str, result: Any = None, error: rpc.RpcError | None = None) -> None:
        """Write the last state of the job and answer its request, once."""
        with self._jobs_lock:
            if job.answered:
                return
            job.answered = True
        if error is None:
            job.end(state, result=result)
            message = rpc.answer(job.request, result)
        else:
            job.end(state, error=error.data or {"code": state, "message": error.message})
            message = rpc.failure(job.request, error)
        if job.request is not None:
            self.send(message)

    def _clock(self) -> None:
        while True:
            time.sleep(TICK)
            with self._jobs_lock:
                jobs = [job for job in self._jobs.values() if not job.status.finished]
            for job in jobs:
                job.heartbeat()
                if job.cancelled and job.status.state == "queued":
                    self._cancel(job)
                since = job.cancelled_at
                if since is not None and job.status.state == "running" and time.monotonic() - since > GRACE:
                    self._end_hard(job)

    def _end_hard(self, job: Job) -> None:
        """The last resort against a native call that does not come back: what is on disk is whole, so leave."""
        log.error("%s did not stop within %.0f s; the engine ends.", job.verb, GRACE)
        self._answer(job, "cancelled", error=rpc.RpcError(rpc.CANCELLED, "Cancelled; the engine was ended."))
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                child.kill()
        os._exit(3)

    def _close(self, worker: threading.Thread, everything: bool) -> None:
        """The caller is gone: cancel what was not detached (or `everything`), wait for the rest."""
        with self._jobs_lock:
            jobs = list(self._jobs.values())
        for job in jobs:
            if everything or not job.detached:
                self._cancel(job)
        self._queue.put(None)
        # The clock thread ends the process if a cancelled job does not stop.
        while worker.is_alive():
            try:
                worker.join(0.2)
            except _Stop:
                for job in jobs:
                    self._cancel(job)


def gpu_memory_mb() -> int | None:
    """Memory torch holds on the GPU; None where torch is not loaded or has no GPU."""
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(torch, "cuda") or not torch.cuda.is_initialized():
        return None
    return round(torch.cuda.memory_reserved() / 2**20)


def _loaded(job: Job) -> None:
    """Load the libraries of the job's verb in a thread of their own, which a cancel need not wait for."""

    def load() -> None:
        with suppress(Exception):  # the verb itself tells of it
            load_verb(job.verb)

    loading = threading.Thread(target=load, name="loading", daemon=True)
    loading.start()
    while loading.is_alive():
        job.check()
        loading.join(0.05)


@contextmanager
def _logged(job: Job) -> Iterator[None]:
    """Let everything that is logged while the job runs, and how it ends, go to PROJECT/jobs/<verb>.log as well."""
    path = job.log_path
    if path is None or job.lockable is None:
        yield
        return
    handler = logging.FileHandler(path, mode="w", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(handler)
    try:
        yield
    except (FieldworkError, Cancelled) as error:
        log.info("%s ended: %r", job.verb, error)
        raise
    except BaseException:
        log.exception("%s failed", job.verb)
        raise
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()


class _Forward(logging.Handler):
    """Sends Fieldwork's own log lines to the caller."""

    def __init__(self, server: Server) -> None:
        super().__init__(logging.INFO)
        self._server = server

    def emit(self, record: logging.LogRecord) -> None:
        self._server.send(rpc.notification("log", level=record.levelname.lower(), text=record.getMessage()))


def claim_stdio() -> tuple[BinaryIO, BinaryIO]:
    """Take stdin and stdout for the protocol alone.

    Descriptor 1 then leads to stderr and descriptor 0 to nothing, so that neither a native library that prints nor
    a child process that reads can disturb the messages.
    """
    requests, answers = os.dup(0), os.dup(1)
    if sys.platform == "win32":
        import msvcrt

        for descriptor in (requests, answers):
            msvcrt.setmode(descriptor, os.O_BINARY)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    sys.stdout.flush()
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return os.fdopen(requests, "rb"), os.fdopen(answers, "wb")


def main() -> int:
    """Entry point of `python -m nerfcore serve`."""
    requests, answers = claim_stdio()
    give_way()
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    server = Server(requests, answers)
    logging.getLogger("fieldwork").addHandler(_Forward(server))

    def stop(signum: int, frame: Any) -> None:
        raise _Stop

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    code = server.serve()
    # Threads of native libraries must not hold up the end: everything is on disk.
    logging.shutdown()
    sys.stderr.flush()
    os._exit(code)
