"""The verb `batch`: many captures, one after the other, each with a project of its own."""

from __future__ import annotations

import csv
import json
import logging
import time
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ..errors import Cancelled, FieldworkError, InputError, SettingError, wrong_value
from ..files import write_json
from ..params import BatchParams, ReconstructParams
from ..progress import Reporter
from ..project.lock import lockable, project_lock
from ..project.store import is_project
from .reconstruct import reconstruct

log = logging.getLogger("fieldwork.batch")
PATHS = ("photos", "out", "labels", "masks", "classes", "blend", "report", "renders")


class BatchError(FieldworkError):
    """Some of the captures failed. `result` is what the verb would have returned."""

    code = "batch"


def batch(params: BatchParams, report: Reporter) -> dict[str, Any]:
    """Reconstruct every capture of a list.

    A capture that fails does not stop the others: it is tried again `retries` times, going on from what is on disk,
    then noted as failed. The report file is written after each; a second call with the same list does only what is not
    done, and what is listed with other settings than before.

    Returns:
        {"done": [projects], "failed": [{"project", "error", "hint"}], "skipped": how many were done before,
        "seconds", "report": path}
    Raises:
        InputError: the list cannot be read. SettingError: a row of it is wrong.
        BatchError: at the end, when captures failed; its `result` is as above.
    """
    begin = time.monotonic()
    captures = read_list(params.list)
    path = params.report or params.list.with_name(f"{params.list.stem}-report.json")
    before = _read_report(path)
    entries: dict[str, dict[str, Any]] = {}
    skipped = 0
    for number, capture in enumerate(captures, 1):
        key = str(capture.out)
        settings = capture.model_dump(mode="json")
        known = before.get(key, {})
        if known.get("state") == "done" and known.get("settings") == settings and is_project(capture.out):
            entries[key] = known
            skipped += 1
            continue
        inner = _Named(report, f"{capture.out.name} ({number} of {len(captures)})")
        entries[key] = {"settings": settings, **_attempts(capture, params.retries, inner)}
        write_json(path, {"captures": {**before, **entries}})
    done = [key for key, entry in entries.items() if entry["state"] == "done"]
    failed = [
        {"project": key, "error": entry["error"], "hint": entry["hint"]}
        for key, entry in entries.items()
        if entry["state"] == "failed"
    ]
    write_json(path, {"captures": entries})
    seconds = round(time.monotonic() - begin, 1)
    result = {"done": done, "failed": failed, "skipped": skipped, "seconds": seconds, "report": str(path)}
    if failed:
        first = f"{Path(failed[0]['project']).name}: {failed[0]['error']}"
        raise BatchError(
            f"{len(failed)} of {len(captures)} captures failed. {first}",
            f"All reasons are in {path}. Run it again to try those once more.",
            result,
        )
    return result


def read_list(path: Path) -> list[ReconstructParams]:
    """The captures of a .csv with a header, or of a .json with an array of objects: settings of reconstruct by name.

    `photos` must be there. Relative paths start at the list's folder; without `out` a project is made beside the list,
    named after the photos. In a .csv, empty cells are left out and `set` holds name=value words.

    Raises:
        InputError: it cannot be read, or holds no captures.
        SettingError: a row names an unknown setting or has a wrong value, or two rows have the same project.
    """
    captures = []
    for number, row in enumerate(_rows(path), 1):
        values = {key: value for key, value in row.items() if value not in (None, "")}
        for name in PATHS:
            if name in values:
                values[name] = path.absolute().parent / str(values[name])
        if "photos" in values:
            values.setdefault("out", path.absolute().parent / _name(values["photos"]))
        if isinstance(values.get("set"), str):
            values["set"] = dict(word.partition("=")[::2] for word in values["set"].split())
        try:
            captures.append(ReconstructParams.model_validate(values))
        except ValidationError as error:
            raise SettingError(
                f"{path}, capture {number}: {wrong_value(error.errors()[0])}.",
                "Columns are named like the options of `fieldwork reconstruct`.",
            ) from error
    if not captures:
        raise InputError(f"{path} lists no captures.", "Write one row for each, with its folder under “photos”.")
    outs = [capture.out for capture in captures]
    twice = next((out for out in outs if outs.count(out) > 1), None)
    if twice is not None:
        raise SettingError(f"{path} has two captures with the project {twice}.", "Give each another “out”.")
    return captures


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}.", "Give a .csv or .json file.") from error
    if path.suffix.lower() == ".csv":
        rows = list(csv.DictReader(text.splitlines()))
        if any(None in row for row in rows):
            raise InputError(f"{path} has a row with more cells than its first line.", "Give each column a name.")
        return rows
    if path.suffix.lower() != ".json":
        raise InputError(f"{path} is neither a .csv nor a .json file.", "Write the list as one of these.")
    try:
        value = json.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is damaged: {error}.", "Write an array of objects.") from error
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        raise InputError(f"{path} holds no array of objects.", 'Write [{"photos": "folder"}, …].')
    return value


def _name(photos: Path) -> str:
    """Name of the project of a folder of photos or a video."""
    whole = photos.parent if photos.name.lower() in ("photos", "images", "rgb") else photos
    return f"{whole.stem if whole.suffix else whole.name}_fieldwork"


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
