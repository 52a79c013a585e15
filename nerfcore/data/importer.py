"""The verb `import`: a posed data set becomes a capture project, with its own poses and resolution."""

from __future__ import annotations

import importlib
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ..capture.backdrop import mask_objects
from ..capture.mask_mode import MaskMode, chosen_mask_mode
from ..errors import InputError, ProjectError, wrong_value
from ..files import file_hash, linked, require_readable, staged
from ..geometry.cameras import Camera
from ..images.labels import read_mask
from ..params import ImportParams
from ..progress import Reporter, shortened
from ..project.classes import make_classes, unnamed_values
from ..project.kept import (
    BESIDE,
    earlier_cut_outs,
    earlier_poses,
    from_project,
    keep_later_labels,
    keep_world,
    same_source,
    with_earlier_classes,
)
from ..project.schema import Frame, ImageRecord, PosedImage, Poses, Project, SemanticClass
from ..project.store import PROJECT_FILE, create_folder, edit_project, load_project, save_poses
from .companions import with_classes, with_soft_labels
from .copying import copy_confidence, copy_depth, copy_labels, copy_mask, copy_photo
from .dataset import Dataset, DatasetView
from .hull import trim_masks
from .lens_check import lens_problem

# In the order in which "auto" asks them: the more specific layouts first.
FORMATS = (
    "transforms", "colmap", "llff", "dtu", "middlebury", "strecha", "scannet", "replica", "metashape", "realityscan",
    "meshroom",
)  # fmt: skip


def import_dataset(params: ImportParams, report: Reporter) -> dict[str, Any]:
    """Copy a posed data set into a project.

    Importing it again keeps what was decided since: labels of unchanged photos that it has none for, classes, and the
    world as it was aligned.

    Returns:
        {"format", "images", "labelled", "classes": [names]}
    Raises:
        InputError: the data set is of no known format or damaged.
        ProjectError: the project folder already holds another capture.
        DiskError: it cannot be written.
        Of these, and when it is stopped, a project that was there is as before.
    """
    source, folder = Path(params.dataset).absolute(), Path(params.project)
    if folder.resolve() in (source.resolve(), source.parent.resolve() if source.is_file() else None):
        raise InputError(
            f"The data set lies in {folder}, where the project would keep its own files.",
            f"Choose another folder for the project, such as {folder.resolve().name}_fieldwork beside it.",
        )
    previous = _previous_project(folder, source)
    report.stage("Reading the data set")
    dataset = read_dataset(source, params.format, params.classes)
    for message in dataset.warnings:
        report.warn(message)
    create_folder(folder)
    # What a project holds already stays as it is until all that takes its place is there.
    with nullcontext(folder) if previous is None else staged(folder) as place:
        if previous is not None:
            _link(previous, folder, place)
        brought = _bring(dataset, place, params, previous, report)
    records, classes = brought.records, brought.classes
    cameras, images = _poses(dataset.views)
    poses, before = Poses(source=dataset.format, cameras=cameras, images=images), earlier_poses(folder)
    with edit_project(folder, Project()) as project:
        if previous is not None:
            keep_later_labels(records, project.images, folder)
            classes = with_earlier_classes(classes, project.classes)
        project.images, project.classes, project.ignore_id = records, classes, dataset.ignore_id
        project.mask_mode, frame = brought.mask_mode, _frame(dataset)
        project.frame, kept = (frame, False) if previous is None else keep_world(project, before, poses, frame, report)
        save_poses(folder, poses, dataset.points)
        result = {
            "format": dataset.format,
            "images": len(brought.used),
            "labelled": sum(record.label is not None for record in brought.used),
            "classes": [c.name for c in classes],
        }
        settings = params.model_dump(mode="json") | {"dataset": str(source)}
        told = {"world_kept": kept, "cut_out": brought.cut_out, BESIDE: from_project(source, folder)}
        project.record("import", settings, result | told)
    if brought.cut_out:
        trim_masks(folder, report)
    return result


@dataclass(frozen=True)
class Brought:
    """What was copied of a data set. cut_out: whether masks of objects were made for it."""

    records: list[ImageRecord]
    classes: list[SemanticClass]
    mask_mode: MaskMode
    cut_out: bool

    @property
    def used(self) -> list[ImageRecord]:
        return [record for record in self.records if record.status == "ok"]


