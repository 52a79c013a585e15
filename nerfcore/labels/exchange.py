"""The verbs `label import` and `label export`: label maps of the photos from and for other labelling tools."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ..errors import InputError, ProjectError, SettingError
from ..files import atomic_path, disk_errors, staged
from ..images.encode import write_picture
from ..images.labels import fit_to_photo
from ..images.working import nearest, read_label
from ..params import LabelExportParams, LabelImportParams
from ..progress import Reporter
from ..project.classes import MOST_CLASSES, class_color
from ..project.label_revision import is_made, map_revision
from ..project.schema import ImageRecord, Project, SemanticClass
from ..project.store import edit_project, load_project
from .formats import known
from .formats.regions import LabelClass, Picture, Region, Source
from .history import write_history
from .journal import read_marks, shown_revision, taken_ids
from .matching import Claims, Photos
from .overlay import photo_labels
from .propagate import propagated_labels

IMPORTED = "labels/imported"  # of the project
INSTANCES = "instances"  # in that folder
VOID_NAMES = {"void", "unlabelled", "unlabeled", "unassigned", "ignore"}  # background is a class like any other
MOST_TOLD = 5  # names in one message
MOST_INSTANCES = 65535


def import_labels(params: LabelImportParams, report: Reporter) -> dict[str, Any]:
    """Give photos the labels of a file that another tool wrote. Pixels that nobody assigned are unlabelled.

    Returns:
        {"format", "photos": number that got labels, "kept": names of those that have labels of their own, "unknown":
        pictures that are no photo of the project, "classes": names that occur, "instances", "skipped": shapes without
        area by kind}
    Raises:
        InputError: the file cannot be read, none of its pictures is a photo of the project, or it has too many classes.
        ProjectError, DiskError, Cancelled: the project is as before.
    """
    folder, path = Path(params.project), Path(params.file)
    project = load_project(folder)
    kind = known.format_of(path) if params.format == "auto" else params.format
    source = known.read(path, kind, label_classes(project), project.ignore_id, params.class_name)
    report.stage("Reading labels")
    classes = Classes(project, source, taken_ids(folder, project))
    # Maps that photos have already stay as they are until all of the new ones are there.
    with staged(folder / IMPORTED) as place:
        brought = _bring(source, project, classes, place, params.replace, report)
        tell(report, brought, source)
        if not brought.maps and not brought.kept:
            raise InputError(
                f"No picture in {path} is a photo of {folder}.",
                "Pictures are matched by their names without suffix: compare the two.",
            )
        classes.with_new(load_project(folder))  # while no map was changed yet
    result = {
        "format": kind,
        "photos": len(brought.maps),
        "kept": brought.kept,
        "unknown": brought.unknown,
        "classes": sorted(classes.used),
        "instances": sum(brought.instances.values()),
        "skipped": dict(source.skipped),
    }
    with edit_project(folder) as edited:
        edited.classes = classes.with_new(edited)
        for image in edited.images:
            if image.name in brought.maps:
                image.label, image.instances = brought.maps[image.name]
                image.confidence = None
        edited.record("label import", params.model_dump(mode="json"), result)
    return result


@dataclass
class Brought:
    """What an import found. maps: places in the project of the label map and the instances by photo; instances: how many;
    kept: photos that have labels of their own; unknown: pictures of no photo; doubtful: photos that several pictures may be
    of, which got none; repeated: photos of several pictures, the last of which counts."""

    maps: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    instances: dict[str, int] = field(default_factory=dict)
    kept: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    doubtful: dict[str, list[str]] = field(default_factory=dict)
    repeated: dict[str, list[str]] = field(default_factory=dict)


def _bring(source: Source, project: Project, classes: Classes, place: Path, replace: bool, report: Reporter) -> Brought:
    """Write the label maps of a file into the folder `place`."""
    claims = Claims(Photos(image for image in project.images if image.status != "rejected"))
    brought = Brought()
    for number, picture in enumerate(source.pictures):
        report.progress(number / (number + 10), picture.name)
        photo = claims.photo_of(picture.name)
        if photo is None:
            brought.unknown.append(picture.name)
        elif photo.label and not is_made(photo.label) and not replace:
            if photo.name not in brought.kept:
                brought.kept.append(photo.name)
        else:
            brought.maps.pop(photo.name, None)
            ids, things = maps_of(picture, classes, project.ignore_id)
            try:
                brought.maps[photo.name] = write_photo(place, photo, ids, things)
            except InputError as error:
                report.warn(f"{error.message}: it keeps the labels it has.")
                continue
            brought.instances[photo.name] = int(np.count_nonzero(np.unique(things)))
    brought.doubtful, brought.repeated = claims.doubtful(), claims.repeated()
    for name in brought.doubtful:
        brought.maps.pop(name, None)
        brought.instances.pop(name, None)
    for file in place.rglob("*.png"):
        if file.stem not in brought.maps:
            file.unlink()
    brought.unknown += [picture for pictures in brought.doubtful.values() for picture in pictures]
    brought.unknown += [picture for picture in claims.outdone() if picture not in brought.unknown]
    return brought


class Classes:
    """The ids that classes of a file get: of the project's where the name is there, else others than those `taken`."""

    def __init__(self, project: Project, source: Source, taken: set[int]) -> None:
        self.ids = {c.name: c.id for c in project.classes}
        self._taken = set(taken)
        self.new: dict[str, SemanticClass] = {}
        self.used: set[str] = set()
        self._void, self._colors, self._wanted = project.ignore_id, source.classes, source.ids

    def id_of(self, name: str) -> int | None:
        """The id of a class; None for what stands for no class."""
        name = name.strip()
        if not name or name.lower() in VOID_NAMES:
            return None
        self.used.add(name)
        if name not in self.ids:
            number = self._wanted.get(name)
            if number is None or number in self._taken:
                number = next(i for i in range(1, 65536) if i not in self._taken)
            given = self._colors.get(name)
            color = (given[0] / 255, given[1] / 255, given[2] / 255) if given else class_color(number, self._void)
            self.ids[name] = number
            self._taken.add(number)
            self.new[name] = SemanticClass(id=number, name=name, color=color)
        return self.ids[name]

    def with_new(self, project: Project) -> list[SemanticClass]:
        """The classes of a project with the new ones, by id.

        Raises:
            ProjectError: somebody gave their ids or names to others meanwhile. InputError: there would be too many.
        """
        known = {c.name: c.id for c in project.classes}
        taken = {*known.values(), *project.former_class_ids}
        if any(known[c.name] != c.id if c.name in known else c.id in taken for c in self.new.values()):
            raise ProjectError("The classes were changed during the import.", "Import the labels once more.")
        made = {c.id: c for c in [*self.new.values(), *project.classes]}
        if len(made) > MOST_CLASSES:
            raise InputError(
                f"With those of the file there would be {len(made)} classes; a field tells at most {MOST_CLASSES} apart.",
                "Merge classes in the file.",
            )
        return [made[i] for i in sorted(made)]


