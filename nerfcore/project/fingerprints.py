"""What a stage was made from, as digests: a stage is done again only when one of them is another one.

A fingerprint has a digest for each thing a stage depends on, under the name a user knows it by ("photos", "settings",
…), so that it can be said why a stage is done again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ..files import file_hash, write_json
from .schema import Project, ProvenanceStep

Fingerprint = dict[str, str]


@dataclass(frozen=True)
class Earlier:
    """What is known of an earlier result: the result where it may be used again, else why not.

    `reason` is empty where the stage was never done.
    """

    result: dict[str, Any] | None = None
    reason: str = ""


def digest(value: Any) -> str:
    """A digest of anything JSON can hold (paths as text), independent of the order of keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]


def array_digest(*arrays: np.ndarray) -> str:
    """A digest of the types, shapes and values of arrays."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype.str}{array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:32]


def files_digest(files: Iterable[tuple[str, Path | None]]) -> str:
    """A digest of the contents of named files; None and a file that is missing count as such."""
    return digest([[name, file_hash(path) if path is not None and path.is_file() else None] for name, path in files])


def stamps_digest(files: Iterable[Path | None]) -> str:
    """A digest of the names, sizes and times of files: quick where contents are not to be read."""
    found = []
    for path in files:
        stat = path.stat() if path is not None else None
        found.append([path.name, stat.st_size, stat.st_mtime_ns] if path is not None and stat is not None else None)
    return digest(found)


def rounded(value: np.ndarray, digits: int = 6) -> list[Any]:
    """Numbers rounded to `digits` digits of the largest one: transforms there and back leave the digest as it is."""
    size = float(np.abs(value).max(initial=0.0))
    step = 10.0 ** (np.floor(np.log10(size)) + 1 - digits) if size > 0 else 1.0
    return (np.round(np.asarray(value, np.float64) / step) + 0.0).tolist()


def alignment(project: Project) -> str:
    """A digest of where the project lies in the world, how it is turned and how large it is."""
    return digest(rounded(np.array(project.frame.world_from_sfm, np.float64)))


def moved(made: ProvenanceStep, project: Project) -> bool:
    """Whether the project was turned, moved or scaled since this was made."""
    return made.inputs.get("alignment") != alignment(project)


def difference(old: Fingerprint, new: Fingerprint) -> str:
    """What of the inputs changed, as words; empty when nothing did."""
    changed = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    return f"changed: {', '.join(changed)}" if changed else ""


def compare(made: ProvenanceStep | None, inputs: Fingerprint, files: Iterable[Path] = ()) -> Earlier:
    """Whether what was made may be used again for these inputs; `files` are its outputs, which must be there."""
    if made is None:
        return Earlier()
    if not made.inputs:
        return Earlier(reason="made by an earlier version, which did not note from what")
    changed = difference(made.inputs, inputs)
    if changed:
        return Earlier(reason=changed)
    missing = next((path for path in files if not path.is_file()), None)
    return Earlier(reason=f"{missing.name} is gone") if missing is not None else Earlier(made.result)


def write_made(path: Path, made: ProvenanceStep) -> None:
    """Atomically write the record that stands beside an artefact."""
    write_json(path, made.model_dump(mode="json"))


def read_made(path: Path) -> ProvenanceStep | None:
    """The record beside an artefact; None where there is no readable one: the artefact's origin is then unknown."""
    try:
        return ProvenanceStep.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValidationError, UnicodeDecodeError):
        return None