def _bring(dataset: Dataset, place: Path, params: ImportParams, previous: Project | None, report: Reporter) -> Brought:
    """Copy the files of a data set into the folder `place`, and make masks there where objects stand before the dark.

    Raises:
        InputError: a file cannot be used, masks leave nothing of any photo, or there are too many classes. DiskError.
        What `report` raises to stop.
    """
    report.stage("Copying images")
    records: list[ImageRecord] = []
    present: dict[int, list[str]] = {}
    for i, view in enumerate(dataset.views):
        report.progress(i / len(dataset.views), view.name)
        record, ids = _copy_view(view, place, dataset)
        records.append(record)
        for value in ids:
            present.setdefault(value, []).append(view.label.name if view.label else view.name)
    _warn_of_maps(present, dataset, dataset.classes_file or params.dataset, report)
    _reject_hidden(records, place, report)
    used = [record for record in records if record.status == "ok"]
    if not used:
        raise InputError(
            f"The masks of {params.dataset} leave nothing of any photo.", "White in a mask marks what counts."
        )
    classes = _classes(dataset, set(present))
    asked = params.mask_mode or dataset.mask_mode
    told = params.keep_backdrop or asked == "ignore" or any(r.mask or r.label for r in records)
    cut_out = not told and mask_objects(records, place, report, earlier_cut_outs(previous))
    masks = [place / record.mask for record in used if record.mask]
    mask_mode = "empty" if cut_out else chosen_mask_mode(asked, masks, len(used), report)
    return Brought(records, classes, mask_mode, cut_out)


def _link(project: Project, folder: Path, place: Path) -> None:
    """Put photos and masks of a project into the folder `place` as well, so that those that stay need not be made anew."""
    for record in project.images:
        for file in (record.file, record.mask):
            if file and (folder / file).is_file():
                (place / file).parent.mkdir(parents=True, exist_ok=True)
                linked(str(folder / file), str(place / file))


def read_dataset(source: Path, format: str = "auto", classes: Path | None = None) -> Dataset:
    """Read a posed data set in one of `FORMATS`.

    Args:
        classes: a file that names its classes, where it is not the one that lies with the data set.
    Raises:
        InputError: it does not exist, is of no known format or damaged, or the classes cannot be read.
    """
    if not source.exists():
        raise InputError(f"{source} does not exist.", "Choose the folder of a posed data set.")
    require_readable(source)
    if format != "auto":
        if format not in FORMATS:
            raise InputError(f"The format {format} cannot be read.", f"Choose one of {', '.join(FORMATS)}.")
        return _complete(_read(format, source), source, classes)
    for name in FORMATS:
        if _reader(name).matches(source):
            return _complete(_read(name, source), source, classes)
    raise InputError(
        f"{source} is no posed data set that Fieldwork knows.",
        f"Known are {', '.join(FORMATS)}. Photos without poses go through `fieldwork new`.",
    )


def _read(name: str, source: Path) -> Dataset:
    """Read a data set of this format. Raises InputError, also where its files hold what no reader looks for."""
    try:
        return _reader(name).read(source)
    except (AttributeError, ValueError, TypeError, LookupError, ArithmeticError) as error:
        reason = wrong_value(error.errors()[0]) if isinstance(error, ValidationError) else repr(error)
        raise InputError(f"{source} is a damaged data set ({name}): {reason}.", "Export the data set again.") from error


def _complete(dataset: Dataset, source: Path, classes: Path | None) -> Dataset:
    """The data set, checked, with what lies beside its photos whatever its format. Raises InputError."""
    dataset = _checked(dataset, source)
    root = dataset.root or (source.parent if source.is_file() else source)
    return with_classes(with_soft_labels(replace(dataset, root=root)), classes)


def _checked(dataset: Dataset, source: Path) -> Dataset:
    """The data set with exactly orthonormal rotations: files round them to a few digits, some carry a scale.

    Raises:
        InputError: a pose is none, or a lens is impossible; it names the image.
    """
    views = []
    for view in dataset.views:
        problem = lens_problem(view.camera)
        if problem:
            raise InputError(f"The lens of {view.name} in {source} cannot be: {problem}.", "Export the data set again.")
        pose = np.array(view.camera_to_world, np.float64)
        singular = np.linalg.svd(pose[:3, :3], compute_uv=False) if np.isfinite(pose).all() else np.zeros(3)
        if singular.min() < 1e-6 or singular.max() / singular.min() > 1.05 or np.linalg.det(pose[:3, :3]) < 0:
            raise InputError(f"The pose of {view.name} in {source} is no rotation and position.", "Export it again.")
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ vt
        views.append(replace(view, camera_to_world=pose))
    return replace(dataset, views=views)


