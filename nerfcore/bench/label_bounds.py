"""What the suite `labels` measures beside each figure that is asked: how far one would come who knows more than the marks say.

A figure that stays below what is asked is short of information where these are short of it too, else of method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..evaluate.metrics import Confusion
from ..images.working import nearest
from ..labels.lookup import Labelling
from ..labels.part_labels import by_parts
from ..labels.propagation import propagated
from ..labels.seeds import Seeds
from ..progress import Reporter
from .annotator import first_strokes
from .label_trials import Annotator, Subject, labelled

MAY_LOSE = 0.01  # of the mIoU of a scene with all classes marked, for the sake of void
THRESHOLDS = 200
CANDIDATES = 16  # photos that are tried before each is chosen


@dataclass(frozen=True)
class HeldOut:
    """The pixels (P,) of the held-out photos whose class is asked for: surfel, −1 for none, and index of the true class."""

    surfel: np.ndarray
    truth: np.ndarray


def held_out(subject: Subject) -> HeldOut:
    surfels, truths = [], []
    for name in subject.test:
        truth = subject.truth[name]
        asked = np.isin(truth, subject.class_ids)
        surfel, _ = subject.ready.map_of(name)
        surfels.append(nearest(surfel, truth.shape[1], truth.shape[0])[asked])
        truths.append(np.searchsorted(subject.class_ids, truth[asked]))
    return HeldOut(np.concatenate(surfels), np.concatenate(truths))


def of_pixels(pixels: HeldOut, of_surfel: np.ndarray, elsewhere: float) -> np.ndarray:
    """Values (P,) of pixels by those (N,) of surfels; `elsewhere`: where no surface is."""
    return np.append(of_surfel, np.asarray(elsewhere, of_surfel.dtype))[pixels.surfel]


def confusion_of(pixels: HeldOut, classes: int, index: np.ndarray) -> Confusion:
    """True class against that (P,) of pixels, by class indices; `classes`: void."""
    found = Confusion(list(range(classes)))
    found.counts += np.bincount(pixels.truth * (classes + 1) + index, minlength=classes * (classes + 1)).reshape(
        classes, classes + 1
    )
    return found


def indices(subject: Subject, pixels: HeldOut, labelling: Labelling) -> np.ndarray:
    """Class index (P,) that a labelling gives to pixels, the number of classes for void."""
    lookup = np.full(max([*subject.class_ids, subject.void]) + 1, len(subject.class_ids))
    lookup[subject.class_ids] = np.arange(len(subject.class_ids))
    return lookup[of_pixels(pixels, labelling.label(subject.void), subject.void)]


def class_overlaps(subject: Subject, labelling: Labelling) -> dict[int, float]:
    """IoU of each class that held-out photos show."""
    pixels, classes = held_out(subject), len(subject.class_ids)
    found = confusion_of(pixels, classes, indices(subject, pixels, labelling)).iou()
    return {subject.class_ids[number]: value for number, value in found.items()}


def seen_before(subject: Subject, pixels: HeldOut) -> float:
    """Share of the held-out pixels whose surfel the photos that are marked first show."""
    shown = np.zeros(len(subject.ready.surfels), bool)
    for name in subject.first:
        surfel, _ = subject.ready.map_of(name)
        shown[surfel[surfel >= 0]] = True
    return float(of_pixels(pixels, shown, False).mean())


def every_pixel(subject: Subject, report: Reporter) -> Labelling:
    """Labels by the method itself where not strokes but all pixels of the first photos are marked, as one mark of each class
    on each photo. A surfel gets the class of most of its pixels."""
    votes = np.zeros((len(subject.first), len(subject.ready.surfels), len(subject.class_ids)), np.int32)
    for number, name in enumerate(subject.first):
        surfel, edge = subject.ready.map_of(name)
        truth = nearest(subject.truth[name], surfel.shape[1], surfel.shape[0])
        told = (surfel >= 0) & ~edge & np.isin(truth, subject.class_ids)
        np.add.at(votes[number], (surfel[told], np.searchsorted(subject.class_ids, truth[told])), 1)
    total = votes.sum(0)
    known = np.flatnonzero(total.any(1))
    label = total[known].argmax(1)
    photo = votes[:, known, label].argmax(0).astype(np.int32)
    mark = photo * len(subject.class_ids) + label + 1
    seeds = Seeds(known, label.astype(np.int32), mark.astype(np.int32), [], [], None, photo)
    return labelled(propagated(subject.ready, seeds, len(subject.class_ids), check=report.check), subject.class_ids)


@dataclass(frozen=True)
class Withheld:
    """What becomes of the held-out pixels of a class that gets no stroke: the share that is void; the share that would be by
    the best threshold (see `boldest`); the class that most of the others are given, and their share."""

    void: float
    void_at_best: float
    other: int
    as_other: float


def withheld(subject: Subject, seed: int, report: Reporter) -> dict[int, Withheld]:
    """Each class that held-out photos show, without its strokes."""
    pixels = held_out(subject)
    threshold = boldest(subject, pixels, Annotator(subject, seed).look(report))
    found = {}
    for number, class_id in enumerate(subject.class_ids):
        own = pixels.truth == number
        if not own.any():
            continue
        shown = Annotator(subject, seed, class_id).look(report)
        void = of_pixels(pixels, 1 - shown.probability.sum(1), 1.0)[own]
        given = np.bincount(indices(subject, pixels, shown)[own], minlength=len(subject.class_ids) + 1) / own.sum()
        most = int(given[:-1].argmax())
        other, as_other = subject.class_ids[most], float(given[most])
        found[class_id] = Withheld(float(given[-1]), float((void > threshold).mean()), other, as_other)
    return found


def boldest(subject: Subject, pixels: HeldOut, shown: Labelling) -> float:
    """The least probability of void above which surfels of a scene with all classes marked may be void, so that its mIoU loses
    no more than `MAY_LOSE`: the threshold that makes most void of what got no stroke, known to whom knows the truth."""
    classes = len(subject.class_ids)
    void = of_pixels(pixels, 1 - shown.probability.sum(1), 1.0)
    best = of_pixels(pixels, shown.probability.argmax(1), classes)
    # The classes that got a stroke may be fewer than those that are asked for.
    best = np.append(np.searchsorted(subject.class_ids, shown.class_ids), classes)[
        np.minimum(best, len(shown.class_ids))
    ]
    before = confusion_of(pixels, classes, indices(subject, pixels, shown)).miou() or 0.0
    for threshold in np.unique(np.quantile(void, np.linspace(0, 1, THRESHOLDS))):
        index = np.where(void > threshold, classes, best)
        if (confusion_of(pixels, classes, index).miou() or 0.0) >= before - MAY_LOSE:
            return float(threshold)
    return 1.0


def best_order(subject: Subject, seed: int, photos: int, report: Reporter) -> list[float]:
    """mIoU after each of some photos in the order of one who knows the classes of the held-out ones: always that of some
    photos, drawn at random, whose strokes, carried over whole parts of the surface, give the best mIoU there."""
    pixels, classes = held_out(subject), len(subject.class_ids)
    part = of_pixels(pixels, np.asarray(subject.ready.parts[:, 0]), -1)
    parts = len(subject.ready.part_features)
    number = np.where(part < 0, parts, part) * classes + pixels.truth
    amount = np.bincount(number, minlength=(parts + 1) * classes).reshape(parts + 1, classes)
    annotator = Annotator(replace(subject, first=subject.first[:1]), seed)
    taken, curve, random = [subject.first[0]], [], np.random.default_rng([seed, 13])
    while True:
        index = indices(subject, pixels, annotator.look(report))
        curve.append(round(confusion_of(pixels, classes, index).miou() or 0.0, 4))
        left = [name for name in subject.train if name not in taken]
        if len(taken) == photos or not left:
            return curve
        tried = random.permutation(left)[:CANDIDATES].tolist()
        drawn = {name: first_strokes(name, subject.truth[name], subject.class_ids, seed) for name in tried}
        before, values = list(annotator.marks), {}
        for name, strokes in drawn.items():
            annotator.add(strokes)
            values[name] = _by_parts(annotator, amount, report)
            annotator.marks = list(before)
        best = max(tried, key=lambda name: values[name])
        taken.append(best)
        annotator.add(drawn[best])


def _by_parts(annotator: Annotator, amount: np.ndarray, report: Reporter) -> float:
    """mIoU of the labels of parts, by how many held-out pixels (P + 1, C) of each class each has, the last one being none."""
    subject, classes = annotator.subject, amount.shape[1]
    seeds, class_ids = annotator.seeds()
    guess = labelled(by_parts(subject.ready, seeds, len(class_ids), report.check), class_ids).label(subject.void)
    found = Confusion(subject.class_ids)
    index = np.append(np.searchsorted(subject.class_ids, guess), classes)
    index[:-1][guess == subject.void] = classes
    np.add.at(found.counts.T, index, amount)
    return found.miou() or 0.0
