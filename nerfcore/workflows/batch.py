"""The verb `batch`: many captures, each with a project of its own, one after the other or on a cluster."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ..errors import Cancelled, FieldworkError, InputError, SettingError
from ..files import write_json
from ..params import BatchParams, NewParams, ReconstructParams
from ..progress import Reporter
from ..project.fingerprints import Fingerprint
from ..project.lock import lockable, project_lock
from ..project.store import is_project
from . import campaign
from .captures import Capture, read_list
from .forecast import forecast
from .reconstruct import reconstruct, stage_params

log = logging.getLogger("fieldwork.batch")


class BatchError(FieldworkError):
    """Some of the captures failed. `result` is what the verb would have returned."""

    code = "batch"


def batch(params: BatchParams, report: Reporter) -> dict[str, Any]:
    """Reconstruct every capture of a list.

    A capture that fails does not stop the others: it is tried again `retries` times, going on from what is on disk,
    then noted as failed. The report file is written after each; a second call with the same list does only what is not
    done, and what has other settings, photos, labels, masks or classes than before.

    Returns:
        {"done": [projects], "failed": [{"project", "error", "hint"}], "skipped": how many were done before,
        "seconds", "report": path}; with `cluster` also "page": path; with `dry_run` what `forecast` returns, and "skipped"
    Raises:
        InputError: the list cannot be read. SettingError: a row of it is wrong.
        ClusterError: the cluster cannot be reached. BatchError: at the end, when captures failed; its `result` is as
            above.
    """
    begin = time.monotonic()
    captures = read_list(params.list)
    path = params.report or params.list.with_name(f"{params.list.stem}-report.json")
    before = _read_report(path)
    entries: dict[str, dict[str, Any]] = {}
    inputs = {str(capture.params.out): inputs_of(capture.params) for capture in captures}
    todo = []
    for capture in captures:
        key = str(capture.params.out)
        known = before.get(key, {})
        same = known.get("settings") == capture.params.model_dump(mode="json")
        same &= None in (inputs[key], known.get("inputs")) or inputs[key] == known["inputs"]
        if known.get("state") == "done" and same and is_project(capture.params.out):
            entries[key] = known
        else:
            todo.append(capture)
    skipped = len(entries)
    if params.dry_run:
        if params.cluster is not None:
            campaign.Link(params.cluster, params.wheel)  # says what is wrong with them
        return {**forecast(params, todo, entries, report), "skipped": skipped}

    def note(key: str, entry: dict[str, Any], write: bool = True) -> None:
        entries[key] = {"inputs": inputs[key], **entry}
        if write:
            write_json(path, {"captures": {**before, **entries}})

    def forget(begun: list[Capture]) -> None:
        """Stopped in the middle, a project holds something else than what was noted of it."""
        keys = [str(capture.params.out) for capture in begun]
        done = [key for key in keys if before.get(key, {}).get("state") == "done"]
        for key in done:
            del before[key]
        if done:
            write_json(path, {"captures": {**before, **entries}})

    if params.cluster is not None:
        forget(todo)
        campaign.run(params, captures, todo, entries, note, report)
    else:
        for number, one in enumerate(todo, skipped + 1):
            forget([one])
            capture = one.params
            inner = _Named(report, f"{capture.out.name} ({number} of {len(captures)})")
            settings = capture.model_dump(mode="json")
            note(str(capture.out), {"settings": settings, **_attempts(capture, params.retries, inner)})
    ordered = {str(capture.params.out): entries[str(capture.params.out)] for capture in captures}
    done = [key for key, entry in ordered.items() if entry["state"] == "done"]
    failed = [
        {"project": key, "error": entry["error"], "hint": entry["hint"]}
        for key, entry in ordered.items()
        if entry["state"] == "failed"
    ]
    write_json(path, {"captures": ordered})
    seconds = round(time.monotonic() - begin, 1)
    result = {"done": done, "failed": failed, "skipped": skipped, "seconds": seconds, "report": str(path)}
    if params.cluster is not None:
        result["page"] = str(campaign.folder_of(params.list) / campaign.PAGE)
    if failed:
        first = f"{Path(failed[0]['project']).name}: {failed[0]['error']}"
        raise BatchError(
            f"{len(failed)} of {len(captures)} captures failed. {first}",
            f"All reasons are in {path}. Run it again to try those once more.",
            result,
        )
    return result


def inputs_of(params: ReconstructParams) -> Fingerprint | None:
    """What there is of a capture's photos, labels, masks and classes; None where it cannot be read, which its turn will tell."""
    from ..capture.ingest import ingest_inputs  # with its libraries, half a second

    values = stage_params(params, "new")
    assert isinstance(values, NewParams)
    try:
        return ingest_inputs(values)
    except (FieldworkError, OSError):
        return None


def _read_report(path: Path) -> dict[str, dict[str, Any]]:
    """What an earlier call wrote; nothing when there was none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))["captures"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _attempts(capture: ReconstructParams, retries: int, report: Reporter) -> dict[str, Any]:
    """Reconstruct one capture, again when it fails: its entry in the report."""
    begin, attempt = time.monotonic(), 0
    while True:
        attempt += 1
        try:
            with project_lock(lockable(capture), "batch"):
                result = reconstruct(capture, report)
            entry = {"state": "done", "stages": result["stages"], "result": result}
            break
        except Cancelled:
            raise
        except Exception as error:  # noqa: BLE001 - whatever it is, the other captures must have their turn
            log.warning("%s failed", capture.out, exc_info=error)
            known = isinstance(error, FieldworkError)
            message = error.message if known else f"{type(error).__name__}: {error}"
            entry = {"state": "failed", "error": message, "hint": error.hint if known else ""}
            # Other photos or settings are the user's to give.
            if isinstance(error, (InputError, SettingError)) or attempt > retries:
                break
            report.warn(f"{message} It is tried again.")
    return {**entry, "attempts": attempt, "seconds": round(time.monotonic() - begin, 1)}


class _Named(Reporter):
    """Passes everything on under the name of a capture."""

    def __init__(self, outer: Reporter, name: str) -> None:
        super().__init__()
        self.outer, self.name = outer, name

    def stage(self, name: str) -> None:
        self.outer.stage(f"{self.name}: {name}")

    def progress(self, fraction: float, message: str = "") -> None:
        self.outer.progress(fraction, message)

    def event(self, kind: str, **data: Any) -> None:
        self.outer.event(kind, **data)

    def watching(self, training: Any) -> AbstractContextManager[Callable[[], None]]:
        return self.outer.watching(training)

    def note(self, message: str) -> None:
        self.outer.note(f"{self.name}: {message}")

    def warn(self, message: str) -> None:
        self.warnings.append(message)
        self.outer.warn(f"{self.name}: {message}")

    def cancel(self) -> None:
        self.outer.cancel()

    @property
    def cancelled(self) -> bool:
        return self.outer.cancelled

    def check(self) -> None:
        self.outer.check()
