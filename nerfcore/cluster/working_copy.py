"""The files of a capture on one machine, beside those in the storage of a campaign: what a stage needs is fetched, what it
changed is uploaded, first contents, the list of files last."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import threading
import uuid
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ..errors import DiskError, FieldworkError
from ..files import STAGED, file_hash, linked, write_json
from ..project.fingerprints import digest
from ..project.merged import merged_project
from ..project.store import LOCK_FILE, PROJECT_FILE, locked
from .storage import Files, Storage, TakenError

STATE = ".state"  # folder: what was fetched or uploaded last, so that only what changed since is read again
PLACE = "fieldwork-campaign:"  # stands for the campaign's folder in files that name places
NAMES_PLACES = ("project.json", "metrics.json", "render.json", "mesh.json")
GROWING = (".jsonl", ".db")  # files that are changed in place
THREADS = 8


class Copy:
    """A capture's files in a folder of this machine, beside those in the storage.

    Args:
        tracked: the files and folders of the capture, below `folder`.
    """

    def __init__(self, storage: Storage, folder: Path, capture: str, tracked: Iterable[Path]) -> None:
        self.storage, self.folder, self.capture = storage, folder, capture
        self.tracked = [path.absolute() for path in tracked]
        self.state_file = folder / STATE / digest(storage.url)[:12] / f"{capture}.json"
        self.lock = threading.Lock()
        self.before: dict[str, list[int]] = {}  # stamps of files that a stage found, see `begin`
        self.word = ""  # by which the storage knows that this copy has the capture, see `take`

    def _state(self) -> dict[str, list[Any]]:
        """path → [SHA-256 in the storage, bytes and time of the file here] when they were last the same."""
        try:
            return json.loads(self.state_file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}

    def _here(self) -> dict[str, Path]:
        found = {}
        for place in self.tracked:
            inside = [place] if place.is_file() else [path for path in place.rglob("*") if path.is_file()]
            for path in inside:
                # What the jobs of a project say is of this machine alone. Captures may lie in a folder of that name.
                parts = path.relative_to(place).parts
                half_written = path.name.startswith(".") or any(part.startswith(STAGED) for part in parts)
                if "jobs" not in parts and not half_written:
                    found[path.relative_to(self.folder).as_posix()] = path
        return found

    def take(self, campaign: str = "", attempt: int = 0) -> None:
        """Have the capture from now on: whoever had it before uploads nothing of it any more. A worker that was given up for
        being silent may live, and be heard again when another has long gone on with its work.

        Args:
            campaign, attempt: a campaign counts its attempts, from 1 on. One of them takes a capture from earlier attempts of its
                own campaign alone: one that was given up before it had begun may begin later. 0: from whoever has it.
        Raises:
            TakenError: a later attempt or another campaign has it.
        """
        holder = self.storage.holder(self.capture)
        having, _, number = holder.rpartition(":")
        if attempt and holder and (having != campaign or int(number) > attempt):
            raise self._taken()
        self.word = f"{campaign or uuid.uuid4().hex}:{attempt}"
        self.storage.set_holder(self.capture, self.word)

    def _require_taken(self) -> None:
        """Raise TakenError where somebody else has taken the capture since."""
        if self.word and self.storage.holder(self.capture) not in (self.word, ""):
            raise self._taken()

    def _taken(self) -> TakenError:
        return TakenError(
            f"Another worker has gone on with {self.capture} meanwhile: what was made here is not uploaded.",
            "If another campaign has it, run this one again when that is done.",
        )

    def mend(self, objects: set[str]) -> None:
        """Forget what the storage has lost, so that what there is of it here is uploaded again.

        Args:
            objects: what the storage has.
        """
        state = self._state()
        if not state:
            return
        files = self.storage.files(self.capture)
        lost = {name for name, entry in files.items() if entry[0] not in objects}
        gone = {name for name, entry in state.items() if not files or name in lost or entry[0] not in objects}
        if lost:
            self.storage.set_files(self.capture, {name: entry for name, entry in files.items() if name not in lost})
        if gone:
            write_json(self.state_file, {name: entry for name, entry in state.items() if name not in gone})

    def fetch(
        self,
        wanted: Callable[[str], bool] = lambda _: True,
        check: Callable[[], None] = lambda: None,
        keep_changes: bool = False,
        warn: Callable[[str], None] = lambda _: None,
    ) -> int:
        """Bring files here that are wanted and not the same; those that are gone from the storage go. How many came.

        Args:
            keep_changes: leave files that were changed here; where they were changed there too, `warn` tells. Of project.json
                both changes are kept.
        """
        state, files, todo = self._state(), self.storage.files(self.capture), []
        for name, (sha, _, _) in files.items():
            stamp, known = _stamp(self.folder / name), state.get(name, [""])
            same = known[0] == sha and bool(stamp) if keep_changes else known == [sha, *stamp]
            if wanted(name) and not same:
                todo.append(name)
        # A storage without a list has lost it: that says nothing of the files here.
        gone = [name for name in state if files and name not in files]
        own = [name for name in (*todo, *gone) if keep_changes and self._edited(name, state, files)]
        with ThreadPoolExecutor(THREADS) as pool:
            coming = [name for name in todo if name not in own]
            for _ in pool.map(lambda name: self._fetch_one(self.folder / name, files[name], check), coming):
                check()
        for name in coming:
            state[name] = [files[name][0], *_stamp(self.folder / name)]
        for name in own:
            if name in state and name in files and Path(name).name == PROJECT_FILE:
                self._merge(name, state[name], files[name], warn)
                # Without a time: the file here is another one, which goes up with the next campaign.
                state[name] = [files[name][0]]
            else:
                warn(
                    f"{self.folder / name} was changed here and by a worker: yours stays. The next campaign uploads it."
                )
        for name in gone:
            if name not in own:
                (self.folder / name).unlink(missing_ok=True)
        # What was taken away here before is missing here, and not to be taken away from the others.
        write_json(self.state_file, {name: entry for name, entry in state.items() if (self.folder / name).is_file()})
        return len(coming)

    def _edited(self, name: str, state: dict[str, list[Any]], files: Files) -> bool:
        """Whether a file was changed here since it was the same as in the storage, and is another one than there now."""
        path = self.folder / name
        stamp = _stamp(path)
        return bool(stamp) and state.get(name, [""])[1:] != stamp and file_hash(path) != files.get(name, [""])[0]

    def _merge(self, name: str, known: list[Any], entry: list[Any], warn: Callable[[str], None]) -> None:
        """Let the project.json here have both what was changed here and what was changed in the storage."""
        path = self.folder / name
        with tempfile.TemporaryDirectory(dir=self._spare()) as folder:
            before, theirs = Path(folder) / "before" / path.name, Path(folder) / "theirs" / path.name
            for copy, sha in ((before, known[0]), (theirs, entry[0])):
                self._fetch_one(copy, [sha, *entry[1:]], lambda: None)
            with locked(path, path.parent / LOCK_FILE):
                values = [json.loads(file.read_text(encoding="utf-8")) for file in (before, path, theirs)]
                both, clash = merged_project(*values)
                write_json(path, both)
        if clash:
            warn(f"{path}: the alignment made here meanwhile is of earlier poses, and left out. Align it again.")

    def _fetch_one(self, path: Path, entry: list[Any], check: Callable[[], None]) -> None:
        check()
        path.parent.mkdir(parents=True, exist_ok=True)
        self.storage.get_object(entry[0], path)
        if path.name in NAMES_PLACES:
            write_json(path, placed(json.loads(path.read_text(encoding="utf-8")), PLACE, str(self.folder)))
        os.utime(path, ns=(entry[2], entry[2]))

    def begin(self, wanted: Callable[[str], bool]) -> None:
        """From now on upload only what changes: a stage that was killed may have left files here that are older than those in
        the storage. What it left where the storage has nothing goes, except databases, which no stage saves on its way.

        Args:
            wanted: whether the stage reads a file.
        """
        files = self.storage.files(self.capture)
        self.before = {}
        for name, path in self._here().items():
            if name in files or not wanted(name):
                self.before[name] = _stamp(path)
            elif files and path.suffix != ".db":
                path.unlink(missing_ok=True)

    def _changes(self, state: dict[str, list[Any]], here: dict[str, Path]) -> list[str]:
        """The files here that are to be uploaded."""
        stamps = {name: _stamp(path) for name, path in here.items()}
        came = [name for name, stamp in stamps.items() if name not in state or state[name][1:] != stamp]
        return [name for name in came if self.before.get(name) != stamps[name]]

    def changed(self) -> bool:
        """Whether files here are others than when they were last the same as in the storage."""
        state = self._state()
        return bool(self._changes(state, self._here())) or any(not (self.folder / name).is_file() for name in state)

    def upload(self, databases: bool = True) -> int:
        """Upload what changed here; the list of files comes last. How many files went.

        Args:
            databases: also COLMAP's, which are whole only when nobody writes them.
        Raises:
            StorageError: also where somebody else has taken the capture since.
        """
        with self.lock:
            self._require_taken()
            state, files, here = self._state(), self.storage.files(self.capture), self._here()
            todo = [name for name in self._changes(state, here) if databases or not name.endswith(".db")]
            with ThreadPoolExecutor(THREADS) as pool:
                for name, entry in zip(todo, pool.map(lambda name: self._upload_one(here[name]), todo)):
                    if entry is not None:
                        files[name], state[name] = entry[:3], [entry[0], *entry[1:]]
            for name in [name for name in state if not (self.folder / name).is_file()]:
                files.pop(name, None)
                del state[name]
            self._require_taken()  # uploading contents takes long
            self.storage.set_files(self.capture, files)
            write_json(self.state_file, state)
            return len(todo)

    def _upload_one(self, path: Path) -> list[Any] | None:
        """[SHA-256, bytes, time] of an uploaded file; None where it went away meanwhile."""
        try:
            with tempfile.TemporaryDirectory(dir=self._spare()) as folder:
                stamp, source = _stamp(path), Path(folder) / "contents"
                if path.name in NAMES_PLACES:
                    value = placed(json.loads(path.read_text(encoding="utf-8")), str(self.folder), PLACE)
                    source.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
                elif path.suffix in GROWING:
                    shutil.copyfile(path, source)
                else:
                    # Such a file is replaced, never changed: a second name keeps its contents while they are read.
                    linked(str(path), str(source))
                sha = file_hash(source)
                self.storage.put_object(source, sha)
                return [sha, *stamp]
        except FileNotFoundError:
            return None

    def _spare(self) -> Path:
        folder = self.folder / STATE
        folder.mkdir(parents=True, exist_ok=True)
        return folder


class Saving:
    """Uploads now and then what a long stage writes, so that another worker can go on from its last checkpoint."""

    def __init__(self, copy: Copy, every: float) -> None:
        self.copy, self.every, self.over = copy, every, threading.Event()
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.trouble: FieldworkError | None = None

    def __enter__(self) -> Saving:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.thread.join()
        self.copy.upload()

    def _work(self) -> None:
        while not self.over.wait(self.every):
            try:
                if self.copy.changed():
                    self.copy.upload(databases=False)
            except (FieldworkError, OSError) as error:  # the end of the stage tries again, and tells
                self.trouble = error if isinstance(error, FieldworkError) else DiskError(str(error))


def _stamp(path: Path) -> list[int]:
    """Bytes and time of a file; empty where it is not there."""
    try:
        stat = path.stat()
    except FileNotFoundError:
        return []
    return [stat.st_size, stat.st_mtime_ns]


def placed(value: Any, old: str, new: str) -> Any:
    """JSON with another folder in the places it names."""
    if isinstance(value, dict):
        return {key: placed(item, old, new) for key, item in value.items()}
    if isinstance(value, list):
        return [placed(item, old, new) for item in value]
    if isinstance(value, str) and (value == old or value.startswith((f"{old}/", f"{old}\\"))):
        return new + value[len(old) :]
    return value
