"""One trial of labelling by strokes: a simulated annotator before a prepared scene, and how right the labels are."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..data.load import load_scene
from ..evaluate.metrics import Confusion, calibration_error
from ..images.working import nearest, read_label
from ..labels.journal import Mark
from ..labels.lookup import Labelling
from ..labels.overlay import photo_labels
from ..labels.preparation import Preparation
from ..labels.propagation import propagated
from ..labels.seeds import Seeds, seeds_of
from ..progress import Reporter
from .annotator import LEAST_PIXELS, WIDTH, Stroke, correction, first_strokes

LEAST_SHARE = 0.005  # of the labelled pixels, for a class to be asked for
CORRECTIONS = 5
SURE = 0.9


@dataclass(frozen=True)
class Subject:
    """A prepared run and what is true of its photos: truth, class ids (H, W) by photo, `void` where the class is not asked
    for; class_ids asked for; the photos the annotator begins with, those for training and those held out."""

    ready: Preparation
    truth: dict[str, np.ndarray]
    class_ids: list[int]
    first: list[str]
    train: list[str]
    test: list[str]
    void: int


def read_subject(
    ready: Preparation, project: Path, first: list[str] | None, least_share: float = LEAST_SHARE
) -> Subject:
    """What is needed of a project with label maps. `first`: photos the annotator begins with; None: the two training photos
    that show most classes. `least_share`: of the labelled pixels, for a class to be asked for."""
    scene = load_scene(project)
    maps = {view.name: read_label(view.label) for view in scene.views if view.label is not None}
    largest = max(int(ids.max()) for ids in maps.values()) + 1
    count = np.sum([np.bincount(ids.reshape(-1), minlength=largest) for ids in maps.values()], 0)
    count[scene.ignore_id] = 0
    asked = [i for i in range(largest) if count[i] and count[i] >= least_share * count.sum()]
    truth = {name: np.where(np.isin(ids, asked), ids, scene.ignore_id) for name, ids in maps.items()}
    train = [scene.views[i].name for i in scene.train if scene.views[i].name in truth]
    test = [scene.views[i].name for i in scene.test if scene.views[i].name in truth]
    return Subject(ready, truth, asked, first or best_pair(truth, train, asked), train, test, scene.ignore_id)


def best_pair(truth: dict[str, np.ndarray], names: list[str], class_ids: list[int]) -> list[str]:
    """The two photos that together show most of the classes on enough pixels, and these largest."""
    sizes = {name: np.array([np.count_nonzero(truth[name] == i) for i in class_ids]) for name in names}

    def value(pair: tuple[str, str]) -> tuple[int, float]:
        size = np.maximum(sizes[pair[0]], sizes[pair[1]])
        return int((size >= LEAST_PIXELS).sum()), float(np.log1p(size).sum())

    return list(max(((a, b) for a in names for b in names if a < b), key=value))


class Annotator:
    """Draws strokes and looks at what becomes of them; `times`: seconds from a stroke to the labels of all surfels."""

    def __init__(self, subject: Subject, seed: int, hidden: int | None = None) -> None:
        """`hidden`: a class that gets no stroke."""
        self.subject, self.seed = subject, seed
        asked = [i for i in subject.class_ids if i != hidden]
        strokes = [s for photo in subject.first for s in first_strokes(photo, subject.truth[photo], asked, seed)]
        self.marks = [self._mark(stroke, number) for number, stroke in enumerate(strokes, 1)]
        self.times: list[float] = []
        self.shown: Labelling | None = None

    def _mark(self, stroke: Stroke, revision: int) -> Mark:
        points = [(float(x), float(y)) for x, y in stroke.points]
        about = {"photo": stroke.photo, "shape": "line", "width": WIDTH, "class_id": stroke.class_id}
        return Mark(revision=revision, parent=revision - 1, points=points, **about)

    def add(self, strokes: list[Stroke]) -> None:
        """Draw more strokes."""
        self.marks += [self._mark(stroke, number) for number, stroke in enumerate(strokes, len(self.marks) + 1)]

    def seeds(self) -> tuple[Seeds, list[int]]:
        """The surfels that are marked so far, and the ids of their classes."""
        marked = {mark.class_id for mark in self.marks}
        class_ids = [i for i in self.subject.class_ids if i in marked]
        sizes = {name: (ids.shape[1], ids.shape[0]) for name, ids in self.subject.truth.items()}
        return seeds_of(self.subject.ready, self.marks, class_ids, sizes), class_ids

    def look(self, report: Reporter) -> Labelling:
        """Labels by all strokes so far."""
        subject, begin = self.subject, time.perf_counter()
        seeds, class_ids = self.seeds()
        probability = propagated(subject.ready, seeds, len(class_ids), check=report.check)
        self.shown = labelled(probability, class_ids)
        self.times.append(time.perf_counter() - begin)
        return self.shown

    def correct(self) -> bool:
        """Draw a stroke over the largest mistake in the training photos; false where there is none."""
        assert self.shown is not None
        maps = {}
        for name in self.subject.train:
            shown, _ = photo_labels(self.subject.ready, self.shown, name, self.subject.void)
            truth = nearest(self.subject.truth[name], shown.shape[1], shown.shape[0])
            maps[name] = truth, shown
        stroke = correction(maps, self.subject.class_ids, self.seed + 1000 * len(self.marks))
        if stroke is None:
            return False
        rows, columns = self.subject.truth[stroke.photo].shape
        small = maps[stroke.photo][0].shape
        points = stroke.points * [columns / small[1], rows / small[0]]
        self.add([Stroke(stroke.photo, points, stroke.class_id)])
        return True


def labelled(probability: np.ndarray, class_ids: list[int]) -> Labelling:
    """Labels that no journal knows, by the probability (N, C) of classes."""
    return Labelling(0, probability, np.array(class_ids, np.int32), "")


def scores(subject: Subject, labelling: Labelling) -> dict[str, Any]:
    """How right labels are on the pixels of the held-out photos: "miou"; "ece", the expected calibration error (Naeini et
    al., "Obtaining well calibrated probabilities using Bayesian binning", 2015) of pixels with a class; "sure_right", the
    share right of those above 0.9; "void", the share that has no class."""
    confusion = Confusion(subject.class_ids)
    sure, right = [], []
    missing = pixels = 0
    for name in subject.test:
        truth = subject.truth[name]
        ids, confidence = photo_labels(subject.ready, labelling, name, subject.void)
        ids, confidence = (nearest(part, truth.shape[1], truth.shape[0]) for part in (ids, confidence))
        confusion.add(truth, ids)
        asked = truth != subject.void
        classed = asked & (ids != subject.void)
        missing, pixels = missing + np.count_nonzero(asked & ~classed), pixels + np.count_nonzero(asked)
        sure.append(confidence[classed])
        right.append(ids[classed] == truth[classed])
    certain, correct = np.concatenate(sure), np.concatenate(right)
    above = certain > SURE
    return {
        "miou": round(confusion.miou() or 0.0, 4),
        "ece": round(calibration_error(certain, correct), 4),
        "sure_right": round(float(correct[above].mean()), 4) if above.any() else None,
        "void": round(missing / max(pixels, 1), 4),
    }


def all_labels(subject: Subject) -> Labelling:
    """What surfels would be by the label maps of all photos: the most frequent class of their pixels. No marks can make
    more of them."""
    votes = np.zeros((len(subject.ready.surfels), len(subject.class_ids)), np.float32)
    index = np.full(max(subject.class_ids) + 1, -1)
    index[subject.class_ids] = np.arange(len(subject.class_ids))
    for photo in subject.ready.photos:
        if photo.name not in subject.truth:
            continue
        surfel, edge = subject.ready.map_of(photo.name)
        label = index[nearest(subject.truth[photo.name], photo.width, photo.height)]
        told = (surfel >= 0) & ~edge & (label >= 0)
        np.add.at(votes, (surfel[told], label[told]), 1)
    share = votes / np.maximum(votes.sum(1, keepdims=True), 1)
    return labelled(share, subject.class_ids)
