"""The verb `new`: photos or a video become a capture project with upright, shrunk, labelled working copies."""

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

from ..errors import InputError, ProjectError
from ..files import atomic_path, file_hash, write_json
from ..images.decode import float_exposure, is_linear, read_photo
from ..images.labels import Colors, drawn_as_stored, fit_to_photo, read_labels, read_mask, turned_by_itself
from ..images.sharpness import sharpness, thumbnail
from ..images.soft_labels import read_confidence
from ..params import NewParams
from ..progress import Reporter, shortened
from ..project.classes import make_classes, read_classes
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, files_digest, stamps_digest
from ..project.schema import ImageRecord, Project
from ..project.store import PROJECT_FILE, create_folder, edit_project, load_project
from .find import Source, classes_beside, find_sources, list_photos, subfolder
from .select import reject_blurred, reject_duplicates
from .video import VIDEO_SUFFIXES, extract_frames

CACHE_FILE = "jobs/ingested.json"
FRAMES_FOLDER = "frames"
MAX_ASPECT = 3.0
SPHERE_WIDTH = 5000


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


def new(params: NewParams, report: Reporter) -> dict[str, Any]:
    """Ingest a folder of photos, or a video, into a project.

    Running it again over the same photos only does what is missing; with `add` it puts further photos into an
    existing project.

    Returns:
        {"images": count, "rejected": [{"file", "reason"}], "labelled", "masked", "classes": [names]}
    Raises:
        InputError: there is no usable photo, or the classes file is unusable.
        ProjectError: the folder holds another capture.
        DiskError: it cannot be written.
    """
    folder, photos = Path(params.project), Path(params.photos)
    inputs = ingest_inputs(params)
    previous = _previous_project(params)
    names, ignore_id, colors = {}, 0, {}
    classes_file = params.classes or classes_beside(params.labels)
    if classes_file:
        names, ignore_id, colors = read_classes(classes_file)
    create_folder(folder)
    _remove_halves(folder)
    if photos.is_file() and photos.suffix.lower() in VIDEO_SUFFIXES:
        report.stage("Choosing frames of the video")
        paths = extract_frames(photos, folder / FRAMES_FOLDER, params.frames, report)
        skipped: list[dict[str, str]] = []
        root = folder / FRAMES_FOLDER
    else:
        paths, skipped, root = list_photos(photos, exclude=[params.labels, params.masks])
    labels_folder = params.labels or subfolder(photos, "labels")
    masks_folder = params.masks or subfolder(photos, "masks")
    kept = [record for record in previous.images if record.file] if previous and params.add else []
    sources = find_sources(paths, root, labels_folder, masks_folder, {record.name for record in kept})
    floats = [path for path in paths if is_linear(path)]
    stored = [
        _drawn_as_stored([(s.path, s.label) for s in sources], "label maps", report),
        _drawn_as_stored([(s.path, s.mask) for s in sources], "masks", report),
    ]
    settings = Settings(folder, params.max_size, float_exposure(floats), colors or None, ignore_id, *stored)

    report.stage("Reading photos")
    records, pictures = _ingest_all(sources, settings, report)
    # Video frames were chosen for sharpness, and a still camera on a tripod may well repeat itself there.
    reject_duplicates(records, pictures, kept)
    if not params.keep_blurry:
        reject_blurred(records)
    records = kept + records
    _check_usable(records, photos, skipped)
    for record in records:
        if record.status != "rejected" and record.reason:
            report.warn(f"{record.name}: {record.reason}")
    present = _present_ids(folder, records, report)
    rejected = skipped + [
        {"file": Path(record.source).name, "reason": record.reason} for record in records if record.status == "rejected"
    ]
    used = [record for record in records if record.status != "rejected"]
    if rejected:
        reasons = [f"{item['file']} ({item['reason']})" for item in rejected]
        report.warn(shortened(f"{len(rejected)} of {len(used) + len(rejected)} files were left out", reasons))
    if len(used) < 3:
        number = "one usable photo" if len(used) == 1 else f"{len(used)} usable photos"
        report.warn(f"Only {number}: camera poses need at least three, better twenty.")
    result: dict[str, Any] = {
        "images": len(used),
        "rejected": rejected,
        "labelled": sum(record.label is not None for record in used),
        "masked": sum(record.mask is not None for record in used),
    }
    origin = {"video_sha256": file_hash(photos)} if photos.is_file() else {}
    with edit_project(folder, Project(mask_mode=params.mask_mode)) as project:
        _put_in(project, records, present, (names, ignore_id, colors), params, previous is not None)
        result["classes"] = [c.name for c in project.classes]
        project.record("new", params.model_dump(mode="json"), result | origin, inputs)
    return result


