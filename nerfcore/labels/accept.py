"""The verb `label accept`: the classes of a revision become those of the run's field and of the project's photos.

Only the semantic head of the field is trained, on the surfels' soft labels. Density and colours stay, so what was prepared
and propagated stays valid too. Each training photo without a label map of its own gets one from the same labels, by which
meshes and later trainings have the classes as well; held-out photos get none, for they would be compared with guesses.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..data.load import load_scene
from ..errors import InputError
from ..files import atomic_path, disk_errors, linked
from ..images.encode import write_picture
from ..images.working import nearest
from ..params import LabelAcceptParams
from ..progress import Reporter
from ..project.label_revision import MAPS, is_made
from ..project.runs import ACCEPTED, CHECKPOINT, fresh_folder, run_folder, swap_in
from ..project.schema import Project, now
from ..project.store import edit_project, load_project
from ..render.model import Model
from ..render.run import AcceptedLabels, RunInfo, load_trained, new_model, read_checkpoint, save_info
from ..train.checkpoint import write_checkpoint
from .head import train_head
from .journal import marks_at, read_marks
from .lookup import Labelling
from .overlay import photo_labels
from .preparation import Preparation
from .propagate import propagated_labels
from .seeds import VOID, seeds_of


def accept(params: LabelAcceptParams, report: Reporter) -> dict[str, Any]:
    """Give a run the classes of a revision of the marks.

    Returns:
        {"run", "revision", "classes": [names], "steps", "seconds", "agreement": share of the surfels with a class to which
        the field gives the same one, "photos": number that got a label map, "kept": number that have their own}
    Raises:
        InputError: there is no such revision, or it has no class. ProjectError: the run was not prepared, or the revision
        not propagated. DiskError, Cancelled: run and project are as before.
    """
    folder = Path(params.project)
    project = load_project(folder)
    ready, labelling = propagated_labels(folder, params.run, params.revision, report)
    if not len(labelling.class_ids):
        raise InputError(
            f"Revision {labelling.revision} of the marks has no class.", "Mark something with `fieldwork label stroke`."
        )
    trained = load_trained(folder, params.run)
    info = accepted_info(trained.info, project, labelling)
    report.stage("Training the classes")
    model = with_head_of(new_model(info, trained.device), trained.model.state_dict())
    model.field.set_progress(trained.state["progress"], info.config.train.fade, trained.state["steps"])
    target = soft_targets(ready, labelling, project, folder)
    learned = train_head(model.field, np.array(ready.surfels.position), target, params.seconds, report)
    maps = folder / MAPS.format(labelling.revision)
    report.stage("Writing label maps")
    scene = load_scene(folder, info.holdout)
    train = {scene.views[i].name for i in scene.train}
    own = {image.name for image in project.images if image.label and not is_made(image.label)}
    known = [photo.name for photo in ready.photos if photo.name in train - own]
    try:
        write_maps(maps, ready, labelling, project, known, report)
        del ready  # Windows moves no folder with mapped files in it
        write_run(folder, params.run, info, model, labelling.revision)
    except BaseException:
        if not any(i.label and i.label.startswith(f"{MAPS.format(labelling.revision)}/") for i in project.images):
            shutil.rmtree(maps, ignore_errors=True)
        raise
    names = {c.id: c.name for c in project.classes}
    result = {
        "run": params.run,
        "revision": labelling.revision,
        "classes": [names.get(i, str(i)) for i in info.class_ids],
        "steps": learned.steps,
        "seconds": round(learned.seconds, 2),
        "agreement": agreement(learned.predicted, labelling),
        "photos": len(known),
        "kept": len(train & own),
    }
    with edit_project(folder) as edited:
        for image in edited.images:
            if image.name in known:
                image.label = f"{MAPS.format(labelling.revision)}/{image.name}.png"
                image.confidence = f"{MAPS.format(labelling.revision)}/confidence/{image.name}.png"
            elif image.label and is_made(image.label):  # held out now: the maps of before are removed
                image.label = image.confidence = None
        edited.record("label accept", params.model_dump(mode="json"), result)
    for other in (folder / "labels").glob(MAPS.format("*").split("/")[1]):
        if other != maps:
            shutil.rmtree(other, ignore_errors=True)
    return result


def accepted_info(info: RunInfo, project: Project, labelling: Labelling) -> RunInfo:
    """The run with the classes of a revision. A training of it cannot go on: its labels are others."""
    made = info.model_copy(deep=True)
    priority = {c.id: c.priority for c in project.classes}
    made.class_ids = [int(i) for i in labelling.class_ids]
    made.priorities = [priority.get(i, 1.0) for i in made.class_ids]
    made.accepted = AcceptedLabels(revision=labelling.revision, time=now())
    made.origin.inputs["labels"] = f"revision {labelling.revision} of the marks"
    if made.config.loss.semantic_weight == 0:  # it says that a field has no classes
        made.config.loss.semantic_weight = type(made.config.loss)().semantic_weight
    return made


def with_head_of(model: Model, state: dict[str, torch.Tensor]) -> Model:
    """A model with the tensors of another one but for the semantic head and the classes' priorities, which are new."""
    own = model.state_dict()
    kept = {name: value for name, value in state.items() if name in own and not is_of_classes(name)}
    model.load_state_dict({**own, **kept})
    return model.eval()


