"""What an interrupted mapping left behind: finished models, and snapshots of unfinished ones. Runs in the pose process."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pycolmap

from ..data.readers.colmap import read_model
from ..errors import InputError
from ..files import write_json
from ..progress import log
from .features import database

MARKER = "done.json"
SNAPSHOTS = "snapshots"


def mapping_folder(work: Path, path: Path, full: bool, relaxed: bool, names: list[str]) -> Path:
    """Where the models of one way to map are kept: it depends on all that decides about them."""
    with database(path) as db:
        pairs, matches = db.num_matched_image_pairs(), db.num_inlier_matches()
    key = json.dumps([path.name, pairs, matches, full, relaxed, sorted(names)])
    return work / "mapping" / hashlib.sha256(key.encode()).hexdigest()[:16]


def finished_models(folder: Path) -> list[Any] | None:
    """The models of a mapping that came to its end, or None."""
    try:
        count = json.loads((folder / MARKER).read_text(encoding="utf-8"))["models"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return [pycolmap.Reconstruction(str(folder / str(i))) for i in range(count)]


def keep_models(folder: Path, models: list[Any]) -> None:
    """Write finished models; the marker comes last, so that half of them never counts."""
    for i, model in enumerate(models):
        target = folder / str(i)
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        model.write(str(target))
    write_json(folder / MARKER, {"models": len(models)})
    shutil.rmtree(folder / SNAPSHOTS, ignore_errors=True)


def latest_snapshot(folder: Path) -> Path | None:
    """The newest snapshot that is whole, if any. Its files are read by our own reader: COLMAP aborts on half ones."""
    if not (folder / SNAPSHOTS).is_dir():
        return None
    found = sorted((p for p in (folder / SNAPSHOTS).iterdir() if p.is_dir()), key=lambda p: p.stat().st_mtime_ns)
    for snapshot in reversed(found):
        try:
            _, images, points = read_model(snapshot)
        except InputError as error:
            log.info("snapshot left out: %s", error)
            continue
        if len(images) >= 2 and len(points):
            return snapshot
    return None
