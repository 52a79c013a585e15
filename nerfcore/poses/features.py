"""Features and matches in COLMAP's database, with progress read from it. Runs in the pose process."""

from __future__ import annotations

import shutil
import time
import zlib  # noqa: F401  (must be loaded before pycolmap, which exports a static zlib)
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .presets import Level

# Not tuned, but for the last two: docs/experiments.md, “What the pose stage was made of”.
FULL_MODEL_FROM = 15  # photos of one camera at which its lens has more than one term of distortion
LONG_LENS = 1.5  # focal length in long sides from which a lens counts as long (view narrower than 37°)
FOCAL_GUESS = 0.85  # of the long side, where EXIF says nothing: 31 mm in terms of 35 mm film
RETRIEVAL_FEATURES = 256  # of a photo; fewer where photos are many, which are all compared
PAIRS_PER_IMAGE = 16
BUSY_SECONDS = 5.0  # how long a database may be in another process' hands
SQLITE_HEADER = b"SQLite format 3\0"  # sqlite.org/fileformat.html, section 1.3


@contextmanager
def database(path: Path) -> Iterator[Any]:
    """An open pycolmap database, closed afterwards."""
    opened = _opened(path)
    try:
        yield opened
    finally:
        opened.close()


def _opened(path: Path) -> Any:
    """A database, which the process that counts its rows may hold for a moment: COLMAP does not wait for it."""
    end = time.monotonic() + BUSY_SECONDS
    while True:
        try:
            return pycolmap.Database.open(str(path))
        except RuntimeError as error:
            if time.monotonic() > end or not _is_database(path) or "database factory" not in str(error):
                raise
        time.sleep(0.05)


def _is_database(path: Path) -> bool:
    """Whether a file begins as SQLite's do: what does not is damaged, and waiting would not help."""
    try:
        with path.open("rb") as file:
            return file.read(len(SQLITE_HEADER)) == SQLITE_HEADER
    except OSError:
        return False


@contextmanager
def watched(path: Path, table: str, total: int, tell: Any, noun: str) -> Iterator[None]:
    """While the block runs, progress is the number of new rows in a table of the database.

    The parent process counts them: two copies of SQLite (Python's and COLMAP's) in one process undo each other's locks.
    """
    with database(path):  # while it is open here, COLMAP's own opening meets no lock of the parent
        tell.watch(str(path), table, total, noun)
        try:
            yield
        finally:
            tell.watch_end()


def copy_database(path: Path, target: Path) -> Path:
    """Copy a database that nobody has open, with its write-ahead log; returns `target`."""
    for suffix in ("", "-wal", "-shm"):
        source, copy = Path(f"{path}{suffix}"), Path(f"{target}{suffix}")
        copy.unlink(missing_ok=True)
        if source.is_file() and suffix != "-shm":
            shutil.copyfile(source, copy)
    return target


def add_images(path: Path, image_folder: Path, images: list[dict[str, Any]]) -> None:
    """Enter images into the database, one camera per group. Those already in it stay as they are.

    `images` have file, group, width, height and focal_px (or None).
    """
    with database(path) as db:
        known = {image.name: image.camera_id for image in db.read_all_images()}
    groups: dict[str, list[dict[str, Any]]] = {}
    for image in images:
        groups.setdefault(image["group"], []).append(image)
    for group in groups.values():
        missing = [image["file"] for image in group if image["file"] not in known]
        if not missing:
            continue
        options = pycolmap.ImageReaderOptions()
        model, params = start_camera(group)
        options.camera_model = model
        options.camera_params = ",".join(repr(p) for p in params)
        present = [known[image["file"]] for image in group if image["file"] in known]
        if present:
            options.existing_camera_id = present[0]
        pycolmap.import_images(path, image_folder, pycolmap.CameraMode.SINGLE, missing, options)
        if not present and not any(image["focal_px"] for image in group):
            # import_images takes given parameters for measured ones; a guess must not count as that.
            with database(path) as db:
                camera = db.read_camera(db.read_image_with_name(missing[0]).camera_id)
                camera.has_prior_focal_length = False
                db.update_camera(camera)


def start_camera(group: list[dict[str, Any]], full: bool = False) -> tuple[str, list[float]]:
    """COLMAP model and first parameters for the photos of one camera."""
    width, height = group[0]["width"], group[0]["height"]
    known = [image["focal_px"] for image in group if image["focal_px"]]
    focal = float(np.median(known)) if known else FOCAL_GUESS * max(width, height)
    if full:
        return "RADIAL", [focal, width / 2, height / 2, 0.0, 0.0]
    return "SIMPLE_RADIAL", [focal, width / 2, height / 2, 0.0]


def wants_full_model(group: list[dict[str, Any]]) -> bool:
    """Whether a lens may have two terms of distortion from the start: many photos, and no narrow view.

    On narrow views of few points (an object shot with a long lens) the extra parameters run away.
    """
    _, params = start_camera(group)
    return len(group) >= FULL_MODEL_FROM and params[0] < LONG_LENS * max(group[0]["width"], group[0]["height"])