def ingest_inputs(params: NewParams) -> Fingerprint:
    """What the working copies of a capture depend on, by the names, sizes and times of its files.

    Raises:
        InputError: there are no photos.
    """
    photos = Path(params.photos)
    given = [params.labels, params.masks]
    paths, root = [photos], photos.parent
    if photos.suffix.lower() not in VIDEO_SUFFIXES or not photos.is_file():
        paths, _, root = list_photos(photos, exclude=given)
    labels = params.labels or subfolder(photos, "labels")
    masks = params.masks or subfolder(photos, "masks")
    sources = find_sources(paths, root, labels, masks, set())
    if paths == [photos]:  # frames of a video are named later
        sources_of = {
            "labels": sorted(labels.rglob("*")) if labels else [],
            "masks": sorted(masks.rglob("*")) if masks else [],
        }
    else:
        sources_of = {
            "labels": [f for s in sources for f in (s.label, s.confidence)],
            "masks": [s.mask for s in sources],
        }
    classes_file = params.classes or classes_beside(params.labels)
    chosen = params.model_dump(mode="json", include={"mask_mode", "max_size", "frames", "keep_blurry"})
    return {
        "photos": digest([[str(path.relative_to(root)) for path in paths], stamps_digest(paths)]),
        **{name: stamps_digest(files) for name, files in sources_of.items()},
        "classes file": files_digest([("classes", classes_file)]),
        "settings": digest(chosen),
    }


def ingested(params: NewParams) -> Earlier:
    """The working copies that are there, if they are of the present files.

    Raises:
        InputError: there are no photos. ProjectError: the folder holds another capture.
    """
    previous = _previous_project(params)
    if previous is None:
        return Earlier()
    made = next((s for s in reversed(previous.provenance) if s.verb == "new" and not s.settings.get("add")), None)
    folder = Path(params.project)
    files = [folder / file for r in previous.images for file in (r.file, r.label, r.mask, r.confidence) if file]
    return compare(made, ingest_inputs(params), files)


def _drawn_as_stored(pairs: list[tuple[Path, Path | None]], what: str, report: Reporter) -> bool:
    """Whether maps were drawn on the stored pixels of photos, see `labels.drawn_as_stored`; a guess is said."""
    stored, doubtful = drawn_as_stored(pairs)
    if doubtful:
        text = f"{what} of photos that EXIF turns over or mirrors are taken to show the photos as they are stored"
        report.warn(shortened(text, doubtful))
    return stored


def _previous_project(params: NewParams) -> Project | None:
    """The project that is there already, if these photos may go into it."""
    folder = Path(params.project)
    if not (folder / PROJECT_FILE).exists():
        if params.add:
            raise ProjectError(f"{folder} has no project to add photos to.", "Leave out --add to make a new one.")
        return None
    project = load_project(folder)
    if params.add:
        return project
    first = project.provenance[0] if project.provenance else None
    if first is None or first.verb != "new" or not _same_place(first.settings.get("photos"), params.photos):
        raise ProjectError(
            f"{folder} already holds another capture.", "Choose a new folder, or --add to put these photos into it."
        )
    return project


def _same_place(before: Any, now: Path) -> bool:
    return Path(str(before)) == Path(now) or Path(str(before)).resolve() == Path(now).resolve()


