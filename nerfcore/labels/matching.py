"""Which photo of a project the pictures of another labelling tool show, by the names that tool has for them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from ..images.names import joined
from ..images.suffixes import PHOTO_SUFFIXES
from ..project.schema import ImageRecord


class Photos:
    """Photos by their names. These are made of places: `cam0/1.jpg` is called `cam0_1` where several folders have a `1.jpg`."""

    def __init__(self, photos: Iterable[ImageRecord]) -> None:
        self._by_name = {photo.name: photo for photo in photos}
        called: dict[str, set[str]] = {}
        for photo in self._by_name.values():
            for name in (photo.name, joined(Path(photo.source).stem)):
                called.setdefault(name, set()).add(photo.name)
        self._by_stem = {stem: self._by_name[min(names)] for stem, names in called.items() if len(names) == 1}

    def by_place(self, picture: str) -> ImageRecord | None:
        """The photo whose name is made of the whole path of a picture."""
        return _first(self._by_name, _parts(picture))

    def by_end(self, picture: str) -> ImageRecord | None:
        """The photo that the end of a picture's path names, as paths may begin anywhere; a bare name where it is that of
        one photo only."""
        parts = _parts(picture)
        for first in range(1, len(parts) - 1):
            photo = _first(self._by_name, parts[first:])
            if photo is not None:
                return photo
        return _first(self._by_stem, parts[-1:])


def _first(photos: dict[str, ImageRecord], parts: list[str]) -> ImageRecord | None:
    return next((photos[name] for name in _names(parts) if name in photos), None)


def _parts(picture: str) -> list[str]:
    return [part for part in picture.replace("\\", "/").split("/") if part not in ("", ".", "..")]


def _names(parts: list[str]) -> list[str]:
    """What a photo at a place may be called, as `images.names.unique_names` does, likeliest first."""
    place = "/".join(parts)
    suffix = PurePosixPath(place).suffix
    if not suffix:
        return [joined(place)]
    stem = joined(place.removesuffix(suffix))
    names = [stem, f"{stem}_{suffix[1:].lower()}"]
    own = PurePosixPath(stem).suffix  # masks may be called a.jpg.png
    if own.lower() in PHOTO_SUFFIXES:
        names += [stem.removesuffix(own), f"{stem.removesuffix(own)}_{own[1:].lower()}"]
    return names if suffix.lower() in PHOTO_SUFFIXES else [joined(place), *names]


class Claims:
    """Which pictures hit which photo: those that name its whole place count before those that name the end of it."""

    def __init__(self, photos: Photos) -> None:
        self._photos = photos
        self._sure: dict[str, list[str]] = {}
        self._guessed: dict[str, list[str]] = {}

    def photo_of(self, picture: str) -> ImageRecord | None:
        """The photo of a picture; None where it is of none, or another picture names that photo better."""
        photo = self._photos.by_place(picture)
        if photo is not None:
            self._sure.setdefault(photo.name, []).append(picture)
            return photo
        photo = self._photos.by_end(picture)
        if photo is None:
            return None
        self._guessed.setdefault(photo.name, []).append(picture)
        return None if photo.name in self._sure else photo

    def doubtful(self) -> dict[str, list[str]]:
        """Photos that more than one picture may be of, none of which names it better, with the pictures."""
        return {
            name: pictures for name, pictures in self._guessed.items() if len(pictures) > 1 and name not in self._sure
        }

    def repeated(self) -> dict[str, list[str]]:
        """Photos that more than one picture names, with the pictures."""
        return {name: pictures for name, pictures in self._sure.items() if len(pictures) > 1}

    def outdone(self) -> list[str]:
        """Pictures that might have been of a photo which another one names better."""
        return [picture for name, pictures in self._guessed.items() if name in self._sure for picture in pictures]
