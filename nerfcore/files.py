"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import DiskError, InputError


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn the operating system's refusal to write `path` into a `DiskError` that names it."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskError(
                f"No space left on the disk while writing {path}.", "Free some space and run it again."
            ) from error
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise DiskError(
                f"{path} cannot be written: {os.strerror(error.errno)}.", "Choose a folder you may write to."
            ) from error
        raise


def require_readable(folder: Path) -> None:
    """Raise InputError where `folder` is there and its contents may not be looked at."""
    try:
        if folder.is_dir():
            os.stat(folder / ".")  # the right to go in
            os.listdir(folder)
    except PermissionError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.", "Check its permissions.") from error


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; when the block succeeds, fsync it and move it into place.

    On any failure the temporary file is removed and what stood at `path` before is untouched.

    Raises:
        DiskError: the disk is full or the folder is not writable.
    """
    path = Path(path)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # The real suffix is kept last: image writers choose the format by it.
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
            temporary.chmod(0o644)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Atomically write UTF-8 text."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_section(page: Path, heading: str, text: str) -> None:
    """Atomically replace what stands under "## heading" of a Markdown page, up to the next heading of that level.

    A page or heading that is not there is added.
    """
    old = page.read_text(encoding="utf-8").rstrip() + "\n" if page.is_file() else ""
    title = re.escape(f"## {heading}")
    if not re.search(rf"^{title}$", old, flags=re.MULTILINE):
        old = f"{old}\n## {heading}\n".lstrip()
    new = re.sub(
        rf"(^{title}$).*?(?=^## |\Z)", lambda m: f"{m[1]}\n\n{text.strip()}\n\n", old, flags=re.MULTILINE | re.DOTALL
    )
    write_text(page, new.rstrip() + "\n")


def write_json(path: Path, value: Any) -> None:
    """Atomically write `value` as indented JSON."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
