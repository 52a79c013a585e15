"""How a campaign grows with its workers, from measured times: `python -m fieldwork.nerfcore.cluster.growth REPORT PICTURE`.

REPORT is what `fieldwork batch` wrote; its captures are repeated until there are as many as asked for.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path

from ..errors import InputError
from ..files import atomic_path
from .estimate import finish_times
from .tasks import Task

WORKERS = (1, 2, 4, 8, 16, 32, 64)
Chains = list[dict[str, float]]  # of each capture: stage → seconds


def measured(report: Path) -> Chains:
    """Seconds of the stages of the captures that a report has as done. Raises InputError."""
    try:
        entries = json.loads(report.read_text(encoding="utf-8"))["captures"].values()
        found = [{stage: s for stage, s in e["stages"].items() if s} for e in entries if e["state"] == "done"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{report} is no report of a batch: {error!r}.", "Give LIST-report.json.") from error
    found = [stages for stages in found if stages]
    if not found:
        raise InputError(f"{report} has no capture with measured stages.", "Run the batch first.")
    return found


def makespan(chains: Chains, captures: int, workers: int, overhead: float) -> float:
    """Seconds that `captures` captures take on `workers` workers of one task each."""
    tasks, seconds = [], {}
    for number, stages in enumerate(islice(cycle(chains), captures)):
        before: tuple[str, ...] = ()
        for stage, duration in stages.items():
            task = Task(f"{number}:{stage}", str(number), stage, "", {}, needs=before)
            tasks.append(task)
            seconds[task.id], before = duration, (task.id,)
    return max(finish_times(tasks, workers, lambda task: seconds[task.id], overhead).values())


def growth(chains: Chains, captures: Sequence[int], overhead: float) -> dict[int, list[float]]:
    """For each number of captures, how many times as fast as one worker 1, 2, 4 … 64 workers are."""
    result = {}
    for count in captures:
        alone = makespan(chains, count, 1, 0.0)
        result[count] = [alone / makespan(chains, count, workers, overhead) for workers in WORKERS]
    return result


def draw(path: Path, curves: dict[int, list[float]]) -> None:
    """Atomically write the curves as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(WORKERS, WORKERS, color="#b8c2cc", linewidth=1, linestyle="--", label="as many times as workers")
    for (count, gains), color in zip(curves.items(), ("#c0392b", "#e0a92e", "#3c8c5c", "#2a6f97")):
        axes.plot(WORKERS, gains, marker="o", markersize=4, color=color, linewidth=1.4, label=f"{count} captures")
    axes.set_xscale("log", base=2)
    axes.set_yscale("log", base=2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:.0f}")
    axes.set_xticks(WORKERS)
    axes.set_yticks(WORKERS)
    axes.set_xlabel("workers")
    axes.set_ylabel("times as fast as one worker")
    axes.grid(alpha=0.3)
    axes.legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Draw how a campaign grows with its workers, from measured times.")
    parser.add_argument("report", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--captures", type=int, nargs="+", default=[24, 100, 500])
    parser.add_argument("--overhead", type=float, default=0.11, help="seconds of each task besides its work")
    given = parser.parse_args(arguments)
    curves = growth(measured(given.report), given.captures, given.overhead)
    draw(given.picture, curves)
    print("| captures | " + " | ".join(map(str, WORKERS)) + " |")
    print("| --- " * (len(WORKERS) + 1) + "|")
    for count, gains in curves.items():
        print(f"| {count} | " + " | ".join(f"{gain:.1f}" for gain in gains) + " |")


if __name__ == "__main__":
    main()
