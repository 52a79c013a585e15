"""The suite `measures`: whether what `measure` says of a thing holds its true size.

For each seed a small capture whose sizes are known (`still_life.py`) goes all the way a user's does: photos, field, mesh,
measures. The scale is as wrong as `measure` is told that it may be.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FieldworkError
from ..files import write_json, write_text
from ..measure.verb import measure
from ..mesh.verb import mesh
from ..params import BenchParams, MeasureParams, MeshParams, TrainParams
from ..progress import Reporter
from ..project.fingerprints import digest
from ..train.verb import train
from .machine import describe, taken
from .page import figures_folder, write_page
from .results import ResultSet, write_set
from .still_life import NAMES, SCALE, StillLife, photographed, still_life
from .suites import limits
from .tables import table

SEEDS = list(range(20))
STEPS = 200
CELLS = 112  # of the mesh, along its longest side
STANDS = 0.4  # share of its area on which a thing stands, at most
# A field as small as the photos.
SMALL = {
    "field.levels": "5",
    "field.width": "32",
    "field.table_log2": "15",
    "field.finest": "256",
    "sampling.warmup": "64",
    "train.batch_start": "4096",
    "train.batch_samples": "16384",
}
COLUMNS = {
    "size": "size",
    "held": "true size in the 95 % interval",
    "half": "half of the interval, mean (%)",
    "off": "off by, mean (%)",
    "spread": "off by, standard deviation (%)",
}


def measures_suite(params: BenchParams, out: Path, command: str, report: Reporter) -> dict[str, Any]:
    """Measure a still life of each seed, or what is missing of that.

    Args:
        out: folder of the suite; a seed whose figures are there is not measured again.
    Returns:
        {"suite", "machine", "runs", "failed", "rows", "trials", "notes", "files"}
    """
    seeds, origin, trials, failed = params.seeds or SEEDS, taken(), [], 0
    # Of other settings, and of other code, figures are others.
    made = digest([limits(params, STEPS), params.set, origin.machine.model_dump(), origin.commit, origin.modified])
    for number, seed in enumerate(seeds):
        stored = out / "runs" / f"{seed}-{made[:12]}.json"
        report.progress(number / len(seeds), f"capture {number + 1} of {len(seeds)}")
        if not stored.is_file():
            try:
                write_json(stored, one_trial(seed, params, out / "projects" / f"{seed}", report))
            except FieldworkError as error:
                report.warn(f"Capture {seed}: {error}")
                failed += 1
                continue
        trials.append(json.loads(stored.read_text(encoding="utf-8")))
    rows, machine = summarised(trials), describe()
    seconds = [trial["processor_seconds"] for trial in trials]
    notes = [f"A capture took {np.mean(seconds):.0f} seconds of a processor."] if seconds else []
    if params.page is not None:
        result = ResultSet(
            suite="measures",
            title=f"{len(trials)} captures ({origin.date})",
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
    kept = {"suite": "measures", "machine": machine, "rows": rows, "trials": trials, "notes": notes}
    write_json(files[0], kept)
    text = f"# Suite measures\n\nMachine: {machine}.\n\n{table(COLUMNS, rows)}\n\n" + "".join(f"- {n}\n" for n in notes)
    write_text(files[1], text)
    return {**kept, "runs": len(trials), "failed": failed, "files": [str(path) for path in files]}


def one_trial(seed: int, params: BenchParams, project: Path, report: Reporter) -> dict[str, Any]:
    """The measures of one capture: {"seed", "sizes": [{"name", "kind": "area" or "volume", "true", "value", "low", "high"}],
    "processor_seconds"}; value None where there is none."""
    shutil.rmtree(project, ignore_errors=True)
    begin, truth = time.process_time(), still_life(seed)
    report.stage("Photographing")
    photographed(truth, project, seed)
    settings = {**SMALL, "train.seed": str(seed), **params.set}
    training = {"project": project, "preset": "draft", "set": settings, **limits(params, STEPS)}
    train(TrainParams.model_validate(training), report)
    mesh(MeshParams(project=project, resolution=CELLS), report)
    found = measure(MeasureParams(project=project, scale_error=100 * SCALE, caps=STANDS), report)
    seconds = time.process_time() - begin
    if not params.keep:
        shutil.rmtree(project)
    return {"seed": seed, "sizes": sizes(truth, found["classes"]), "processor_seconds": round(seconds, 1)}


def sizes(truth: StillLife, measured: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """True and measured sizes of the things on the table."""
    by_id = {row["id"]: row for row in measured}
    rows = []
    for number, volume in truth.volumes.items():
        for kind, true in (("area", truth.area(number)), ("volume", volume)):
            row = by_id.get(number, {})
            found = {"value": row.get(kind), "low": row.get(f"{kind}_low"), "high": row.get(f"{kind}_high")}
            rows.append({"name": NAMES[number - 1], "kind": kind, "true": true, **found})
    return rows


def summarised(trials: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each size: how often the interval holds the truth, of all trials, how wide it is, and how far off values
    are. A size that was not measured is not held."""
    by_size: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for size in (size for trial in trials for size in trial["sizes"]):
        by_size.setdefault((size["kind"], size["name"]), []).append(size)
    rows = []
    for (kind, name), own in sorted(by_size.items()):
        there = [s for s in own if s["value"] is not None]
        off = np.array([100 * (s["value"] / s["true"] - 1) for s in there])
        half = np.array([50 * (s["high"] - s["low"]) / s["true"] for s in there])
        held = sum(s["low"] <= s["true"] <= s["high"] for s in there)
        row: dict[str, Any] = {"size": f"{kind} of the {name}", "held": f"{held} of {len(own)}"}
        if there:
            row |= {"half": round(float(half.mean()), 1), "off": round(float(off.mean()), 1)}
            row |= {"spread": round(float(off.std(ddof=1)), 1) if len(there) > 1 else None}
        rows.append(row)
    return rows
