"""Which file belongs to which photo."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..files import is_text

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".exr", ".bmp", ".ppm", ".heic", ".heif")
# Bytes of a name of a file: file systems take 255, and "_confidence.png" and temporary endings come behind.
LONGEST = 200


def unique_names(paths: Sequence[Path], root: Path) -> list[str]:
    """A name for each image: its stem, or its path below `root` with "_" for separators when stems repeat.

    White space becomes "_", at which COLMAP's lists of names are split, and so do a "#" in front, which makes comments of
    their lines, and characters that Windows has no files with. Long names are cut, with a digest of the whole behind.
    """
    names = [path.stem for path in paths]
    if _alike(map(joined, names)):
        names = ["/".join(_below(path, root).with_suffix("").parts) for path in paths]
    names = [joined(name) for name in names]
    if _alike(names):  # a.jpg beside a.png
        names = [f"{name}_{path.suffix[1:].lower()}" for name, path in zip(names, paths)]
    if _alike(names):
        names = [f"{name}_{i}" for i, name in enumerate(names)]
    return names


def frame_names(places: Sequence[str]) -> list[str]:
    """A name for each frame of a cameras file by its `file_path`, which need not have a suffix: the last part of it, or
    all of it with "_" for separators where last parts repeat."""
    bare = [
        place[: -len(Path(place).suffix)] if Path(place).suffix.lower() in IMAGE_SUFFIXES else place for place in places
    ]
    names = [joined(Path(place).name) for place in bare]
    if _alike(names):
        names = [joined("/".join(part for part in Path(place).parts if part.strip("./"))) for place in bare]
    if _alike(names):
        names = [f"{name}_{i}" for i, name in enumerate(names)]
    return names


def file_names(names: Sequence[str]) -> list[str]:
    """A file name, without ending, for each of some names of classes or things, which may hold what file names may not."""
    plain = [_cut(re.sub(r"[^\w.-]+", "_", name).strip(".") or "_") for name in names]
    return [f"{name}_{i}" for i, name in enumerate(plain)] if _alike(plain) else plain


def _alike(names: Iterable[str]) -> bool:
    """Whether two names would be one file on Windows or macOS, which do not tell capitals apart."""
    folded = [name.casefold() for name in names]
    return len(set(folded)) < len(folded)


def joined(name: str) -> str:
    """A path as a name: "_" for separators, white space, a "#" in front and what Windows has no files with; long ones cut."""
    plain = "_".join(re.sub(r'[\\/:*?"<>|\x00-\x1f]', "_", name.replace("/", "_")).split())
    return _cut(re.sub("^#", "_", plain) or "photo")


def _cut(plain: str) -> str:
    """A name as long as file systems take it, with a digest of the whole behind where it is cut."""
    if len(plain.encode()) <= LONGEST:
        return plain
    return plain.encode()[: LONGEST - 9].decode(errors="ignore") + "~" + hashlib.sha256(plain.encode()).hexdigest()[:8]


def _below(path: Path, root: Path) -> Path:
    return path.relative_to(root) if path.is_relative_to(root) else Path(*path.parts[-2:])


def find_image(path: Path) -> Path | None:
    """The image file at `path`, or with a usual image suffix appended when the path has none."""
    if os.path.isfile(path):  # False, and no error, for names that are too long
        return path
    for suffix in IMAGE_SUFFIXES:
        for candidate in (path.with_name(path.name + suffix), path.with_name(path.name + suffix.upper())):
            if os.path.isfile(candidate):
                return candidate
    return None


def list_images(folder: Path) -> list[Path]:
    """Image files directly in `folder`, by name."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and is_text(p.name) and p.is_file())


def companion_stems(images: Sequence[Path], root: Path, names: Sequence[str]) -> list[list[str]]:
    """Under which stems the label map, mask… of each image is looked for, best first; "/" separates folders.

    The place below `root` with and without the image's own suffix, the image's name in the project, and its plain stem;
    none of them is that of two images.

    Args:
        images, names: the images, and what `unique_names` calls them.
    """
    below = []
    for image in images:
        parts = _below(image, root).parts
        below.append(Path(*(parts[1:] if parts[0] == "images" and len(parts) > 1 else parts)))
    wanted = [
        list(dict.fromkeys([place.as_posix(), place.with_suffix("").as_posix(), name, place.stem]))
        for place, name in zip(below, names)
    ]
    count = Counter(stem for stems in dict(zip(images, wanted)).values() for stem in stems)
    return [[stem for stem in stems if count[stem] == 1] for stems in wanted]


def beside_all(folder: Path | None, stems: Sequence[Sequence[str]], exact: bool = True) -> list[Path | None]:
    """The image in `folder` for each of `companion_stems`: `<stem>.png`, or when not `exact` also `<stem>_*.png|jpg`.

    No image is given away that bears another's stem.
    """
    if folder is None or not folder.is_dir():
        return [None] * len(stems)
    found = [next((p for stem in each if (p := beside(folder, stem))), None) for each in stems]
    if exact:
        return found
    owner = {stem: index for index, each in enumerate(stems) for stem in each}
    taken = set(found)
    for place in sorted({Path(stem).parent for stem in owner}):
        for file in list_images(folder / place):
            name = (place / file.name).as_posix()
            # "<stem>_mask.png", "<stem>.JPG.png"; not "<stem>0.png", which belongs to another photo.
            ends = (end for end in range(len(name) - 1, 0, -1) if name[:end] in owner and not name[end].isalnum())
            index = next((owner[name[:end]] for end in ends), None)
            if file not in taken and index is not None and found[index] is None:
                found[index] = file
    return found


def labels_and_masks(
    folder: Path, images: Sequence[Path], names: Sequence[str]
) -> list[tuple[Path | None, Path | None]]:
    """Label map and mask of each image of a data set, from the folders `labels` and `masks` in it."""
    stems = companion_stems(images, folder, names)
    return list(zip(beside_all(folder / "labels", stems), beside_all(folder / "masks", stems, exact=False)))


def beside(folder: Path, stem: str, exact: bool = True) -> Path | None:
    """The image in `folder` for a photo called `stem`: `<stem>.png`, or when not `exact` also `<stem>*.png|jpg`."""
    for suffix in (".png", ".PNG", ".tif", ".tiff", ".exr", ".jpg", ".JPG", ".jpeg"):
        if os.path.exists(folder / f"{stem}{suffix}"):  # a folder of that name is told of by who reads it
            return folder / f"{stem}{suffix}"
    if exact or not folder.is_dir():
        return None
    # "<stem>_mask.png", "<stem>.JPG.png"; not "<stem>0.png", which belongs to another photo.
    found = [p for p in list_images(folder) if p.name.startswith(stem) and not p.name[len(stem)].isalnum()]
    return found[0] if found else None


def plain_name(image: Path) -> str:
    """The name of an image in sets whose stems are unique."""
    return joined(image.stem)
