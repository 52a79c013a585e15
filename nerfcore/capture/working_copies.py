"""Working copies of photos: upright, shrunk, with their label maps, masks and confidence maps fitted to them."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import InputError
from ..files import atomic_path, file_hash, write_json
from ..images.decode import Photo, read_photo
from ..images.labels import Colors, fit_to_photo, read_labels, read_mask, turned_by_itself
from ..images.sharpness import sharpness, thumbnail
from ..images.soft_labels import read_confidence
from ..progress import Reporter
from ..project.schema import ImageRecord
from .find import Source

CACHE_FILE = "jobs/ingested.json"
SAVE_EVERY, SAVE_SHARE = 3.0, 20.0  # seconds, and times what saving took: it is 8 kB a photo
# Not tuned. Wider pictures are stitched ones; full spheres are exactly 2:1 and at least this wide.
MAX_ASPECT, SPHERE_WIDTH = 3.0, 5000


@dataclass(frozen=True)
class Settings:
    """What decides how a working copy looks."""

    folder: Path
    max_size: int
    exposure: float
    colors: Colors | None
    ignore_id: int
    labels_as_stored: bool = True  # drawn on the stored pixels, where their proportions do not tell
    masks_as_stored: bool = True


def make_working_copies(
    sources: list[Source], settings: Settings, report: Reporter
) -> tuple[list[ImageRecord], dict[str, np.ndarray]]:
    """Ingest every photo on a few threads; finished ones are remembered in the project, so a rerun skips them.

    Returns:
        a record of every photo, rejected ones too, and thumbnails (64, 64) of the usable ones by name.
    Raises:
        DiskError: a copy cannot be written. What `report` raises to stop.
    """
    cache = _load_cache(settings.folder)
    done: dict[str, tuple[ImageRecord, np.ndarray | None]] = {}
    workers = max(1, min(4, os.cpu_count() or 1))
    due = time.monotonic() + SAVE_EVERY
    try:
        with ThreadPoolExecutor(workers) as pool:
            queue: Iterator[Source] = iter(sources)
            running: set[Future[tuple[Source, ImageRecord, np.ndarray | None]]] = set()
            while len(done) < len(sources):
                report.progress(len(done) / len(sources), f"{len(done)} of {len(sources)} photos")
                while len(running) < workers and (source := next(queue, None)) is not None:
                    running.add(pool.submit(_ingest_cached, source, settings, cache.get(source.name)))
                finished, running = wait(running, timeout=0.3, return_when=FIRST_COMPLETED)
                for future in finished:
                    source, record, picture = future.result()
                    done[source.name] = record, picture
                    cache[source.name] = _cache_entry(source, settings, record, picture)
                if time.monotonic() > due:
                    started = time.monotonic()
                    write_json(settings.folder / CACHE_FILE, cache)
                    due = time.monotonic() + max(SAVE_EVERY, SAVE_SHARE * (time.monotonic() - started))
    finally:
        if done:
            write_json(settings.folder / CACHE_FILE, cache)
    records = [done[source.name][0] for source in sources]
    return records, {name: picture for name, (_, picture) in done.items() if picture is not None}


def _cache_key(source: Source, settings: Settings) -> list[Any]:
    stamps = []
    for path in (source.path, source.label, source.mask, source.confidence):
        stat = path.stat() if path else None
        stamps.append([str(path), stat.st_size, stat.st_mtime] if stat else None)
    colors = {str(i): list(color) for i, color in sorted((settings.colors or {}).items())}
    stored = [settings.labels_as_stored, settings.masks_as_stored]
    return [stamps, settings.max_size, settings.exposure, colors, settings.ignore_id, stored]


def _cache_entry(source: Source, settings: Settings, record: ImageRecord, picture: np.ndarray | None) -> dict[str, Any]:
    small = None if picture is None else np.round(picture).astype(np.uint8).tobytes().hex()
    return {"key": _cache_key(source, settings), "record": record.model_dump(mode="json"), "thumbnail": small}


def _load_cache(folder: Path) -> dict[str, Any]:
    """What an earlier run finished. Anything unreadable only costs doing it again."""
    try:
        cache = json.loads((folder / CACHE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return cache if isinstance(cache, dict) else {}


def _ingest_cached(
    source: Source, settings: Settings, entry: dict[str, Any] | None
) -> tuple[Source, ImageRecord, np.ndarray | None]:
    if entry and entry.get("key") == json.loads(json.dumps(_cache_key(source, settings))):
        record = ImageRecord.model_validate(entry["record"])
        files = [file for file in (record.file, record.label, record.mask, record.confidence) if file]
        if all((settings.folder / file).is_file() for file in files):
            small = entry.get("thumbnail")
            picture = (
                np.frombuffer(bytes.fromhex(small), np.uint8).reshape(64, 64).astype(np.float32) if small else None
            )
            return source, record, picture
    return source, *_ingest_one(source, settings)


def _ingest_one(source: Source, settings: Settings) -> tuple[ImageRecord, np.ndarray | None]:
    """Decode one photo, write its working copy, label and mask. A bad photo becomes a rejected record."""
    record = ImageRecord(name=source.name, source=str(source.path))
    try:
        photo = read_photo(source.path, settings.max_size, settings.exposure)
        width, height = photo.full_size
        aspect = max(width, height) / min(width, height)
        sphere = aspect == 2 and max(width, height) >= SPHERE_WIDTH
        if photo.facts.get("panorama") or aspect > MAX_ASPECT or sphere:
            raise InputError(f"a panorama ({width}×{height}): poses need single photos, not stitched ones")
        if min(width, height) < 64:
            raise InputError(f"too small ({width}×{height} pixels)")
    except InputError as error:
        record.status, record.reason = "rejected", str(error)
        return record, None
    record.sha256 = file_hash(source.path)
    image = photo.image
    record.width, record.height = image.size
    record.exif = {key: value for key, value in photo.facts.items() if key != "focal_px"}
    focal = photo.facts.get("focal_px")
    record.focal_px = focal * max(image.size) / max(photo.full_size) if focal else None
    record.camera_group = camera_group(photo.facts, image.size)
    record.sharpness = sharpness(image)
    suffix = ".jpg" if photo.lossy and image.mode == "RGB" else ".png"
    record.file = f"images/{source.name}{suffix}"
    with atomic_path(settings.folder / record.file) as path:
        image.save(path, quality=95, subsampling=0) if suffix == ".jpg" else image.save(path, compress_level=2)
    record.reason = "; ".join(_write_maps(record, source, photo, settings))
    return record, thumbnail(image)


def _write_maps(record: ImageRecord, source: Source, photo: Photo, settings: Settings) -> list[str]:
    """Write the label map, mask and confidence map of a photo, fitted to its working copy; what is wrong with them.

    A photo whose mask leaves nothing of it is marked as rejected.
    """
    problems = []
    for kind, given in (("label", source.label), ("mask", source.mask), ("confidence", source.confidence)):
        if given is None:
            continue
        try:
            if kind == "label":
                values = read_labels(given, settings.colors, settings.ignore_id)
            else:
                values = read_mask(given) if kind == "mask" else read_confidence(given)
            values, by_itself = turned_by_itself(values, given)
            turned, named = 1 if by_itself else photo.orientation, f"{kind} {given.name}"
            stored = settings.masks_as_stored if kind == "mask" else settings.labels_as_stored
            fitted = fit_to_photo(values, turned, photo.full_size, (record.width, record.height), named, stored)
        except InputError as error:
            problems.append(str(error))
            continue
        if kind == "mask" and not fitted.any():
            record.status = "rejected"
            return [f"{named} is black everywhere: white marks what counts"]
        file = f"{kind if kind == 'confidence' else kind + 's'}/{source.name}.png"
        with atomic_path(settings.folder / file) as path:
            small = fitted.astype(np.uint8) if fitted.max(initial=0) < 256 else fitted
            Image.fromarray(small).save(path, compress_level=2)
        setattr(record, kind, file)
    return problems


def camera_group(facts: dict[str, Any], size: tuple[int, int]) -> str:
    """Photos with equal groups share one camera model: same make, model, focal length and picture size."""
    parts = [str(facts.get("make", "")), str(facts.get("model", ""))]
    focal = facts.get("focal_mm")
    parts.append(f"{focal:.1f}mm" if focal else "")
    return " ".join([part for part in parts if part] + [f"{size[0]}x{size[1]}"])
