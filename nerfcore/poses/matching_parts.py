"""Matching the photos of one large capture in parts, each in a database of its own. Runs in the pose process.

poses/sfm/pairs.json       the pairs to match, and in which database their features are
poses/sfm/parts/K-N.db     a copy of that database with the matches of every Nth pair from the Kth on
"""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from ..errors import PosesError
from ..files import atomic_path, write_json
from ..progress import log
from . import features
from .presets import EXHAUSTIVE_UP_TO, LADDERS

PAIRS, PARTS = "pairs.json", "parts"
MATCHES = ("matches", "two_view_geometries")  # tables of COLMAP's database that matching fills


def find_features(job: dict[str, Any], tell: Any) -> dict[str, Any]:
    """Find the features of the first level and the pairs worth matching; returns {"pairs": how many}."""
    work, level = Path(job["work"]), LADDERS[job["preset"]][0]
    names = [image["file"] for image in job["images"]]
    path = work / level.database
    features.add_images(path, Path(job["image_folder"]), job["images"])
    masks = Path(job["masks"]) if job["masks"] else None
    features.extract(path, Path(job["image_folder"]), masks, names, level, tell)
    if len(names) <= EXHAUSTIVE_UP_TO:
        pairs = features.all_pairs(names)
    else:
        pairs = features.likely_pairs(path, names, job["neighbours"], tell)
    shutil.rmtree(work / PARTS, ignore_errors=True)
    write_json(work / PAIRS, {"database": level.database, "images": sorted(names), "pairs": pairs})
    return {"pairs": len(pairs)}


def match_part(job: dict[str, Any], tell: Any) -> dict[str, Any]:
    """Match a part of the pairs; one that was stopped goes on. Returns {"pairs": how many}.

    Raises:
        PosesError: the features were not found yet.
    """
    work, (part, parts) = Path(job["work"]), job["part"]
    known = _plan(work)
    if known is None:
        raise PosesError(f"{work / PAIRS} is missing.", "Find the features first, then match.")
    pairs = [(a, b) for a, b in known["pairs"][part::parts]]
    path = work / PARTS / f"{part}-{parts}.db"
    if not path.is_file():
        path.parent.mkdir(exist_ok=True)
        with (
            atomic_path(path) as temporary,
            closing(sqlite3.connect(work / known["database"])) as source,
            closing(sqlite3.connect(temporary)) as target,
        ):
            source.backup(target)
    features.match(path, pairs, path.with_suffix(".txt"), tell)
    return {"pairs": len(pairs)}


def planned_pairs(work: Path, database: str, names: list[str]) -> list[tuple[str, str]] | None:
    """The pairs that were chosen for these photos and features; None where none were."""
    known = _plan(work)
    if known is None or known["database"] != database or known["images"] != sorted(names):
        return None
    return [(a, b) for a, b in known["pairs"]]


def gather(work: Path, path: Path) -> int:
    """Bring the matches of all parts into the database `path`; returns how many pairs came."""
    known = _plan(work)
    if known is None or path.name != known["database"]:
        return 0
    count = 0
    for part in sorted((work / PARTS).glob("*.db")):
        with closing(sqlite3.connect(path)) as database:
            database.execute("ATTACH DATABASE ? AS part", (str(part),))
            images = "SELECT image_id, name FROM {}.images ORDER BY image_id"
            same = (
                database.execute(images.format("main")).fetchall() == database.execute(images.format("part")).fetchall()
            )
            if same:
                for table in MATCHES:
                    # A pair counts as matched by its geometry, which comes last.
                    found = database.execute(f"INSERT OR IGNORE INTO main.{table} SELECT * FROM part.{table}")
                count += found.rowcount
                database.commit()
            else:
                log.warning("%s is of other photos and is left out", part)
        part.unlink()
    shutil.rmtree(work / PARTS, ignore_errors=True)
    return count


def _plan(work: Path) -> dict[str, Any] | None:
    try:
        return json.loads((work / PAIRS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
