"""The suite `labels`: how right a scene is labelled by a few strokes on two of its photos."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..files import write_json, write_text
from ..labels.overlay import photo_labels
from ..labels.preparation import ensured
from ..params import BenchParams, TrainParams
from ..progress import Reporter
from ..project.runs import has_checkpoint, run_folder
from ..project.store import edit_project, is_project
from ..train.verb import train
from .label_trials import CORRECTIONS, Annotator, Subject, all_labels, hidden_void, read_subject, scores
from .machine import describe, taken
from .page import figures_folder, write_page
from .results import ResultSet, write_set
from .tables import table

FIRST = {"replica_room": ["39", "111"]}  # photos the annotator begins with; others: those that show most classes
STEPS = 800
SEEDS = [0, 1, 2, 3, 4]
COLUMNS = {
    "scene": "scene",
    "strokes": "strokes",
    "miou": "mIoU, worst seed",
    "mean": "mIoU, mean",
    "ece": "ECE, worst",
    "sure_right": "right above 0.9, worst",
    "void": "without class, most",
}


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
    rows: list[dict[str, Any]] = []
    trials: list[dict[str, Any]] = []
    notes: list[str] = []
    seeds = params.seeds or SEEDS
    for name, labelled in projects.items():
        bare = without_labels(labelled, out / "projects" / name)
        if not has_checkpoint(run_folder(bare, "main")):
            limits = {"steps": params.steps or STEPS, "time_limit": params.seconds}
            train(TrainParams(project=bare, preset=params.preset, set=params.set, **limits), report)
        begin = time.perf_counter()
        ready, reused = ensured(bare, "main", report)
        made = "reused" if reused else f"made in {time.perf_counter() - begin:.0f} s"
        subject = read_subject(ready, labelled, FIRST.get(name))
        notes.append(
            f"{name}: {len(ready.surfels):,} surfels, {made}; {len(subject.class_ids)} classes; strokes on "
            f"{' and '.join(subject.first)}."
        )
        own = scene_trials(subject, seeds, report)
        trials += [{"scene": name, **trial} for trial in own]
        rows += [{"scene": name, **row} for row in summarised(own, scores(subject, all_labels(subject)))]
        notes += [f"{name}: {line}" for line in [*hidden_notes(subject, seeds[0], report), *time_notes(subject, own)]]
    machine = describe()
    if params.page is not None:
        result = ResultSet(
            suite="labels",
            title=f"{params.steps or STEPS} steps, seeds {', '.join(map(str, seeds))} ({origin.date})",
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
    paths = [str(path) for path in files]
    return {
        "suite": "labels",
        "machine": machine,
        "runs": len(trials),
        "failed": 0,
        "rows": rows,
        "trials": trials,
        "notes": notes,
        "files": paths,
    }


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
    """For each seed the scores after the first strokes and after each correction, and the seconds each result took."""
    trials = []
    for seed in seeds:
        report.stage(f"Strokes, seed {seed}")
        annotator = Annotator(subject, seed)
        alone = scores(subject, annotator.by_appearance())
        steps = [scores(subject, annotator.look(report))]
        first = len(annotator.marks)
        while len(steps) <= CORRECTIONS and annotator.correct():
            report.progress(len(steps) / (CORRECTIONS + 1))
            steps.append(scores(subject, annotator.look(report)))
        trials.append({"seed": seed, "strokes": first, "appearance": alone, "steps": steps, "seconds": annotator.times})
    return trials


def summarised(trials: list[dict[str, Any]], most: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of the table: after the first strokes, by the look of surfels alone and with the graph, after the corrections,
    and by all label maps."""
    rows = []
    shown = {
        "on two photos, look alone": [trial["appearance"] for trial in trials],
        "on two photos": [trial["steps"][0] for trial in trials],
        f"{CORRECTIONS} corrections": [trial["steps"][-1] for trial in trials],
    }
    for words, found in shown.items():
        miou = [step["miou"] for step in found]
        sure = [step["sure_right"] for step in found if step["sure_right"] is not None]
        rows.append(
            {
                "strokes": words,
                "miou": min(miou),
                "mean": round(float(np.mean(miou)), 4),
                "ece": max(step["ece"] for step in found),
                "sure_right": min(sure, default=None),
                "void": max(step["void"] for step in found),
            }
        )
    return [*rows, {"strokes": "all label maps", "mean": most["miou"], **{k: most[k] for k in ("miou", "void")}}]


def hidden_notes(subject: Subject, seed: int, report: Reporter) -> list[str]:
    """How much of each class is void when it gets no stroke."""
    shares = {}
    for class_id in subject.class_ids:
        share = hidden_void(subject, Annotator(subject, seed, class_id).look(report), class_id)
        if share is not None:
            shares[class_id] = share
    if not shares:
        return []
    enough = sum(share >= 0.8 for share in shares.values())
    each = ", ".join(f"{class_id}: {share:.0%}" for class_id, share in shares.items())
    return [f"a class without strokes is at least 80 % void for {enough} of {len(shares)} classes ({each})."]


def time_notes(subject: Subject, trials: list[dict[str, Any]]) -> list[str]:
    """How long results take after a stroke, and the labels of a photo."""
    seconds = [s for trial in trials for s in trial["seconds"]]
    labelling = all_labels(subject)
    looks = []
    for photo in subject.ready.photos[:20]:
        begin = time.perf_counter()
        photo_labels(subject.ready, labelling, photo.name, subject.void)
        looks.append(time.perf_counter() - begin)
    return [
        f"from strokes to labels of all surfels {np.median(seconds):.1f} s, 95 % within "
        f"{np.percentile(seconds, 95):.1f} s; labels of a photo {1e3 * np.median(looks):.0f} ms, 95 % within "
        f"{1e3 * np.percentile(looks, 95):.0f} ms."
    ]
