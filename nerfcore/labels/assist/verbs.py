"""The verbs `assist embed`, `assist segment` and `assist suggest`: models that users bring help with marking."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import atomic_path, staged
from ...images.encode import write_picture
from ...params import AssistEmbedParams, AssistSegmentParams, AssistSuggestParams
from ...progress import Reporter
from ...project.label_revision import SUGGESTED, is_made
from ...project.schema import ImageRecord, Project
from ...project.store import edit_project, load_project
from ..journal import append_mark, read_marks, shown_revision
from ..models import load
from ..stroke import require_class, require_photo
from .embeddings import embedded, photo_pixels
from .outline import outline_of
from .segmenter import Prompt, segmenter
from .semantic import Semantic, guessed, read_mapping


def embed(params: AssistEmbedParams, report: Reporter) -> dict[str, Any]:
    """Encode photos ahead, so that clicks on them are answered at once.

    Returns:
        {"photos", "encoded": number that was not there yet, "seconds"}
    Raises:
        InputError: a photo is not there, or a model does not fit. DiskError, Cancelled.
    """
    folder, begin = Path(params.project), time.perf_counter()
    photos = chosen(load_project(folder), folder, params.photos)
    model = segmenter(params.encoder, params.decoder)
    report.stage("Encoding photos")
    encoded = 0
    for number, photo in enumerate(photos):
        report.progress(number / len(photos), photo.name)
        encoded += not embedded(folder, photo, model)[1]
    return {"photos": len(photos), "encoded": encoded, "seconds": round(time.perf_counter() - begin, 2)}


def segment(params: AssistSegmentParams, report: Reporter) -> dict[str, Any]:
    """Cut out a thing by clicks or a box; with a class, or as void, it becomes a mark.

    Returns:
        {"outline": [[x, y]] in pixels, "pixels", "score": how good the model says it is, "cached": whether the photo was
        encoded before, "revision": of the marks that is shown with it, None without one, "milliseconds": of the decoder}
    Raises:
        InputError: a photo or class is not there, a model does not fit, or found nothing. ProjectError, DiskError.
    """
    folder = Path(params.project)
    project = load_project(folder)
    require_photo(project, folder, params.photo)
    if params.class_id is not None:
        require_class(project, params.class_id)
    (photo,) = chosen(project, folder, [params.photo])
    # Encoding takes seconds, in which others may be drawn.
    below = shown_revision(folder, len(read_marks(folder))) if params.drawn_on is None else params.drawn_on
    model = segmenter(params.encoder, params.decoder)
    report.stage("Encoding the photo")
    values, cached = embedded(folder, photo, model)
    report.stage("Cutting out")
    begin = time.perf_counter()
    mask, score = model.cut(values, (photo.width, photo.height), Prompt(params.points, params.outside, params.box))
    seconds = time.perf_counter() - begin
    outline = outline_of(mask)
    revision = None
    if params.class_id is not None or params.void:
        mark = params.model_dump(include={"photo", "class_id", "author", "key"})
        drawn = {"shape": "outline", "points": outline, "width": 1.0, "size": (photo.width, photo.height)}
        revision = append_mark(folder, {**mark, **drawn}, below).revision
    return {
        "outline": outline,
        "pixels": int(mask.sum()),
        "score": round(score, 4),
        "cached": cached,
        "revision": revision,
        "milliseconds": round(seconds * 1e3, 1),
    }


def suggest(params: AssistSuggestParams, report: Reporter) -> dict[str, Any]:
    """Give photos without labels of their own label maps that a model guesses.

    Returns:
        {"photos", "kept": number that have labels of their own, "labelled": mean share of their pixels that got a class}
    Raises:
        InputError: a photo is not there, the model does not fit, or the mapping is wrong. DiskError, Cancelled: photos
        have the labels that they had.
    """
    folder = Path(params.project)
    project = load_project(folder)
    ids = {c.name: c.id for c in project.classes}
    mapping = {number: ids[name] for number, name in read_mapping(params.mapping, list(ids)).items()}
    model = Semantic(load(params.model))
    photos = chosen(project, folder, params.photos)
    own = [p for p in photos if p.label and not is_made(p.label)]
    report.stage("Guessing classes")
    taken: dict[str, float] = {}
    todo = [photo for photo in photos if photo not in own]
    with staged(folder / SUGGESTED) as place:  # earlier guesses stay until all of the new ones are there
        for number, photo in enumerate(todo):
            report.progress(number / len(todo), photo.name)
            found = model.probabilities(photo_pixels(folder, photo))
            size = (photo.width, photo.height)
            labels, sure = guessed(found, mapping, size, params.least, project.ignore_id, params.mapping)
            _write(place / f"{photo.name}.png", labels if labels.max() > 255 else labels.astype(np.uint8))
            _write(place / "confidence" / f"{photo.name}.png", (sure * 255 + 0.5).astype(np.uint8))
            taken[photo.name] = float((labels != project.ignore_id).mean())
    share = round(float(np.mean(list(taken.values()))), 4) if taken else 0.0
    result = {"photos": len(taken), "kept": len(own), "labelled": share}
    with edit_project(folder) as edited:
        for image in edited.images:
            if image.name in taken:
                image.label = f"{SUGGESTED}/{image.name}.png"
                image.confidence = f"{SUGGESTED}/confidence/{image.name}.png"
        edited.record("assist suggest", params.model_dump(mode="json"), result)
    return result


def chosen(project: Project, folder: Path, names: list[str]) -> list[ImageRecord]:
    """The usable photos of these names, all where none is named. Raises InputError where one is not there."""
    photos = {image.name: image for image in project.images if image.status != "rejected" and image.file}
    strange = [name for name in names if name not in photos]
    if strange:
        raise InputError(f"{folder} has no photo “{strange[0]}”.", "Photos are named without folder and suffix.")
    return [photos[name] for name in names] if names else list(photos.values())


def _write(path: Path, values: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        write_picture(temporary, values)