def _remove_halves(folder: Path) -> None:
    """Delete what a run that was killed had half written: hidden files in the folders of working copies."""
    for name in ("images", "labels", "masks", "confidence"):
        for path in (folder / name).glob(".*"):
            path.unlink(missing_ok=True)


def _ingest_all(
    sources: list[Source], settings: Settings, report: Reporter
) -> tuple[list[ImageRecord], dict[str, np.ndarray]]:
    """Ingest every photo on a few threads; finished ones are remembered in the project, so a rerun skips them."""
    cache = _load_cache(settings.folder)
    done: dict[str, tuple[ImageRecord, np.ndarray | None]] = {}
    workers = max(1, min(4, os.cpu_count() or 1))
    saved = time.monotonic()
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
                if time.monotonic() - saved > 3:
                    write_json(settings.folder / CACHE_FILE, cache)
                    saved = time.monotonic()
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
        # Exactly 2:1 and large is how full spheres are stored.
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
            fitted = fit_to_photo(values, turned, photo.full_size, image.size, named, stored)
        except InputError as error:
            problems.append(str(error))
            continue
        file = f"{kind if kind == 'confidence' else kind + 's'}/{source.name}.png"
        with atomic_path(settings.folder / file) as path:
            small = fitted.astype(np.uint8) if fitted.max(initial=0) < 256 else fitted
            Image.fromarray(small).save(path, compress_level=2)
        setattr(record, kind, file)
    record.reason = "; ".join(problems)
    return record, thumbnail(image)


def camera_group(facts: dict[str, Any], size: tuple[int, int]) -> str:
    """Photos with equal groups share one camera model: same make, model, focal length and picture size."""
    parts = [str(facts.get("make", "")), str(facts.get("model", ""))]
    focal = facts.get("focal_mm")
    parts.append(f"{focal:.1f}mm" if focal else "")
    return " ".join([part for part in parts if part] + [f"{size[0]}x{size[1]}"])


def _check_usable(records: list[ImageRecord], photos: Path, skipped: list[dict[str, str]]) -> None:
    if any(record.status != "rejected" for record in records):
        return
    first = next((record for record in records if record.reason), None)
    why = f" ({Path(first.source).name}: {first.reason})" if first else ""
    raise InputError(
        f"None of the {len(records) + len(skipped)} files in {photos} is a usable photo{why}.", "Choose other photos."
    )


def _present_ids(folder: Path, records: list[ImageRecord], report: Reporter) -> set[int]:
    """Class ids that occur in the label maps of the project."""
    present: set[int] = set()
    for record in records:
        if record.label:
            report.check()
            with Image.open(folder / record.label) as image:
                present |= set(np.unique(np.asarray(image)).tolist())
    return present


def _put_in(
    project: Project,
    records: list[ImageRecord],
    present: set[int],
    classes: tuple[dict[int, str], int, Colors],
    params: NewParams,
    there: bool,
) -> None:
    """Put the photos into the project, and the classes: those named (names, void id, colours), and those `present` in
    the label maps without a name. `there`: the project was there before."""
    names, ignore_id, colors = classes
    if not params.add:
        # A rerun keeps what was decided about the same photos later.
        old = {record.name: record for record in project.images}
        for record in records:
            before = old.get(record.name)
            if before and before.sha256 == record.sha256:
                record.split = before.split
                if record.status == "ok" and before.status == "unregistered":
                    record.status, record.reason = before.status, before.reason
    project.images = records
    if params.masks or not there:
        project.mask_mode = params.mask_mode
    known = {c.id: c for c in project.classes}
    if names or not known:
        project.ignore_id = ignore_id
        named = {**{i: f"class {i}" for i in present}, **names}
    else:
        named = {**{i: f"class {i}" for i in present}, **{c.id: c.name for c in project.classes}}
    # A class keeps what was decided about it earlier, unless the classes file says otherwise now.
    project.classes = make_classes(named, project.ignore_id, colors)
    for i, c in enumerate(project.classes):
        if c.id in known:
            said = {"name": c.name} | ({"color": c.color} if c.id in colors else {})
            project.classes[i] = known[c.id].model_copy(update=said)
