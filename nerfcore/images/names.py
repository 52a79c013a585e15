"""Which file belongs to which photo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".exr", ".bmp", ".ppm", ".heic", ".heif")


def unique_names(paths: Sequence[Path], root: Path) -> list[str]:
    """A name for each image: its stem, or its path below `root` with "_" for separators when stems repeat.

    White space becomes "_": COLMAP's lists of names are split at it.
    """
    names = [path.stem for path in paths]
    if len(set(map(_joined, names))) < len(names):
        names = ["/".join(_below(path, root).with_suffix("").parts) for path in paths]
    names = [_joined(name) for name in names]
    if len(set(names)) < len(names):  # a.jpg beside a.png
        names = [f"{name}_{path.suffix[1:].lower()}" for name, path in zip(names, paths)]
    if len(set(names)) < len(names):
        names = [f"{name}_{i}" for i, name in enumerate(names)]
    return names


def _joined(name: str) -> str:
    return "_".join(name.replace("/", "_").split()) or "photo"


def _below(path: Path, root: Path) -> Path:
    return path.relative_to(root) if path.is_relative_to(root) else Path(*path.parts[-2:])


def find_image(path: Path) -> Path | None:
    """The image file at `path`, or with a usual image suffix appended when the path has none."""
    if path.is_file():
        return path
    for suffix in IMAGE_SUFFIXES:
        for candidate in (path.with_name(path.name + suffix), path.with_name(path.name + suffix.upper())):
            if candidate.is_file():
                return candidate
    return None


def list_images(folder: Path) -> list[Path]:
    """Image files directly in `folder`, by name."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())


def beside(folder: Path, stem: str, exact: bool = True) -> Path | None:
    """The image in `folder` for a photo called `stem`: `<stem>.png`, or when not `exact` also `<stem>*.png|jpg`."""
    for suffix in (".png", ".PNG", ".tif", ".tiff", ".exr", ".jpg", ".JPG", ".jpeg"):
        if (folder / f"{stem}{suffix}").is_file():
            return folder / f"{stem}{suffix}"
    if exact or not folder.is_dir():
        return None
    # "<stem>_mask.png", "<stem>.JPG.png"; not "<stem>0.png", which belongs to another photo.
    found = [p for p in list_images(folder) if p.name.startswith(stem) and not p.name[len(stem)].isalnum()]
    return found[0] if found else None


def plain_name(image: Path) -> str:
    """The name of an image in sets whose stems are unique."""
    return _joined(image.stem)
