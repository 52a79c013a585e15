"""Errors a user is meant to read: what is wrong, and what to do about it."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from typing import Any

# What the system says of disks that were taken out and of network folders that are gone.
GONE = (
    errno.EIO, errno.ENXIO, errno.ENODEV, errno.ESTALE, errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ETIMEDOUT,
)  # fmt: skip
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


class DeniedError(DiskError):
    """A file cannot be written for want of rights."""


class BlenderError(FieldworkError):
    """A Blender is missing, or a script inside it failed."""

    code = "blender"


class MemoryExhausted(FieldworkError):
    """The memory of the machine, or of its GPU, does not suffice."""

    code = "memory"


class UnexpectedError(FieldworkError):
    """Nobody foresaw this: a fault of Fieldwork or of a library."""

    code = "internal"


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


def disk_refusal(error: OSError, path: object) -> FieldworkError | None:
    """What the operating system's refusal to write `path` means; None where it is none of those known."""
    number = error.errno
    if number in (errno.ENOSPC, errno.EDQUOT):
        return DiskError(f"No space left on the disk while writing {path}.", "Free some space and run it again.")
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        kind = DiskError if number == errno.EROFS else DeniedError
        return kind(f"{path} cannot be written: {os.strerror(number)}.", "Choose a folder you may write to.")
    if number == errno.EFBIG:
        return DiskError(
            f"{path} would be larger than files may be here.", "Raise the limit (ulimit -f), or the disk's."
        )
    if number in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        return DiskError(f"{path} cannot be written: a file is in its way, or a folder.", "Choose another name.")
    if number in (errno.ENOLCK, errno.EOPNOTSUPP):
        return DiskError(
            f"{path} cannot be locked or written: {os.strerror(number)}.",
            "Let the server of the folder allow locks, or choose a folder on another disk.",
        )
    if number in GONE:
        return DiskError(
            f"{path} cannot be reached: {os.strerror(number)}.", "Connect its disk or network again, then run it again."
        )
    if number == errno.ENAMETOOLONG:
        return DiskError(f"{path} cannot be written: the name is too long.", "Choose a shorter one.")
    return None


def explained(error: BaseException) -> FieldworkError:
    """Any failure as a sentence: what is known of it, else `UnexpectedError`."""
    if isinstance(error, FieldworkError):
        return error
    text = str(error)
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or "allocate memory" in text:
        return MemoryExhausted(
            "The memory is exhausted.", "Close other programs, or choose a smaller preset or smaller images."
        )
    if isinstance(error, ImportError) and "failed to map segment" in text:
        return MemoryExhausted(
            "The memory does not suffice to load the libraries.",
            "Close other programs, or raise the limit of this shell (ulimit -v).",
        )
    if isinstance(error, RecursionError):
        return InputError("A file or a request is nested too deeply.", "Look at the files that were given.")
    if isinstance(error, OSError):
        known = disk_refusal(error, error.filename or "a file")
        if known is not None:
            return known
        if error.filename:
            return DiskError(f"{error.filename} cannot be used: {error.strerror}.", "Look whether it is there.")
    return UnexpectedError(
        f"Fieldwork failed unexpectedly: {type(error).__name__}: {text}.", "Run it again; if it stays, report it."
    )
