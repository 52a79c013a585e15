"""Errors a user is meant to read: what is wrong, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LONGEST_VALUE = 60  # characters of a wrong value that are repeated to the user


class FieldworkError(Exception):
    """A failure with a sentence for the user.

    `code` names the kind of failure in JSON-RPC and `--json` output (stable, snake_case); `hint` says what to do;
    `result` holds what was done all the same.
    """

    code = "failed"

    def __init__(self, message: str, hint: str = "", result: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.result = result or {}

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".strip()


class ProjectError(FieldworkError):
    """The capture project is missing, foreign, truncated, newer or locked."""

    code = "project"


class InputError(FieldworkError):
    """The user's photos, labels, masks or data set cannot be used."""

    code = "input"


class PosesError(FieldworkError):
    """Camera poses could not be estimated."""

    code = "poses"


class SettingError(FieldworkError):
    """A setting has an impossible value."""

    code = "setting"


class TrainingError(FieldworkError):
    """Training cannot go on."""

    code = "training"


class DiskError(FieldworkError):
    """A file cannot be written: no room, no permission."""

    code = "disk"


class BlenderError(FieldworkError):
    """A Blender is missing, or a script inside it failed."""

    code = "blender"


class Cancelled(Exception):
    """Raised inside a long computation when its caller asked it to stop."""


def wrong_value(detail: Mapping[str, Any]) -> str:
    """A clause about one value that a pydantic model refused (an item of `ValidationError.errors()`)."""
    name = ".".join(str(part) for part in detail["loc"])
    if detail["type"] == "extra_forbidden":
        return f"there is no setting “{name}”"
    if detail["type"] == "missing":
        return f"“{name}” is missing"
    reason = str(detail.get("ctx", {}).get("error", "")) if detail["type"] == "value_error" else ""
    if reason:
        return f"“{name}”: {reason}" if name else reason
    value = repr(detail["input"])
    value = value if len(value) <= LONGEST_VALUE else value[:LONGEST_VALUE] + "…"
    return f"“{name}”: {detail['msg'][:1].lower()}{detail['msg'][1:]} (it is {value})"
