"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from .errors import DiskError, InputError, disk_refusal

WINDOWS = sys.platform == "win32"
READERS_TAKE = 5.0  # seconds at most that a file which is to be replaced may stay open in another program
STAGED = ".fieldwork-new-"  # how folders begin in which files wait for their place
LEFT_AFTER = 86400.0  # seconds after which nobody works on such a folder any more
LONGEST_NAME = 64  # characters of a name that the user gives, of a run for instance
# Windows keeps these for devices, whatever comes behind a dot.
_DEVICES = {"con", "prn", "aux", "nul", *(f"{kind}{i}" for kind in ("com", "lpt") for i in "0123456789¹²³")}
UNREADABLE_ARRAYS = (OSError, EOFError, ValueError, BadZipFile, zlib.error)  # what damaged .npy and .npz raise


def name_problem(name: str) -> str | None:
    """What is wrong with a name that shall become a file or folder on any system; None for a good one."""
    if not re.fullmatch(r"[\w-][\w.-]*", name) or name.endswith("."):
        return f"“{printable(name)}” is no name: give letters, digits, “_” and “-”, with dots in between"
    if len(name) > LONGEST_NAME:
        return f"“{name[:20]}…” has {len(name)} characters: give at most {LONGEST_NAME}"
    if name.split(".")[0].lower() in _DEVICES:
        return f"“{name}” is no name: Windows keeps it for a device"
    return None


def is_text(name: str) -> bool:
    """Whether a name from the file system is Unicode; Python carries other bytes along as lone surrogates."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(name: str) -> str:
    """A name from the file system as it can be shown: bytes that are no UTF-8 become “?”."""
    return name.encode(errors="replace").decode()


def leads_outside(path: str) -> bool:
    """Whether a path, meant to be relative to some folder, leads out of it on any system."""
    parts = path.replace("\\", "/").split("/")
    return ".." in parts or (parts[0] == "" and len(parts) > 1) or parts[0].endswith(":")


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn the operating system's refusal to write `path` into a `DiskError` that names it."""
    try:
        yield
    except OSError as error:
        refusal = disk_refusal(error, path)
        if refusal is None:
            raise
        raise refusal from error


def require_readable(folder: Path) -> None:
    """Raise InputError where `folder` is there and its contents may not be looked at."""
    try:
        if folder.is_dir():
            os.stat(folder / ".")  # the right to go in
            os.listdir(folder)
    except PermissionError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.", "Check its permissions.") from error


def require_writable(path: Path) -> None:
    """Raise DiskError unless a file can be made at `path`, whose folder need not be there yet: to be asked before the work
    whose result it shall hold."""
    import tempfile  # see `atomic_path`

    path = Path(path).absolute()
    with disk_errors(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        there = next(folder for folder in path.parents if folder.exists())
        try:
            with tempfile.TemporaryFile(dir=there):
                pass
        except FileNotFoundError as error:  # what Linux says of files below /proc
            raise DiskError(f"{path} cannot be written: {there} takes no files.", "Choose another folder.") from error


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; when the block succeeds, fsync it and move it into place.

    On any failure the temporary file is removed and what stood at `path` before is untouched.

    Raises:
        DiskError: the disk is full or the folder is not writable.
    """
    import tempfile  # not at the top: Blender reads this module when it enables the extension

    path = Path(path)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # The real suffix is kept last: image writers choose the format by it.
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            with open(temporary, "rb+") as written:  # Windows syncs only what is open for writing
                os.fsync(written.fileno())
            with suppress(PermissionError):  # folders of a network or of Windows, whose files belong to another user
                temporary.chmod(0o644)
            replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield an empty folder inside `folder`; when the block succeeds, the files that were written into it, or into folders in
    it, are moved to `folder`, in the place of those of their names.

    On any failure they are removed, and what stood in `folder` before is untouched.

    Raises:
        DiskError: the disk is full or the folder is not writable.
    """
    import shutil
    import tempfile

    folder = Path(folder)
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"{STAGED}*"):  # by a process that was killed
            with suppress(OSError):
                if time.time() - left.stat().st_mtime > LEFT_AFTER:
                    shutil.rmtree(left)
        place = Path(tempfile.mkdtemp(prefix=STAGED, dir=folder))
        try:
            yield place
            for path in sorted(path for path in place.rglob("*") if path.is_file()):
                target = folder / path.relative_to(place)
                target.parent.mkdir(parents=True, exist_ok=True)
                replace(path, target)
        except DiskError as error:  # the folder of a moment is of no use to the user
            error.message = error.message.replace(str(place), str(folder))
            raise
        finally:
            shutil.rmtree(place, ignore_errors=True)


def copied(source: str | Path, target: str | Path) -> str | Path:
    """Copy a file with its time, but not with its rights: copies of what may only be read can be written."""
    import shutil

    shutil.copyfile(source, target)
    stat = os.stat(source)
    with suppress(PermissionError):  # see `atomic_path`
        os.utime(target, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return target


def linked(source: str, target: str) -> str:
    """A file at two places, as one where the file system can; for `copy_function` of `shutil.copytree`."""
    try:
        os.link(source, target)
    except OSError:
        copied(source, target)
    return target


def replace(source: Path, target: Path) -> None:
    """Move a file into the place of another.

    Windows refuses while another program has one of them open, a reader or a virus scanner: it is waited for.

    Raises:
        PermissionError: it is still open after `READERS_TAKE`, or the folder is not writable.
    """
    deadline = time.monotonic() + READERS_TAKE
    while True:
        try:
            return os.replace(source, target)
        except PermissionError:
            if not WINDOWS or time.monotonic() > deadline:
                raise
            time.sleep(0.02)


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
    """Atomically write `value` as indented JSON.

    Raises:
        ValueError: a number is not finite: JSON has none such, and what stands there stays readable.
    """
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def json_lines(block: bytes) -> list[dict[str, Any]]:
    """The objects in lines of JSON; a line that a kill or a full disk cut off is left out."""
    found = []
    for line in block.splitlines():
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            found.append(value)
    return found


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
