"""Which files a capture consists of: photos, and the label maps, masks and classes that belong to them."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..files import is_text, printable, require_readable
from ..images.names import beside_all, companion_stems, unique_names
from ..images.soft_labels import find_confidence, find_probabilities
from ..images.suffixes import CAMERA_SUFFIXES, PHOTO_SUFFIXES, RAW_SUFFIXES, VIDEO_SUFFIXES
from ..project.store import PROJECT_FILE

# Files that lie beside photos and are none.
SIDECARS = {".json", ".txt", ".md", ".xmp", ".aae", ".csv", ".npy", ".npz", ".db", ".ini", ".xml", ".thm", ".log", ""}


@dataclass(frozen=True)
class Source:
    """One candidate photo with the label and mask found for it."""

    name: str
    path: Path
    label: Path | None
    mask: Path | None
    confidence: Path | None


def list_photos(folder: Path, exclude: Iterable[Path | None] = ()) -> tuple[list[Path], list[dict[str, str]], Path]:
    """Photos below `folder` (subfolders are cameras of one capture), files skipped with reasons, and the root.

    Projects that lie in there are left out: their pictures are copies and renders.

    Raises:
        InputError: the folder is missing, unreadable or has no photos.
    """
    if not folder.exists():
        raise InputError(f"{folder} does not exist.", "Choose a folder of photos or a video file.")
    if folder.is_file():
        raise InputError(f"{folder} is neither a folder of photos nor a video that Fieldwork reads.", "Choose another.")
    require_readable(folder)
    root = folder / "images" if (folder / "images").is_dir() else folder
    skip_folders = {Path(p).resolve() for p in exclude if p} | {
        (folder / name).resolve() for name in ("labels", "masks", "depth")
    }
    photos, skipped = [], []
    problems: list[OSError] = []
    for place, folders, files in os.walk(root, onerror=problems.append):
        here = Path(place)
        inner = sorted(f for f in folders if not f.startswith(".") and (here / f).resolve() not in skip_folders)
        inner = [name for name in inner if not os.path.isfile(here / name / PROJECT_FILE)]
        odd = {name: _odd_folder(here / name) for name in inner}
        folders[:] = [name for name in inner if not odd[name]]
        skipped += [{"file": printable(name), "reason": reason} for name, reason in odd.items() if reason]
        for name in sorted(files):
            suffix = Path(name).suffix.lower()
            if name.startswith(".") or suffix in SIDECARS:
                continue
            wrong = _odd_file(here / name)
            if wrong:
                skipped.append({"file": printable(name), "reason": wrong})
            elif suffix in PHOTO_SUFFIXES:
                photos.append(here / name)
            elif suffix in VIDEO_SUFFIXES:
                skipped.append({"file": name, "reason": "a video among photos: give it alone as --photos"})
            else:
                skipped.append({"file": name, "reason": f"{suffix} is not a photo format that Fieldwork reads"})
    photos, twice = _without_developed(photos)
    skipped += twice
    for problem in problems:
        if Path(str(problem.filename)) == root:
            raise InputError(f"{root} cannot be read: {problem.strerror}.", "Check its permissions.")
        skipped.append({"file": str(problem.filename), "reason": f"folder cannot be read: {problem.strerror}"})
    if not photos:
        raise InputError(
            f"There are no photos in {folder}.", "Choose a folder with JPEG, PNG, TIFF, HEIC or raw files."
        )
    return photos, skipped, root


def _without_developed(photos: list[Path]) -> tuple[list[Path], list[dict[str, str]]]:
    """Photos without the raw files that the camera's own picture lies beside (RAW + JPEG), and those with the reason."""
    developed = {p.with_suffix("").as_posix().casefold(): p.name for p in photos if p.suffix.lower() in CAMERA_SUFFIXES}
    kept, skipped = [], []
    for path in photos:
        own = developed.get(path.with_suffix("").as_posix().casefold())
        if own is not None and path.suffix.lower() in RAW_SUFFIXES:
            skipped.append({"file": path.name, "reason": f"the camera's own picture of it is used, {own}"})
        else:
            kept.append(path)
    return kept, skipped


def _odd_folder(path: Path) -> str:
    """Why a folder among photos is not looked into; empty for a good one."""
    if not is_text(path.name):
        return "its name is not UTF-8: rename it"
    if path.is_symlink():
        return "a link to a folder, which is not followed: give that folder instead"
    return "a folder, whatever its name says" if path.suffix.lower() in PHOTO_SUFFIXES else ""


def _odd_file(path: Path) -> str:
    """Why something among photos is no file that could be read; empty for a good one."""
    if not is_text(path.name):
        return "its name is not UTF-8: rename it"
    try:
        mode = path.stat().st_mode
    except OSError as error:
        reasons = {errno.ENOENT: "a link that leads nowhere", errno.ELOOP: "a link that leads to itself"}
        return reasons.get(error.errno or 0, f"it cannot be read: {error.strerror}")
    return "" if stat.S_ISREG(mode) else "not a file: a pipe, socket or device"


def classes_beside(labels: Path | None) -> Path | None:
    """classes.json in the labels folder or next to it, when none is given."""
    if labels is None:
        return None
    return next((p for p in (labels / "classes.json", labels.parent / "classes.json") if p.is_file()), None)


def subfolder(photos: Path, name: str) -> Path | None:
    """A folder of that name in the folder of photos, if there is one."""
    return photos / name if (photos / name).is_dir() else None


def find_sources(
    paths: list[Path],
    root: Path,
    labels: Path | None,
    masks: Path | None,
    taken: set[str],
    known: dict[Path, str] | None = None,
) -> list[Source]:
    """Photos below `root` with names of their own, not among `taken`, and their labels and masks.

    `known`: names that photos, by their resolved paths, have in the project; they keep them, as marks, poses and runs know
    photos by name.

    Raises:
        InputError: the folder of labels or of masks does not exist.
    """
    for folder, what in ((labels, "labels"), (masks, "masks")):
        if folder is not None and not folder.is_dir():
            raise InputError(f"The {what} folder {folder} does not exist.", f"Choose the folder that holds the {what}.")
    names = unique_names(paths, root)
    stems = companion_stems(paths, root, names)
    left = dict(known or {})  # each name is given once: two paths may lead to one file
    before = [left.pop(path.resolve(), None) for path in paths]
    others = {stem for own in stems for stem in own}
    stems = [[*own, name] if name and name not in others else own for own, name in zip(stems, before)]
    pictures, drawn = beside_all(labels, stems, exact=False), beside_all(masks, stems, exact=False)
    sources, taken = [], {name.casefold() for name in [*taken, *filter(None, before)]}
    for path, name, had, own, picture, mask in zip(paths, names, before, stems, pictures, drawn):
        unique = had or name
        while had is None and unique.casefold() in taken:
            unique += "_b"
        taken.add(unique.casefold())
        label = (find_probabilities(labels, own) or picture) if labels else None
        confidence = find_confidence(labels, own, label) if labels else None
        sources.append(Source(unique, path, label, mask, confidence))
    return sources