def set_lenses(path: Path, images: list[dict[str, Any]], full: bool) -> bool:
    """Reset every lens in the database to its first parameters, in the full or in the simple model.

    Returns:
        whether any lens has the full model.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for image in images:
        groups.setdefault(image["group"], []).append(image)
    any_full = False
    with database(path) as db:
        for group in groups.values():
            chosen = full and wants_full_model(group)
            any_full |= chosen
            model, params = start_camera(group, chosen)
            camera = db.read_camera(db.read_image_with_name(group[0]["file"]).camera_id)
            camera.model = getattr(pycolmap.CameraModelId, model)
            camera.params = params
            db.update_camera(camera)
    return any_full


def extract(path: Path, image_folder: Path, masks: Path | None, names: list[str], level: Level, tell: Any) -> None:
    """Find the features of all images that have none yet."""
    with database(path) as db:
        missing = [image.name for image in db.read_all_images() if not db.exists_keypoints(image.image_id)]
    missing = [name for name in missing if name in set(names)]
    if not missing:
        return
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = level.size
    options.use_gpu = False
    options.sift.max_num_features = level.features
    options.sift.first_octave = level.octave
    options.sift.estimate_affine_shape = level.affine
    options.sift.domain_size_pooling = level.affine
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = str(masks)
    tell.stage("Finding features")
    with watched(path, "keypoints", len(missing), tell, "photos"):
        pycolmap.extract_features(
            path, image_folder, missing, reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu
        )


def match(path: Path, pairs: list[tuple[str, str]], list_file: Path, tell: Any) -> None:
    """Match and verify the pairs; those in the database already are not matched again."""
    if not pairs:
        return
    with database(path) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        todo = [(a, b) for a, b in pairs if a in ids and b in ids and not db.exists_two_view_geometry(ids[a], ids[b])]
    if not todo:
        return
    list_file.write_text("".join(f"{a} {b}\n" for a, b in todo), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(list_file)
    pairing.block_size = 40  # finished blocks survive a kill
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    tell.stage("Matching features")

    with watched(path, "two_view_geometries", len(todo), tell, "pairs"):
        pycolmap.match_image_pairs(path, matching, pairing, device=pycolmap.Device.cpu)


def all_pairs(names: list[str]) -> list[tuple[str, str]]:
    return list(combinations(sorted(names), 2))


def likely_pairs(path: Path, names: list[str], neighbours: int, tell: Any) -> list[tuple[str, str]]:
    """Pairs worth matching in a large capture: each image's best mates by retrieval, and its neighbours by name.

    Retrieval matches the largest features of every two images by mutual nearest neighbours with a ratio test.
    """
    tell.stage("Looking for overlapping photos")
    ordered = sorted(names)
    count = max(64, min(RETRIEVAL_FEATURES, round(RETRIEVAL_FEATURES * (400 / len(ordered)) ** 0.5)))
    with database(path) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        descriptors = [largest_features(db, ids[name], count) for name in ordered]
    pairs = {
        (ordered[i], ordered[j])
        for i in range(len(ordered))
        for j in range(i + 1, min(i + 1 + neighbours, len(ordered)))
    }
    scores = np.zeros((len(ordered), len(ordered)))
    for i in range(len(ordered)):
        tell.progress(i / len(ordered), f"{i} of {len(ordered)} photos")
        for j in range(i):
            scores[i, j] = scores[j, i] = mutual_matches(descriptors[i], descriptors[j])
    for i in range(len(ordered)):
        for j in np.argsort(-scores[i], kind="stable")[:PAIRS_PER_IMAGE]:
            if scores[i, j] > 0 and i != j:
                pairs.add((ordered[min(i, j)], ordered[max(i, j)]))
    return sorted(pairs)


def largest_features(db: Any, image_id: int, count: int) -> np.ndarray:
    """Unit descriptors (≤ count, 128) of the features of largest scale."""
    keypoints = np.asarray(db.read_keypoints(image_id))
    stored = db.read_descriptors(image_id)
    descriptors = np.asarray(getattr(stored, "data", stored), np.float32)
    if len(keypoints) == 0:
        return np.zeros((0, 128), np.float32)
    scale = keypoints[:, 2] if keypoints.shape[1] == 4 else np.hypot(keypoints[:, 2], keypoints[:, 4])
    picked = descriptors[np.argsort(-scale, kind="stable")[:count]]
    return picked / np.maximum(np.linalg.norm(picked, axis=1, keepdims=True), 1e-6)


def mutual_matches(a: np.ndarray, b: np.ndarray, ratio: float = 0.85) -> int:
    """Number of mutual nearest neighbours between unit descriptors (N, D) and (M, D) that pass a ratio test."""
    if len(a) < 2 or len(b) < 2:
        return 0
    similarity = a @ b.T
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == np.arange(len(a))
    top = np.partition(similarity, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2 - 2 * top, 0))
    return int((mutual & (distance[:, 1] < ratio * distance[:, 0])).sum())
