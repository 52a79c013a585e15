"""The verb `import`: a posed data set becomes a capture project, with its own poses and resolution."""

from __future__ import annotations

import hashlib
import importlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import InputError, ProjectError
from ..files import atomic_path
from ..params import ImportParams
from ..progress import Reporter
from ..project import (
    PROJECT_FILE,
    Frame,
    ImageRecord,
    PosedImage,
    Poses,
    Project,
    create_folder,
    load_project,
    save_poses,
    save_project,
)
from .cameras import Camera
from .classes import make_classes
from .dataset import Dataset, DatasetView

# In the order in which "auto" asks them: the more specific layouts first.
FORMATS = (
    "transforms", "colmap", "llff", "dtu", "middlebury", "strecha", "scannet", "replica", "metashape", "realityscan",
    "meshroom",
)  # fmt: skip


def import_dataset(params: ImportParams, report: Reporter) -> dict[str, Any]:
    """Copy a posed data set into a project.

    Returns:
        {"format", "images", "labelled", "classes": [names]}
    Raises:
        InputError: the data set is of no known format or damaged.
        ProjectError: the project folder already holds another capture.
        DiskError: it cannot be written.
    """
    source, folder = Path(params.dataset), Path(params.project)
    _require_free(folder, source)
    report.stage("Reading the data set")
    dataset = read_dataset(source, params.format)
    for message in dataset.warnings:
        report.warn(message)
    create_folder(folder)
    report.stage("Copying images")
    records = []
    for i, view in enumerate(dataset.views):
        report.progress(i / len(dataset.views), view.name)
        records.append(_copy_view(view, folder))
    classes, ignore_id = _classes(dataset, folder, records, report)
    cameras, images = _poses(dataset.views)
    project = Project(
        images=records,
        classes=classes,
        ignore_id=ignore_id,
        frame=Frame(
            world_from_sfm=dataset.world_from_sfm.tolist(),
            up_confidence=dataset.up_confidence,
            scale_known=dataset.scale_known,
            bounds=None if dataset.bounds is None else dataset.bounds.tolist(),
        ),
    )
    result = {
        "format": dataset.format,
        "images": len(records),
        "labelled": sum(record.label is not None for record in records),
        "classes": [c.name for c in classes],
    }
    save_poses(folder, Poses(source=dataset.format, cameras=cameras, images=images), dataset.points)
    project.record("import", params.model_dump(mode="json"), result)
    save_project(folder, project)
    return result


def read_dataset(source: Path, format: str = "auto") -> Dataset:
    """Read a posed data set in one of `FORMATS`.

    Raises:
        InputError: it does not exist, or is of no known format.
    """
    if not source.exists():
        raise InputError(f"{source} does not exist.", "Choose the folder of a posed data set.")
    if format != "auto":
        if format not in FORMATS:
            raise InputError(f"The format {format} cannot be read.", f"Choose one of {', '.join(FORMATS)}.")
        return _reader(format).read(source)
    for name in FORMATS:
        reader = _reader(name)
        if reader.matches(source):
            return reader.read(source)
    raise InputError(
        f"{source} is no posed data set that Fieldwork knows.",
        f"Known are {', '.join(FORMATS)}. Photos without poses go through `fieldwork new`.",
    )


def _reader(name: str) -> Any:
    return importlib.import_module(f".readers.{name}", __package__)


def _require_free(folder: Path, source: Path) -> None:
    """Importing again over the same data set is fine; over another capture it is not."""
    if not (folder / PROJECT_FILE).exists():
        return
    steps = load_project(folder).provenance
    if not steps or steps[0].verb != "import" or Path(str(steps[0].settings.get("dataset"))) != source:
        raise ProjectError(f"{folder} already holds another capture.", "Choose a new folder for the project.")


def _copy_view(view: DatasetView, folder: Path) -> ImageRecord:
    image = copy_image(view.image, folder / "images", view.name)
    label = _copy(view.label, folder / "labels", view.name)
    mask = _copy(view.mask, folder / "masks", view.name)
    return ImageRecord(
        name=view.name,
        file=_relative(image, folder) or "",
        source=str(view.image),
        sha256=file_hash(view.image),
        width=view.camera.width,
        height=view.camera.height,
        focal_px=view.camera.fx,
        label=_relative(label, folder),
        mask=_relative(mask, folder),
        split=view.split,
    )


def copy_image(source: Path, folder: Path, name: str) -> Path:
    """Copy a photo into `folder` as `name` with its own suffix, unless it is there already."""
    target = folder / f"{name}{source.suffix.lower()}"
    stat = source.stat()
    if target.is_file() and (target.stat().st_size, target.stat().st_mtime) == (stat.st_size, stat.st_mtime):
        return target
    with atomic_path(target) as temporary:
        shutil.copy2(source, temporary)
    return target


def _copy(source: Path | None, folder: Path, name: str) -> Path | None:
    return copy_image(source, folder, name) if source else None


def _relative(path: Path | None, folder: Path) -> str | None:
    return path.relative_to(folder).as_posix() if path else None


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _classes(dataset: Dataset, folder: Path, records: list[ImageRecord], report: Reporter) -> tuple[list, int]:
    """The classes that occur in the labels, named by the data set where it does so."""
    present: set[int] = set()
    labelled = [record for record in records if record.label]
    for record in labelled:
        report.check()
        with Image.open(folder / str(record.label)) as image:
            labels = np.asarray(image)
        if labels.ndim != 2:
            raise InputError(
                f"The label map {record.label} is an RGB picture.", "Import needs index PNGs (one class id a pixel)."
            )
        present |= set(np.unique(labels).tolist())
    names = dataset.class_names if not labelled else {i: dataset.class_names.get(i, f"class {i}") for i in present}
    return make_classes(names, dataset.ignore_id), dataset.ignore_id


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
