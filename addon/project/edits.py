"""Edits of a project on their way to the engine, which alone writes project.json.

What the user sees is what he set: until the engine has answered, an edit stands over what the project's file says. An
edit that the engine could not take is kept and sent again.

Kept outside the scene: undo does not take back what is under way, it makes a new edit.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import EngineError
from ..text import t
from .snapshot import has_project

RETRY = 10.0  # seconds until an edit that was not taken, or not answered, is sent again
REFUSED = ("setting", "input", "refused")  # kinds of errors that the same values would meet again

Answer = Callable[[dict[str, Any] | None, EngineError | None], None]
Params = Callable[[Path, dict[Any, Any]], dict[str, Any]]
Ask = Callable[[str, dict[str, Any], Answer], object]  # verb, parameters, what takes the answer; raises EngineError


class Edit:
    """The newest edit of one kind of one project.

    `verb`: "classes" or "region". `values`: what the user wants; `params`, called when it is sent, makes the verb's
    parameters of them.
    """

    def __init__(self, folder: Path, verb: str, values: dict[Any, Any], params: Params) -> None:
        self.folder, self.verb, self.values, self.params = folder, verb, values, params
        self.sent: dict[Any, Any] | None = None  # the values that the engine has and did not answer yet
        self.due = 0.0  # when to send (again), by the monotonic clock
        self.error: EngineError | None = None


_pending: dict[tuple[Path, str], Edit] = {}


def put(folder: Path, verb: str, values: dict[Any, Any], params: Params) -> None:
    """Let an edit wait for `send`; it takes the place of an earlier one of its kind."""
    edit = _pending.get((folder, verb))
    if edit is None:
        _pending[folder, verb] = Edit(folder, verb, values, params)
    else:
        edit.values = values
        if edit.sent is None:
            edit.due = 0.0


def pending(folder: Path | None, verb: str) -> dict[Any, Any] | None:
    """The values of an edit that the engine has not taken yet."""
    edit = _pending.get((folder, verb)) if folder else None
    return edit.values if edit else None


def failed() -> list[Edit]:
    """The edits that the engine could not take."""
    return [edit for edit in _pending.values() if edit.error is not None]


def waiting() -> bool:
    """Whether there is an edit that the engine has not taken."""
    return bool(_pending)


def send(ask: Ask, at_once: bool = False) -> None:
    """Hand over the edits that are due; `at_once`: also those that were refused a moment ago."""
    now = time.monotonic()
    for edit in list(_pending.values()):
        if now < edit.due and not (at_once and edit.sent is None):
            continue
        edit.sent, edit.due = edit.values, now + RETRY
        if not has_project(edit.folder):
            _answered(edit, edit.sent, _gone(edit.folder))
            continue
        try:
            params = {"project": str(edit.folder), **edit.params(edit.folder, edit.sent)}
            ask(edit.verb, params, _taker(edit, edit.sent))
        except EngineError as error:
            _answered(edit, edit.sent, error)


def discard() -> None:
    """Forget the edits that could not be taken."""
    for key, edit in list(_pending.items()):
        if edit.error is not None:
            del _pending[key]


def move(old: Path, new: Path) -> None:
    """The project's folder is another one now."""
    for folder, verb in [key for key in _pending if key[0] == old]:
        edit = _pending.pop((folder, verb))
        _pending[new, verb] = Edit(new, verb, edit.values, edit.params)


def clear() -> None:
    """Forget everything."""
    _pending.clear()


def _taker(edit: Edit, values: dict[Any, Any]) -> Answer:
    return lambda result, error: _answered(edit, values, error)


def _answered(edit: Edit, values: dict[Any, Any], error: EngineError | None) -> None:
    if edit.sent is values:
        edit.sent = None
    if edit.values is not values:
        edit.due = 0.0  # it was edited again meanwhile
    elif error is not None and error.kind in REFUSED:
        edit.due = float("inf")  # until the user says otherwise
    elif error is None and _pending.get((edit.folder, edit.verb)) is edit:
        del _pending[edit.folder, edit.verb]
    edit.error = error


def _gone(folder: Path) -> EngineError:
    return EngineError(
        "project",
        t("There is no project at {}.", folder),
        t("Connect its disk, or choose its folder again."),
    )
