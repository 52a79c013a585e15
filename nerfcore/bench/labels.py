"""The suite `labels`: how right a scene is labelled by a few strokes on two of its photos, and how long that takes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..files import write_json, write_text
from ..labels.next_photo import first_photos
from ..labels.preparation import Preparation, ensured
from ..params import BenchParams, TrainParams
from ..progress import Reporter
from ..project.fingerprints import digest
from ..project.runs import read_metrics, run_folder
from ..project.store import edit_project, is_project
from ..train.reuse import finished, train_or_keep, unfinished
from .label_bounds import best_order, class_overlaps, every_pixel, held_out, seen_before, withheld
from .label_studies import (
    CURVES,
    MANY_PHOTOS,
    PHOTOS,
    many_classes,
    parts_of_the_method,
    photo_curves,
    photos_needed,
    wrong_strokes,
)
from .label_times import accepted, figures_of, waiting_times, without_marks
from .label_trials import CORRECTIONS, Annotator, Subject, all_labels, read_subject, scores
from .machine import describe, taken
from .page import figures_folder, write_page
from .results import ResultSet, write_set
from .suites import limits
from .tables import table

TOOL_CHOOSES = ("replica_room",)  # the photos the annotator begins with; of other scenes those that show most classes
STEPS = 800
SEEDS = [0, 1, 2, 3, 4]
# What is asked: mIoU from two photos and after the corrections, as it is or as a share of that with all label maps.
ASKED = {"museum": (0.90, 0.95), "facade": (0.85, None)}
ASKED_SHARE = {"replica_room": 0.90}
ASKED_MANY = {"replica_room": 0.80}
SECONDS = {
    "parts": ("from a stroke to whole parts (s), 95 %", 0.3),
    "full": ("from a stroke to all surfels (s), 95 %", 3.0),
    "undo": ("undo (s), 95 %", 0.3),
    "overlay": ("labels of another photo (s), 95 %", 0.05),
    "click": ("click, photo encoded, without the model (s), 95 %", 0.15),
}
LONGEST = 20.0  # seconds of preparing and of accepting
COLUMNS = {
    "scene": "scene",
    "figure": "figure",
    "asked": "asked",
    "worst": "worst",
    "mean": "mean",
    "reached": "reached",
}
Row = dict[str, Any]


def labels_suite(
    params: BenchParams, projects: dict[str, Path], out: Path, command: str, report: Reporter
) -> dict[str, Any]:
    """Label each scene with several seeds of the simulated annotator.

    Args:
        projects: with label maps, which the field and the annotator's tools do not see, by the scenes' names.
        command: the command line that measures the same.
    Returns:
        {"suite", "machine", "runs", "failed", "rows", "trials", "notes", "files"}
    """
    origin = taken()
    rows: list[Row] = []
    trials: list[dict[str, Any]] = []
    notes: list[str] = []
    seeds = params.seeds or SEEDS
    for name, labelled in projects.items():
        bare = without_labels(labelled, out / "projects" / name)
        training = TrainParams.model_validate(
            {"project": bare, "preset": params.preset, "set": params.set, **limits(params, STEPS)}
        )
        if finished(training).result is None:
            train_or_keep(training.model_copy(update={"resume": unfinished(training)}), report)
        ready, _ = ensured(bare, "main", report)
        file, made = out / "runs" / f"{name}.json", digest([ready.inputs, seeds, origin.commit, origin.modified])
        known = read_run(file, made)
        if known is None:
            known = {"made": made, **scene_figures(name, bare, labelled, ready, out, seeds, report)}
            write_json(file, known)
        rows += known["rows"]
        trials += known["trials"]
        notes += known["notes"]
    machine = describe()
    if params.page is not None:
        result = ResultSet(
            suite="labels",
            title=f"Seeds {', '.join(map(str, seeds))} ({origin.date})",
            command=command,
            source="bench",
            taken=origin,
            columns=COLUMNS,
            rows=rows,
            notes=notes,
        )
        write_set(figures_folder(params.page), result)
        write_page(params.page)
    files = [out / "results.json", out / "table.md"]
    text = f"# Suite labels\n\nMachine: {machine}.\n\n{table(COLUMNS, rows)}\n\n" + "".join(f"- {n}\n" for n in notes)
    write_json(files[0], {"suite": "labels", "machine": machine, "rows": rows, "trials": trials, "notes": notes})
    write_text(files[1], text)
    return {
        "suite": "labels",
        "machine": machine,
        "runs": len(trials),
        "failed": 0,
        "rows": rows,
        "trials": trials,
        "notes": notes,
        "files": [str(path) for path in files],
    }


def read_run(file: Path, made: str) -> dict[str, Any] | None:
    """What was measured of a scene before, by the same code with the same seeds on the same surfels; None where it was not."""
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) and value.get("made") == made else None


def scene_figures(
    name: str, bare: Path, labelled: Path, ready: Preparation, out: Path, seeds: list[int], report: Reporter
) -> dict[str, Any]:
    """{"rows", "trials", "notes"} of one scene: `bare` its project without label maps, `labelled` the one with them."""
    subject = read_subject(ready, labelled, None)
    if name in TOOL_CHOOSES:
        subject = replace(subject, first=[photo for photo, _ in first_photos(ready, subject.train, 2)])
    steps = read_metrics(run_folder(bare, "main")).get("train", {}).get("steps", "an unknown number of")
    about = (
        f"{name}: field of {steps} steps, {len(ready.surfels):,} surfels; {len(subject.class_ids)} classes; strokes on "
        f"{' and '.join(subject.first)}."
    )
    own = scene_trials(subject, seeds, report)
    marked, most = every_pixel(subject, report), all_labels(subject)
    bounds = [
        row("held-out pixels whose surface the two photos show", [seen_before(subject, held_out(subject))]),
        row("mIoU, two photos, every pixel of them marked", [scores(subject, marked)["miou"]]),
    ]
    shown = Annotator(subject, seeds[0]).look(report)
    ious = [class_overlaps(subject, labels) for labels in (shown, marked, most)]
    found, told = studied(name, subject, labelled, seeds, own, report)
    times = timed(bare, out / "accepted" / name, subject, seeds[0], report)
    return {
        "rows": [
            {"scene": name, **row} for row in [*accuracy(name, own, scores(subject, most)), *bounds, *found, *times]
        ],
        "trials": [{"scene": name, **trial} for trial in own],
        "notes": [about, *(f"{name}: {line}" for line in [overlap_text(subject.class_ids, ious), *told])],
    }


def overlap_text(class_ids: list[int], ious: list[dict[int, float]]) -> str:
    """What is to be said of the IoU of each class, by strokes, by every pixel of the photos and by all label maps."""
    each = [f"class {i} {', '.join(f'{found[i]:.2f}' for found in ious)}" for i in class_ids if i in ious[0]]
    return f"IoU by strokes, by every pixel of the two photos, by all label maps: {'; '.join(each)}."


def without_labels(labelled: Path, target: Path) -> Path:
    """A copy of a project without its label maps."""
    if not is_project(target):
        half_made = target.with_name(f".{target.name}")
        shutil.rmtree(half_made, ignore_errors=True)
        shutil.copytree(labelled, half_made, ignore=shutil.ignore_patterns("runs", "jobs", "exports", "labels"))
        with edit_project(half_made) as project:
            for image in project.images:
                image.label = None
        half_made.rename(target)
    return target


def scene_trials(subject: Subject, seeds: list[int], report: Reporter) -> list[dict[str, Any]]:
    """For each seed the scores after the first strokes and after each correction."""
    trials = []
    for seed in seeds:
        report.stage(f"Strokes, seed {seed}")
        annotator = Annotator(subject, seed)
        steps = [scores(subject, annotator.look(report))]
        first = len(annotator.marks)
        while len(steps) <= CORRECTIONS and annotator.correct():
            report.progress(len(steps) / (CORRECTIONS + 1))
            steps.append(scores(subject, annotator.look(report)))
        trials.append({"seed": seed, "strokes": first, "steps": steps, "seconds": annotator.times})
    return trials


def row(
    figure: str, values: Sequence[float | None], least: float | None = None, most: float | None = None, words: str = ""
) -> Row:
    """A row of the table: the worst of some values, their mean, and whether the worst is what is asked, at least or at most."""
    known = [value for value in values if value is not None]
    worst = None if not known else max(known) if most is not None else min(known)
    asked = "–" if least is None and most is None else f"≥ {least:g}" if least is not None else f"≤ {most:g}"
    reached = None
    if worst is not None and (least is not None or most is not None):
        reached = worst >= least if least is not None else worst <= (most or 0.0)
    return {
        "figure": figure,
        "asked": asked + words,
        "worst": None if worst is None else round(worst, 4),
        "mean": None if not known else round(float(np.mean(known)), 4),
        "reached": None if reached is None else "yes" if reached else "no",
    }


def worst_of_losses(figure: str, lost: Sequence[float]) -> Row:
    """A row that nothing is asked of, whose worst value is the largest."""
    return {**row(figure, lost, most=1.0), "asked": "–", "reached": None}


def accuracy(name: str, trials: list[dict[str, Any]], most: dict[str, Any]) -> list[Row]:
    """How right labels are after the first strokes, after the corrections, and by all label maps."""
    share = ASKED_SHARE.get(name)
    first, last = ASKED.get(name, (None, None))
    words = "" if share is None else f" ({share:g} × all label maps)"
    asked = round(share * most["miou"], 4) if share is not None else first
    steps = {
        "two photos": [t["steps"][0] for t in trials],
        f"{CORRECTIONS} corrections": [t["steps"][-1] for t in trials],
    }
    found = [
        row("mIoU, two photos", [step["miou"] for step in steps["two photos"]], asked, words=words),
        row(f"mIoU, {CORRECTIONS} corrections", [t["steps"][-1]["miou"] for t in trials], last),
        row("mIoU, all label maps: the most that surfels can show", [most["miou"]]),
    ]
    for when, own in steps.items():
        found += [
            row(f"calibration error, {when}", [step["ece"] for step in own], most=0.05),
            row(f"right above 0.9, {when}", [step["sure_right"] for step in own], 0.97),
            row(f"without class, {when}", [step["void"] for step in own]),
        ]
    return found


def studied(
    name: str, subject: Subject, project: Path, seeds: list[int], trials: list[dict[str, Any]], report: Reporter
) -> tuple[list[Row], list[str]]:
    """The other studies of a scene, and what is to be said of them."""
    report.stage("Wrong strokes")
    right = [t["steps"][0]["miou"] for t in trials]
    found = [wrong_strokes(subject, t["seed"], report) for t in trials]
    lost, least = ([miou - values[way] for miou, values in zip(right, found)] for way in (0, 1))
    report.stage("Classes without strokes")
    hidden = withheld(subject, seeds[0], report)
    report.stage("Parts of the method")
    ablation = [parts_of_the_method(subject, seed, report) for seed in seeds]
    report.stage("Next photos")
    curves = [photo_curves(subject, seed, report) for seed in seeds[:CURVES]]
    needed = photos_needed(curves)
    order = {**curves[0], "best": best_order(subject, seeds[0], PHOTOS, report)}
    rows = [
        row("mIoU lost by 30 % wrong strokes", lost, most=0.05),
        worst_of_losses("mIoU lost where just these are left out", least),
    ]
    if hidden:
        rows.append(row("void share of a class without strokes", [h.void for h in hidden.values()], 0.8))
        rows.append(
            row("void share of a class without strokes, best threshold", [h.void_at_best for h in hidden.values()])
        )
    chance = row("photos needed by the next photo, of those by chance", [needed], most=0.5)
    rows.append(chance if needed is not None else {**chance, "reached": "no"})
    rows.append(row("photos needed by the best order, of those by chance", [photos_needed([order], "best")]))
    rows += [row(f"mIoU, two photos, {words}", [found[words] for found in ablation]) for words in ablation[0]]
    means = {way: np.mean([curve[way] for curve in curves], 0).round(3).tolist() for way in curves[0]}
    told = [
        f"mIoU after each of {PHOTOS} photos: next photo {means['next']}, by chance {means['random']}; seed {seeds[0]}: "
        f"next photo {rounded(order['next'])}, by chance {rounded(order['random'])}, best order {rounded(order['best'])}.",
        "void without strokes (by the best threshold; what most of the rest is taken for): "
        + "; ".join(
            f"class {i} {h.void:.0%} ({h.void_at_best:.0%}; {h.other} {h.as_other:.0%})" for i, h in hidden.items()
        )
        + ".",
    ]
    if name in ASKED_MANY:
        report.stage("All classes")
        count, found, marked, most = many_classes(subject.ready, project, seeds, report)
        asked = ASKED_MANY[name]
        words = f" ({asked:g} × all label maps, {most:g})"
        rows.append(row(f"mIoU, {count} classes from {MANY_PHOTOS} photos", found, round(asked * most, 4), words=words))
        rows.append(row(f"mIoU, {count} classes, every pixel of {MANY_PHOTOS} photos marked", [marked]))
    return rows, told


def rounded(values: list[float]) -> list[float]:
    return [round(value, 3) for value in values]


def timed(bare: Path, place: Path, subject: Subject, seed: int, report: Reporter) -> list[Row]:
    """How long everything takes, and what accepting changes."""
    report.stage("Times")
    copy = without_marks(bare, place)
    found = waiting_times(copy, subject, seed, report)
    rows = []
    for key, (words, most) in SECONDS.items():
        told = figures_of(found[key])
        rows.append({**row(words, [told["p95"]], most=most), "mean": told["median"]})
    rows.append(row("prepare (s)", [subject.ready.seconds], most=LONGEST))
    report.stage("Accepting")
    took = accepted(copy, subject, report)
    shutil.rmtree(copy, ignore_errors=True)
    rows.append(row("accept (s)", [took["seconds"]], most=LONGEST))
    rows.append(row("accept: PSNR changed by (dB)", [abs(took["psnr"])], most=0.0))
    rows.append(row("accept: mIoU lost against what was shown", [took["shown"] - took["miou"]], most=0.02))
    return rows
