"""Result sets: what one command measured on one machine at one commit, as files from which pages are made."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from ..errors import InputError
from ..files import write_json

Row = dict[str, Any]
CPU_FLAGS = {
    "avx2": "AVX2",
    "avx512f": "AVX-512",
    "avx512_bf16": "AVX-512 BF16",
    "amx_tile": "AMX",
    "amx_bf16": "AMX BF16",
}


class Machine(BaseModel):
    """What figures were taken on. `None`: not recorded. `gpu` is None where none was used."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cpu: str
    flags: tuple[str, ...] = ()  # of /proc/cpuinfo, those of CPU_FLAGS
    cores: int | None = None
    threads: int | None = None
    gpu: str | None = None
    software: str | None = None
    note: str | None = None

    def sentence(self) -> str:
        named = [name for flag, name in CPU_FLAGS.items() if flag in self.flags]
        parts = [self.cpu + (f" ({', '.join(named)})" if named else "")]
        parts += [f"{n} {what}{'' if n == 1 else 's'}" for n, what in _counts(self)]
        parts += [f"GPU: {self.gpu}" if self.gpu else "no GPU"]
        parts += [text for text in (self.software, self.note) if text]
        return ", ".join(parts)


def _counts(machine: Machine) -> list[tuple[int, str]]:
    found = ((machine.cores, "core"), (machine.threads, "thread"))
    return [(n, what) for n, what in found if n is not None]


class Taken(BaseModel):
    """When, on what and with which code a run was measured."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    machine: Machine
    date: str  # ISO, UTC
    commit: str | None = None
    modified: bool = False  # the code had changes that were not committed


class Asked(BaseModel):
    """What the suite `gpu` adds: the figures asked of a GPU, the tests of its kernels, and what made the host wait."""

    model_config = ConfigDict(extra="forbid")

    figures: dict[str, float | None]
    checks: str | None = None
    waits: dict[str, int] = {}


class ResultSet(BaseModel):
    """Rows of figures measured by one command with the same code on the same machine.

    `rows` hold a value for each key of `columns` {key: heading}; None was asked for and not measured, a key that is
    absent does not apply. Without `columns` the keys are those of `tables.COLUMNS` and `tables.SPEED`.
    """

    model_config = ConfigDict(extra="forbid")

    suite: str
    title: str
    command: str
    source: Literal["bench", "recorded by hand"]
    taken: Taken
    written_with: str | None = None  # recorded by hand: the commit that wrote the figures down
    columns: dict[str, str] | None = None
    rows: list[Row]
    notes: list[str] = []
    asked: Asked | None = None

    def file_name(self) -> str:
        """The same command on the same machine with the same code always has the same name."""
        machine = self.taken.machine.model_dump_json()
        digest = hashlib.sha256(f"{self.command}\n{machine}\n{self.taken.modified}".encode()).hexdigest()[:6]
        return re.sub(r"[^\w.-]+", "-", f"{self.suite}-{self.taken.commit or 'unknown'}-{digest}.json")

    def origin(self) -> str:
        """The sentence that stands beside the table: machine, commit, date."""
        if self.taken.commit:
            commit = f"Commit {self.taken.commit}{' with changes' if self.taken.modified else ''}, {self.taken.date}."
        elif self.written_with:
            commit = f"Recorded by hand with commit {self.written_with}, {self.taken.date}."
        else:
            commit = f"Commit not recorded, {self.taken.date}."
        return f"{self.taken.machine.sentence()}. {commit}"


def grouped(results: Sequence[dict[str, Any]], rows: Sequence[Row]) -> list[tuple[Taken, list[Row]]]:
    """Rows of finished runs by the code and machine they were measured with; the date is that of the last one.

    `results`: what `jobs.run_all` returns, in the order of `rows`. Failed runs and runs of unknown origin are left out.
    """
    found: dict[tuple[Any, ...], tuple[Taken, list[Row]]] = {}
    for result, row in zip(results, rows, strict=True):
        if "error" in result or result.get("taken") is None:
            continue
        taken = Taken.model_validate(result["taken"])
        key = (taken.machine, taken.commit, taken.modified)
        before, group = found.get(key, (taken, []))
        latest = max((before, taken), key=lambda t: t.date)
        found[key] = (latest, [*group, {k: v for k, v in row.items() if k != "error"}])
    return list(found.values())


def write_set(folder: Path, result: ResultSet) -> Path:
    """Atomically write a set; it replaces what the same command measured before on this machine with this code."""
    path = folder / result.file_name()
    write_json(path, result.model_dump(exclude_none=False, exclude_defaults=True))
    return path


def read_sets(folder: Path) -> list[ResultSet]:
    """All sets of a folder, by date and then by name.

    Raises:
        InputError: a file is not a result set.
    """
    sets = []
    for path in sorted(folder.glob("*.json")):
        try:
            sets.append(ResultSet.model_validate(json.loads(path.read_text(encoding="utf-8"))))
        except (ValidationError, json.JSONDecodeError) as error:
            raise InputError(
                f"{path} is not a result set: {error}", "Remove it, or write it again with bench."
            ) from error
    return sorted(sets, key=lambda s: s.taken.date)
