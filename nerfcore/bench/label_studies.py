"""What the suite `labels` asks beside the strokes on two photos: wrong strokes, which photo is next, what each part of the
method adds, and scenes of many classes."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..labels.next_photo import usefulness
from ..labels.preparation import Preparation
from ..labels.propagation import appearance, propagated
from ..progress import Reporter
from .annotator import LEAST_PIXELS, first_strokes
from .label_bounds import every_pixel
from .label_trials import Annotator, Subject, all_labels, labelled, read_subject, scores

WRONG = 0.3  # share of the strokes that get another class
PHOTOS = 6  # that are marked one after the other, to see which were worth it
CURVES = 3  # seeds of that
MANY_PHOTOS = 7  # for all classes of a scene
FINE = {"shape": "part", "level": "fine"}


def wrong_strokes(subject: Subject, seed: int, report: Reporter) -> tuple[float, float]:
    """mIoU where a share of the strokes on the first photos have another class than the true one, and where just these are
    left out: as much as can be had by one who knows which they are."""
    annotator = Annotator(subject, seed)
    random = np.random.default_rng([seed, 7])
    wrong = random.choice(len(annotator.marks), round(WRONG * len(annotator.marks)), replace=False)
    marked = sorted({mark.class_id for mark in annotator.marks if mark.class_id is not None})
    for number in wrong.tolist():
        mark = annotator.marks[number]
        other = int(random.choice([i for i in marked if i != mark.class_id]))
        annotator.marks[number] = mark.model_copy(update={"class_id": other})
    found = scores(subject, annotator.look(report))["miou"]
    annotator.marks = [mark for number, mark in enumerate(annotator.marks) if number not in wrong]
    return found, scores(subject, annotator.look(report))["miou"]


def parts_of_the_method(subject: Subject, seed: int, report: Reporter) -> dict[str, float]:
    """mIoU of the first strokes with a part of the method after the other: looks of surfels alone, the graph that evens
    them out, strokes that take whole parts of the surface, and what filters see in the photos. Each with those before it."""
    bare = copy.copy(subject.ready)
    bare.photo_features = bare.photo_features[:, :0]
    bare.part_features = bare.part_features[:, : bare.features.shape[1]]
    plain = replace(subject, ready=bare)
    annotator, found = Annotator(plain, seed), {}
    seeds, class_ids = annotator.seeds()
    look, _ = appearance(bare, seeds, len(class_ids))
    found["head only"] = scores(plain, labelled(look, class_ids))["miou"]
    found["+ graph"] = scores(plain, labelled(propagated(bare, seeds, len(class_ids)), class_ids))["miou"]
    report.check()
    for words, own in (("+ parts", plain), ("+ image features", subject)):
        annotator = Annotator(own, seed)
        annotator.marks = [mark.model_copy(update=FINE) for mark in annotator.marks]
        found[words] = scores(own, annotator.look(report))["miou"]
    return found


def photo_curves(subject: Subject, seed: int, report: Reporter) -> dict[str, list[float]]:
    """mIoU after each photo on which all classes were stroked, {"next": as `label next` says, "random": as chance does};
    both begin with the same one."""
    curves: dict[str, list[float]] = {}
    for way in ("next", "random"):
        random = np.random.default_rng([seed, 11])
        annotator = Annotator(replace(subject, first=subject.first[:1]), seed)
        taken, curve = [subject.first[0]], []
        while True:
            shown = annotator.look(report)
            curve.append(scores(subject, shown)["miou"])
            left = [name for name in subject.train if name not in taken]
            if len(taken) == PHOTOS or not left:
                break
            if way == "random":
                photo = str(random.choice(left))
            else:
                worth = usefulness(subject.ready, shown, set(taken))
                order = [subject.ready.photos[number].name for number in np.argsort(-worth, kind="stable")]
                photo = next(name for name in order if name in left)
            taken.append(photo)
            annotator.add(first_strokes(photo, subject.truth[photo], subject.class_ids, seed))
        curves[way] = curve
    return curves


def photos_needed(curves: list[dict[str, list[float]]], way: str = "next") -> float | None:
    """Photos that a choice needs for what chance has in the end, as a share of those that chance took: means over
    seeds, between photos linearly. None where it does not come that far."""
    chosen, chance = (np.mean([curve[key] for curve in curves], 0) for key in (way, "random"))
    wanted = float(chance.max())
    above = np.flatnonzero(chosen >= wanted)
    if not len(above):
        return None
    first = int(above[0])
    took = int(chance.argmax()) + 1
    if first == 0:
        return 1 / took
    before, after = chosen[first - 1], chosen[first]
    return (first + (wanted - before) / (after - before)) / took


def many_classes(
    ready: Preparation, project: Path, seeds: list[int], report: Reporter
) -> tuple[int, list[float], float, float]:
    """All classes of a scene from several photos: number of classes, mIoU of each seed, that of every pixel of these photos,
    and that of all label maps. The photos are those that together show most of the classes."""
    subject = read_subject(ready, project, ["?"], least_share=0.0)
    sizes = {n: np.array([np.count_nonzero(subject.truth[n] == i) for i in subject.class_ids]) for n in subject.train}
    subject = replace(subject, first=photos_that_show(sizes))
    found = [scores(subject, Annotator(subject, seed).look(report))["miou"] for seed in seeds]
    bounds = (scores(subject, labels)["miou"] for labels in (every_pixel(subject, report), all_labels(subject)))
    return len(subject.class_ids), found, *bounds


def photos_that_show(sizes: dict[str, np.ndarray]) -> list[str]:
    """The photos, one after the other, that add most classes on enough pixels, and these largest; sizes (C,) of each."""
    best = np.zeros(len(next(iter(sizes.values()))))
    chosen: list[str] = []
    for _ in range(min(MANY_PHOTOS, len(sizes))):
        added = {name: np.maximum(best, size) for name, size in sizes.items() if name not in chosen}
        photo = max(added, key=lambda name: (int((added[name] >= LEAST_PIXELS).sum()), np.log1p(added[name]).sum()))
        chosen.append(photo)
        best = np.maximum(best, sizes[photo])
    return chosen
