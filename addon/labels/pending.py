"""Marks and undone revisions on their way to the engine, which alone writes the journal.

A mark stays here until the engine has answered that it is on disk. Where the engine dies meanwhile it is sent again, with
the same key, so that it is neither lost nor made twice. Kept outside the scene: undo does not take back what is under way.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import EngineError
from . import journal

RETRY = 2.0  # seconds until what the engine did not take is sent again
LOST = 10.0  # seconds without an answer after which the same is done: an engine that was stopped answers nothing
REFUSED = ("setting", "input", "refused")  # kinds of errors that the same mark would meet again

Answer = Callable[[dict[str, Any] | None, EngineError | None], None]
Ask = Callable[[str, dict[str, Any], Answer], object]  # verb, parameters, what takes the answer; raises EngineError


class Wish:
    """What the engine is to do with the marks of a project: `label stroke` or `label checkout`. more: the mark after it is of
    the same step of undo. above: parameters of what was asked for meanwhile, to go on top of it."""

    def __init__(self, folder: Path, verb: str, params: dict[str, Any], more: bool = False) -> None:
        self.folder, self.verb, self.params, self.more = folder, verb, params, more
        self.key = os.urandom(16).hex()
        self.above: list[dict[str, Any]] = []
        self.sent = False
        self.due = 0.0  # when to send (again), by the monotonic clock


class Taken(NamedTuple):
    """A wish that the engine has fulfilled, and the revision that is shown by it; more: as of the wish."""

    folder: Path
    verb: str
    revision: int
    more: bool = False


_wishes: list[Wish] = []
_taken: list[Taken] = []
_errors: dict[Path, EngineError] = {}


def mark(folder: Path, params: dict[str, Any], more: bool = False) -> Wish:
    """Let a mark (parameters of `label stroke`, but for the project) wait for `send`."""
    wish = Wish(folder, "label stroke", params, more)
    wish.params = {**params, "key": wish.key}
    _errors.pop(folder, None)
    _wishes.append(wish)
    return wish


def check_out(folder: Path, revision: int) -> None:
    """Let a revision be shown once the marks before it are taken; such a wish just before it that nobody sent is forgotten.
    One before a mark stays, for the mark was drawn on that revision."""
    last = _last(folder)
    if last is not None and last.verb == "label checkout" and not last.sent:
        _wishes.remove(last)
    _wishes.append(Wish(folder, "label checkout", {"revision": revision}))


def go_on_top(folder: Path, params: dict[str, Any]) -> None:
    """Let parameters of `assist segment` say on which revision it was asked for: `drawn_on`, once what is on its way is taken."""
    last = _last(folder)
    if last is None:
        params["drawn_on"] = shown(folder)
    else:
        last.above.append(params)


def is_top(folder: Path, params: dict[str, Any]) -> bool:
    """Whether nothing was drawn since something was asked for with these parameters."""
    last = _last(folder)
    if last is not None:
        return any(params is above for above in last.above)
    return params.get("drawn_on") == shown(folder)


def marks_of(folder: Path) -> list[dict[str, Any]]:
    """Parameters of the marks that the engine has not taken yet."""
    return [wish.params for wish in _wishes if wish.folder == folder and wish.verb == "label stroke"]


def unfinished(folder: Path) -> bool:
    """Whether a mark is no step of undo yet: the engine has not answered, or nobody called `take` since."""
    return bool(marks_of(folder)) or any(t.folder == folder and t.verb == "label stroke" for t in _taken)


def shown(folder: Path) -> int:
    """The revision that is to be shown: what undo asked for, else what the project says."""
    wanted = [w.params["revision"] for w in _wishes if w.folder == folder and w.verb == "label checkout"]
    return wanted[-1] if wanted else journal.shown(folder)


def waiting(folder: Path | None = None) -> bool:
    """Whether there is something the engine has not taken (of one project)."""
    return any(folder in (None, wish.folder) for wish in _wishes)


def error(folder: Path) -> EngineError | None:
    """Why the last mark or undo of a project was not taken; None once one is."""
    return _errors.get(folder)


def tell(folder: Path, error: EngineError) -> None:
    """Let the panel show what else went wrong, until the next mark."""
    _errors[folder] = error


def fulfilled(folder: Path, revision: int) -> None:
    """A mark is in the journal that nobody here sent."""
    _taken.append(Taken(folder, "label stroke", revision))


def take() -> list[Taken]:
    """What was fulfilled since the last call, oldest first."""
    found = list(_taken)
    _taken.clear()
    return found


def send(ask: Ask, at_once: bool = False) -> None:
    """Hand the oldest wish of each project to the engine, where that is due; the next follows when it has answered."""
    now, seen = time.monotonic(), set()
    for wish in list(_wishes):
        first = wish.folder not in seen
        seen.add(wish.folder)
        if not first or (now < wish.due and (wish.sent or not at_once)):
            continue
        wish.sent, wish.due = True, now + LOST
        try:
            ask(wish.verb, {"project": str(wish.folder), **wish.params}, _taker(wish))
        except EngineError as error:
            _answered(wish, None, error)


def send_all(folder: Path, ask: Ask) -> None:
    """Hand all wishes of a project to an engine that answers at once, those that failed before first, until one fails."""
    for _ in [wish for wish in _wishes if wish.folder == folder]:
        send(ask, at_once=True)
        if folder in _errors:
            return


def send_rest(ask: Ask) -> None:
    """Hand what the engine was not told yet to it, in order and without waiting for answers: Blender ends."""
    for wish in [wish for wish in _wishes if not wish.sent]:
        try:
            ask(wish.verb, {"project": str(wish.folder), **wish.params}, _taker(wish))
        except EngineError:
            return  # there is no engine


def clear() -> None:
    """Forget everything."""
    for found in (_wishes, _taken, _errors):
        found.clear()


def _last(folder: Path) -> Wish | None:
    return next((wish for wish in reversed(_wishes) if wish.folder == folder), None)


def _remove(wish: Wish, revision: int) -> None:
    """Forget a wish; `revision`: what was asked for on top of it goes on that one."""
    _wishes.remove(wish)
    for params in wish.above:
        params["drawn_on"] = revision


def _taker(wish: Wish) -> Answer:
    return lambda result, error: _answered(wish, result, error)


def _answered(wish: Wish, result: dict[str, Any] | None, error: EngineError | None) -> None:
    if wish not in _wishes:
        return
    wish.sent = False
    if error is None and result is not None:
        revision = int(result["revision"])
        _remove(wish, revision)
        _errors.pop(wish.folder, None)
        _taken.append(Taken(wish.folder, wish.verb, revision, wish.more))
        return
    if error is not None:
        _errors[wish.folder] = error
        if error.kind in REFUSED:
            _remove(wish, journal.shown(wish.folder))
    wish.due = time.monotonic() + RETRY
