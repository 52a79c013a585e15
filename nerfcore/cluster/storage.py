"""Files between machines without a common folder: any place that fsspec reaches, S3 for instance.

    URL/objects/ab/abcd…      the contents of files, named by their SHA-256; never changed, so never half written for a reader
    URL/captures/NAME.json    which files a capture has: {path below the campaign's folder: [SHA-256, bytes, time]}
    URL/captures/NAME.holder  who has the capture: the word of the copy that took it last, which alone changes that list

What a machine has of a capture is in working_copy.py.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import FieldworkError, SettingError
from ..files import atomic_path, file_hash, leads_outside
from ..project.fingerprints import digest
from .link import INSTALL

Files = dict[str, list[Any]]  # path below the campaign's folder → [SHA-256, bytes, time in ns]


class StorageError(FieldworkError):
    """The storage of a campaign cannot be reached, or lacks a file."""

    code = "storage"


class TakenError(StorageError):
    """Somebody else has gone on with a capture."""

    code = "taken"


def without_password(text: str) -> str:
    """A text with “…” for the passwords of the addresses in it."""
    return re.sub(r"://([^/@\s:]*):[^/@\s]+@", r"://\1:…@", text)


class Storage:
    """One place of an fsspec file system."""

    def __init__(self, url: str) -> None:
        try:
            import fsspec
        except ImportError as error:
            raise SettingError("--storage needs fsspec, which is not installed here.", INSTALL) from error
        self.url, self.shown = url, without_password(url)
        try:
            self.fs, self.root = self._told("opening it", lambda: fsspec.core.url_to_fs(url), (ImportError, ValueError))
        except (ImportError, ValueError) as error:
            raise SettingError(
                f"--storage {self.shown} cannot be used: {without_password(str(error))}.",
                "Give a URL that fsspec knows.",
            ) from error
        self.whole_puts = "file" not in (
            self.fs.protocol if isinstance(self.fs.protocol, tuple) else (self.fs.protocol,)
        )

    def _told(self, doing: str, work: Callable[[], Any], known: tuple[type[Exception], ...] = ()) -> Any:
        try:
            return work()
        except known:
            raise
        except FileNotFoundError as error:
            message = f"{self.shown} lacks a file while {doing}: {without_password(str(error))}."
            raise StorageError(message, "Run the campaign again.") from error
        except Exception as error:  # clients of storages have errors of their own, for want of credentials for instance
            raise StorageError(
                f"{self.shown} cannot be reached while {doing}: {without_password(str(error))}.",
                "Check the address, the network and the rights.",
            ) from error

    def _put(self, source: Path, target: str) -> None:
        """Upload so that a reader sees all of the file or none."""
        if self.whole_puts:
            self.fs.put_file(str(source), target)
            return
        self.fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        temporary = f"{target}.{uuid.uuid4().hex}"
        self.fs.put_file(str(source), temporary)
        self.fs.mv(temporary, target)

    def _object(self, name: str) -> str:
        return f"{self.root}/objects/{name[:2]}/{name}"

    def objects(self) -> set[str]:
        """The names of all contents that are there."""
        self.fs.invalidate_cache()
        found = self._told("listing what is there", lambda: self.fs.find(f"{self.root}/objects"))
        return {place.rpartition("/")[2] for place in found}

    def put_object(self, path: Path, name: str) -> None:
        """Upload the contents of a file, unless they are there."""
        target = self._object(name)

        def work() -> None:
            if not self.fs.exists(target):
                self._put(path, target)

        self._told(f"uploading {path}", work)

    def get_object(self, name: str, path: Path) -> None:
        """Fetch contents into a file, which appears whole or not at all. Raises StorageError, DiskError."""
        with atomic_path(path) as temporary:
            self._told(f"fetching {path.name}", lambda: self.fs.get_file(self._object(name), str(temporary)))
            if file_hash(temporary) != name:
                raise StorageError(f"{self.shown} has damaged contents of {path}.", "Upload it again.")

    def files(self, capture: str) -> Files:
        """The files of a capture; none where nothing was uploaded of it."""
        place = f"{self.root}/captures/{capture}.json"
        self.fs.invalidate_cache()

        def work() -> Files:
            return json.loads(self.fs.cat_file(place)) if self.fs.exists(place) else {}

        found = self._told("reading a list of files", work)
        for path in found:
            if leads_outside(path):
                raise StorageError(
                    f"{self.shown} names the file {path}, outside of the campaign's folder.", "Look at it."
                )
        return found

    def set_files(self, capture: str, files: Files) -> None:
        """Write the files of a capture, in one go."""
        text = json.dumps(files, sort_keys=True)
        self._told("writing a list of files", lambda: self._put_text(text, f"{self.root}/captures/{capture}.json"))

    def holder(self, capture: str) -> str:
        """The word of who took the capture last; empty where nobody has."""
        place = f"{self.root}/captures/{capture}.holder"
        self.fs.invalidate_cache()

        def work() -> str:
            return self.fs.cat_file(place).decode() if self.fs.exists(place) else ""

        return self._told("looking who has a capture", work)

    def set_holder(self, capture: str, word: str) -> None:
        """Let whoever knows this word have the capture."""
        self._told("taking a capture", lambda: self._put_text(word, f"{self.root}/captures/{capture}.holder"))

    def _put_text(self, text: str, target: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "text"
            path.write_text(text, encoding="utf-8")
            self._put(path, target)


def work_folder(url: str) -> Path:
    """Where a worker keeps its copies of a campaign's files: below FIELDWORK_WORK, else the temporary folder."""
    base = Path(os.environ.get("FIELDWORK_WORK") or Path(tempfile.gettempdir()) / "fieldwork-campaigns")
    return base / digest(url)