def _reader(name: str) -> Any:
    return importlib.import_module(f".readers.{name}", __package__)


def _previous_project(folder: Path, source: Path) -> Project | None:
    """The project that is there already. Importing again over the same data set is fine; over another capture it is not."""
    if not (folder / PROJECT_FILE).exists():
        return None
    project = load_project(folder)
    steps = project.provenance
    if not steps or steps[0].verb != "import" or not same_source(steps[0], "dataset", source, folder):
        raise ProjectError(f"{folder} already holds another capture.", "Choose a new folder for the project.")
    return project


def _frame(dataset: Dataset) -> Frame:
    return Frame(
        world_from_sfm=dataset.world_from_sfm.tolist(),
        up_confidence=dataset.up_confidence,
        scale_known=dataset.scale_known,
        bounds=None if dataset.bounds is None else dataset.bounds.tolist(),
    )


def _copy_view(view: DatasetView, folder: Path, dataset: Dataset) -> tuple[ImageRecord, set[int]]:
    """Bring one view's files into the project; its record, and the class ids its labels use."""
    size = view.camera.width, view.camera.height
    image = copy_photo(view.image, folder / "images", view.name)
    ids: set[int] = set()
    label = mask = depth = confidence = None
    try:
        if view.label:
            colors = dataset.class_colors or None
            label, ids = copy_labels(view.label, folder / "labels", view.name, size, colors, dataset.ignore_id)
        if view.confidence:
            confidence = copy_confidence(view.confidence, folder / "confidence", view.name, size)
        if view.mask:
            mask = copy_mask(view.mask, folder / "masks", view.name, size)
    except InputError as error:
        hint = error.hint or "Replace or remove that file."
        raise InputError(f"{view.name}: {error.message}.".replace("..", "."), hint) from error
    if view.depth:
        depth = copy_depth(view.depth, folder / "depth", view.name, view.depth_scale)
    record = ImageRecord(
        name=view.name,
        file=_relative(image, folder) or "",
        source=str(view.image),
        sha256=file_hash(view.image),
        width=size[0],
        height=size[1],
        focal_px=view.camera.fx,
        label=_relative(label, folder),
        mask=_relative(mask, folder),
        confidence=_relative(confidence, folder),
        depth=_relative(depth, folder),
        split=view.split,
    )
    return record, ids


def _warn_of_maps(present: dict[int, list[str]], dataset: Dataset, named: Path, report: Reporter) -> None:
    """Say which values of label maps have no name where others have one, `named` in a file."""
    if dataset.class_names:
        for text in unnamed_values(present, dataset.class_names, dataset.ignore_id, named):
            report.warn(text)


def _reject_hidden(records: list[ImageRecord], folder: Path, report: Reporter) -> None:
    """Leave photos out of which masks leave nothing, and say so."""
    hidden = [record for record in records if record.mask and not read_mask(folder / record.mask).any()]
    for record in hidden:
        record.status, record.reason = "rejected", "its mask is black everywhere: white marks what counts"
    if hidden:
        names = [record.name for record in hidden]
        report.warn(
            shortened("Masks that are black everywhere leave nothing of these photos, which are left out", names)
        )


def _relative(path: Path | None, folder: Path) -> str | None:
    return path.relative_to(folder).as_posix() if path else None


def _classes(dataset: Dataset, present: set[int]) -> list[SemanticClass]:
    """The classes that occur in the labels, named by the data set where it does so; all it names without labels."""
    if not present:
        return make_classes(dataset.class_names, dataset.ignore_id, dataset.class_colors)
    names = {i: dataset.class_names.get(i, f"class {i}") for i in present}
    return make_classes(names, dataset.ignore_id, dataset.class_colors)


def _poses(views: list[DatasetView]) -> tuple[list[Camera], list[PosedImage]]:
    """Distinct cameras, and the poses that point into them."""
    cameras: list[Camera] = []
    index: dict[Camera, int] = {}
    images = []
    for view in views:
        if view.camera not in index:
            index[view.camera] = len(cameras)
            cameras.append(view.camera)
        images.append(
            PosedImage(name=view.name, camera=index[view.camera], camera_to_world=view.camera_to_world.tolist())
        )
    return cameras, images
