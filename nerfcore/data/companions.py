"""What lies beside the photos of a posed data set, whatever its format: the names of its classes, and labels that know how
sure they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..capture.find import classes_beside
from ..errors import InputError
from ..images.names import companion_stems
from ..images.soft_labels import find_confidence, find_probabilities, read_probabilities
from ..progress import shortened
from ..project.classes import read_found_classes
from .dataset import Dataset

CLASSES = "classes.json"


def with_classes(dataset: Dataset, given: Path | None = None) -> Dataset:
    """The data set with the classes of a file: the one that is given, else a classes.json in its folder, with its label maps
    or beside their folder. Without any it stays as it is.

    Raises:
        InputError: the file cannot be used.
    """
    file = given or _classes_file(dataset)
    if file is None:
        return dataset
    names, ignore_id, colors = read_found_classes(file, given=given is not None)
    return replace(dataset, class_names=names, ignore_id=ignore_id, class_colors=colors, classes_file=file)


def _classes_file(dataset: Dataset) -> Path | None:
    if dataset.root is not None and (dataset.root / CLASSES).is_file():
        return dataset.root / CLASSES
    folders = dict.fromkeys(view.label.parent for view in dataset.views if view.label)
    return next((file for folder in folders if (file := classes_beside(folder))), None)


def with_soft_labels(dataset: Dataset) -> Dataset:
    """The data set with the probability maps in its folder `labels`, which go before pictures in there, and the confidence
    maps in `labels/confidence`."""
    if dataset.root is None or not (dataset.root / "labels").is_dir():
        return dataset
    folder = dataset.root / "labels"
    all_stems = companion_stems([v.image for v in dataset.views], dataset.root, [v.name for v in dataset.views])
    views, odd = [], []
    for view, stems in zip(dataset.views, all_stems):
        label, soft = view.label, find_probabilities(folder, stems)
        if soft is not None and soft != label:
            ours = label is None or label.is_relative_to(folder)
            problem = _problem(soft) if ours else "its photo has another label map"
            odd += [f"{soft.name} ({problem})"] if problem else []
            soft = None if problem else soft
        label = soft or label
        views.append(replace(view, label=label, confidence=find_confidence(folder, stems, label)))
    told = [shortened(f"{len(odd)} files among label maps are not used", odd)] if odd else []
    return replace(dataset, views=views, warnings=[*dataset.warnings, *told])


def _problem(path: Path) -> str:
    """Why a file is no probability map; empty for one that is."""
    try:
        read_probabilities(path)
    except InputError as error:
        return error.message
    return ""