def maps_of(picture: Picture, classes: Classes, void: int) -> tuple[np.ndarray, np.ndarray]:
    """Class ids (H, W) uint16, `void` where nobody assigned any, and numbers of instances (H, W) uint16, 0 for none.

    Raises:
        InputError: there are more instances than 16 bits count.
    """
    ids = np.full((picture.height, picture.width), void, np.uint16)
    things = np.zeros(ids.shape, np.uint16)
    for region in picture.regions:
        class_id = classes.id_of(region.class_name)
        if region.instance > MOST_INSTANCES:
            raise InputError(f"{picture.name} has more than {MOST_INSTANCES} instances.", "Merge some of them.")
        region.paint(ids, void if class_id is None else class_id)
        region.paint(things, 0 if class_id is None else region.instance)
    return ids, things


def write_photo(place: Path, photo: ImageRecord, ids: np.ndarray, things: np.ndarray) -> tuple[str, str | None]:
    """Write the label map of a photo into a folder, and that of instances where there are any; where they will be in the
    project.

    Raises:
        InputError: they have another shape than the photo. DiskError.
    """
    size = (photo.width, photo.height)
    name, other = f"{photo.name}.png", f"{INSTANCES}/{photo.name}.png"
    _write(place / name, fit_to_photo(ids, 1, size, size, f"the label map of {photo.name}"))
    if not things.any():
        return f"{IMPORTED}/{name}", None
    _write(place / other, fit_to_photo(things, 1, size, size, f"the instances of {photo.name}"))
    return f"{IMPORTED}/{name}", f"{IMPORTED}/{other}"