def is_of_classes(name: str) -> bool:
    """Whether a tensor of a model depends on which classes there are. Marks are on surfaces: none names an environment."""
    return name.startswith("field.semantic_head.") or name in ("priorities", "environment.labelled")


def soft_targets(ready: Preparation, labelling: Labelling, project: Project, folder: Path) -> np.ndarray:
    """Soft labels (N, K) float32 of the surfels. What strokes mark is certain; what is void is spread evenly over the
    classes, so that the field is unsure there: it has no class for nothing."""
    marks = marks_at(read_marks(folder), labelling.revision)
    sizes = {image.name: (image.width, image.height) for image in project.images}
    seeds = seeds_of(ready, marks, labelling.class_ids.tolist(), sizes)
    p = labelling.probability.copy()
    p += (1 - p.sum(1, keepdims=True)).clip(0) / p.shape[1]
    certain = seeds.label != VOID
    p[seeds.surfel[certain]] = np.eye(p.shape[1], dtype=np.float32)[seeds.label[certain]]
    return (p / p.sum(1, keepdims=True)).astype(np.float32)


def agreement(predicted: np.ndarray, labelling: Labelling) -> float | None:
    """Share of the surfels with a class to which the field gives the same one; None where none has a class."""
    label = labelling.label(VOID)
    classed = label != VOID
    if not classed.any():
        return None
    return round(float((labelling.class_ids[predicted[classed]] == label[classed]).mean()), 4)


def write_maps(
    place: Path, ready: Preparation, labelling: Labelling, project: Project, names: list[str], report: Reporter
) -> None:
    """Write label maps and their confidence, as large as the photos, for the photos of these names. Raises DiskError."""
    size = {image.name: (image.width, image.height) for image in project.images}
    for number, name in enumerate(names):
        report.progress(number / len(names), name)
        ids, sure = photo_labels(ready, labelling, name, project.ignore_id)
        kind = np.uint8 if max(int(ids.max()), project.ignore_id) < 256 else np.uint16
        pictures = {f"{name}.png": ids.astype(kind), f"confidence/{name}.png": (sure * 255 + 0.5).astype(np.uint8)}
        for file, values in pictures.items():
            with atomic_path(place / file) as temporary:
                write_picture(temporary, nearest(values, *size[name]))


def write_run(folder: Path, run: str, info: RunInfo, model: Model, revision: int) -> None:
    """Put the run with its new classes in the place of the old one, as a whole.

    Raises:
        DiskError: the run is as before.
    """
    place, fresh = run_folder(folder, run), fresh_folder(folder, run)
    tensors, state = read_checkpoint(place / CHECKPOINT, torch.device("cpu"))
    # What the optimiser knew was of other classes.
    kept = {name: value for name, value in tensors.items() if not name.startswith(("model.", "optimizer."))}
    kept.update({f"model.{name}": value.detach().cpu().contiguous() for name, value in model.state_dict().items()})
    assert info.accepted is not None
    state = {**state, ACCEPTED: [revision, info.accepted.time]}
    with disk_errors(fresh):
        shutil.rmtree(fresh, ignore_errors=True)
        try:
            shutil.copytree(place, fresh, copy_function=linked, ignore=shutil.ignore_patterns(CHECKPOINT, ".*"))
            save_info(fresh, info)
            write_checkpoint(fresh / CHECKPOINT, kept, state)
            swap_in(folder, run)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