def _write(path: Path, values: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        write_picture(temporary, values.astype(np.uint8) if int(values.max(initial=0)) < 256 else values)


def tell(report: Reporter, brought: Brought, source: Source) -> None:
    """Warn of what was left out."""
    for name, pictures in brought.doubtful.items():
        report.warn(
            f"{_listed(pictures)} may all be of the photo {name}: none was taken. Name them by their whole paths."
        )
    for name, pictures in brought.repeated.items():
        report.warn(f"{_listed(pictures)} are all of the photo {name}: the last one counts.")
    doubtful = {picture for pictures in brought.doubtful.values() for picture in pictures}
    unknown = [picture for picture in brought.unknown if picture not in doubtful]
    for names, what in (
        (brought.kept, "photos have labels of their own and keep them (`replace` takes the new ones)"),
        (unknown, "pictures are no photos of the project"),
    ):
        if names:
            report.warn(f"{len(names)} {what}: {_listed(names)}.")
    for kind, count in source.skipped.items():
        report.warn(f"{count} annotations of the kind “{kind}” have no area and were left out.")


def _listed(names: list[str]) -> str:
    return ", ".join(names[:MOST_TOLD]) + ("" if len(names) <= MOST_TOLD else " …")


def export_labels(params: LabelExportParams, report: Reporter) -> dict[str, Any]:
    """Write labels of the photos for another tool, as large as the photos of the project.

    Returns:
        {"format", "photos", "classes": names, "files", "revision": of the marks, None for label maps that are
        from none}
    Raises:
        SettingError: the name of the file does not fit the format, or the class is unknown. InputError: the folder is not
        empty, or there are no labels. ProjectError: the revision was not propagated. DiskError, Cancelled: nothing is
        written.
    """
    folder, out = Path(params.project), Path(params.out)
    project = load_project(folder)
    if params.format == "history":
        return export_history(params, project, folder, out)
    check_out(params, project, out)
    revision, pictures, count = pictures_of(params, project, folder, report)
    if not count:
        raise InputError(
            f"No photo of {folder} has labels.", "Mark some, or export what was propagated: --source marks."
        )
    report.stage("Writing labels")
    written = _written(followed(pictures, count, report), params, project, out, revision)
    return {
        "format": params.format,
        "photos": count,
        "classes": [c.name for c in project.classes],
        "files": [str(path) for path in written],
        "revision": revision,
    }


def export_history(params: LabelExportParams, project: Project, folder: Path, out: Path) -> dict[str, Any]:
    """Write the table of all marks; returns as `export_labels`. Raises InputError, SettingError, ProjectError, DiskError."""
    if out.suffix.lower() != ".csv":
        raise SettingError(f"{out} does not end in .csv.", "The history of marks is one .csv file.")
    marks = read_marks(folder)
    if not marks:
        raise InputError(f"{folder} has no marks.", "Mark something with `fieldwork label stroke`.")
    revision = shown_revision(folder, len(marks)) if params.revision is None else params.revision
    written = write_history(out, project, marks, revision)
    photos = len({mark.photo for mark in marks if mark.photo})
    names = [c.name for c in project.classes]
    return {"format": "history", "photos": photos, "classes": names, "files": [str(written)], "revision": revision}


def check_out(params: LabelExportParams, project: Project, out: Path) -> None:
    suffix = known.FILES.get(params.format)
    if suffix and out.suffix.lower() != suffix:
        raise SettingError(f"{out} does not end in {suffix}.", f"Labels of this format are one {suffix} file.")
    if not suffix and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is there already.", "Give a new folder, or an empty one.")
    names = [c.name for c in project.classes]
    if params.format == "masks" and params.class_name not in names:
        wrong = f"There is no class “{params.class_name}”" if params.class_name else "Masks are of one class"
        raise SettingError(
            f"{wrong}: say which one is white, with --class-name.", f"The classes are {', '.join(names) or 'none'}."
        )


def pictures_of(
    params: LabelExportParams, project: Project, folder: Path, report: Reporter
) -> tuple[int | None, Iterator[Picture], int]:
    """The revision, the pictures to write, and how many they are."""
    names = {c.id: c.name for c in project.classes}
    if params.source == "maps":
        images = [image for image in project.images if image.label and image.status != "rejected"]
        pictures = (_picture(image, *_maps(folder, image), names) for image in images)
        return map_revision(project), pictures, len(images)
    ready, labelling = propagated_labels(folder, params.run, params.revision, report)
    images = [image for image in project.images if image.name in ready.of_photo]

    def propagated(image: ImageRecord) -> Picture:
        ids, _ = photo_labels(ready, labelling, image.name, project.ignore_id)
        return _picture(image, nearest(ids, image.width, image.height), None, names)

    return labelling.revision, map(propagated, images), len(images)


def _maps(folder: Path, image: ImageRecord) -> tuple[np.ndarray, np.ndarray | None]:
    things = read_label(folder / image.instances) if image.instances else None
    return read_label(folder / str(image.label)), things


def _picture(image: ImageRecord, ids: np.ndarray, things: np.ndarray | None, names: dict[int, str]) -> Picture:
    """The regions of a photo: one for each instance, and one for the rest of each class."""
    regions = []
    pairs = ids.astype(np.int64) * (MOST_INSTANCES + 1) + (0 if things is None else things)
    found, number = np.unique(pairs, return_inverse=True)
    number = number.reshape(pairs.shape)
    for i, (rows, columns) in enumerate(scipy.ndimage.find_objects(number + 1)):
        class_id, thing = divmod(int(found[i]), MOST_INSTANCES + 1)
        if class_id in names:
            patch = number[rows, columns] == i
            regions.append(Region(names[class_id], patch, columns.start, rows.start, thing))
    return Picture(Path(image.file).name, ids.shape[1], ids.shape[0], regions)


def label_classes(project: Project) -> list[LabelClass]:
    """The classes of a project with colours of bytes."""
    return [
        LabelClass(c.id, c.name, (round(c.color[0] * 255), round(c.color[1] * 255), round(c.color[2] * 255)))
        for c in project.classes
    ]


def followed(pictures: Iterator[Picture], count: int, report: Reporter) -> Iterator[Picture]:
    """The pictures, with progress."""
    for number, picture in enumerate(pictures):
        report.progress(number / count, picture.name)
        yield picture


def _written(
    pictures: Iterator[Picture], params: LabelExportParams, project: Project, out: Path, revision: int | None
) -> list[Path]:
    """Write a file, or a folder as a whole."""
    classes, void, name = label_classes(project), project.ignore_id, params.class_name
    if params.format in known.FILES:
        return known.write(pictures, params.format, classes, out, void, name, revision)
    if out.is_dir():  # it stays: somebody may be in it, or it is a disk of its own
        with staged(out) as place:
            files = known.write(pictures, params.format, classes, place, void, name, revision)
            return [out / file.relative_to(place) for file in files]
    part = out.with_name(f".{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        files = known.write(pictures, params.format, classes, part, void, name, revision)
        with disk_errors(out):
            os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return [out / file.relative_to(part) for file in files]
