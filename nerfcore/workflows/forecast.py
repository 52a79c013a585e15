"""What a batch would do, without doing it: its tasks, what is missing, and how long it may take on so many cores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from ..cluster.estimate import FIRST_GUESS, Durations, finish_times
from ..cluster.tasks import Task
from ..params import BatchParams
from ..progress import Reporter
from .campaign import CORES, known_durations, plan
from .captures import Capture

CORES_TO_TELL = (2, 8, 64)


def forecast(
    params: BatchParams, todo: list[Capture], entries: Mapping[str, dict[str, Any]], report: Reporter
) -> dict[str, Any]:
    """Plan the captures `todo` as a cluster would get them.

    Args:
        entries: what the report has of those that are done.
    Returns:
        {"captures": how many there are to do, "missing": [photos that are not there], "tasks": {stage: how many}, "core_hours",
        "hours": {cores: hours of all captures on so many}, "measured": [stages whose seconds were measured]}
    Raises:
        SettingError: a capture writes outside of the list's folder, or is wrong otherwise.
    """
    report.stage("Planning")
    durations = known_durations(entries)
    tasks = plan(todo, params.list.absolute().parent, params.storage)
    report.check()
    missing = [str(capture.photos) for capture, _ in todo if not capture.photos.exists()]

    def seconds(task: Task) -> float:
        return durations.of(task.stage)

    hours = {}
    for cores in CORES_TO_TELL:
        report.check()
        hours[str(cores)] = _hours(max(finish_times(tasks, cores, seconds).values(), default=0.0))
    counts = Counter(task.stage.partition(" ")[0] for task in tasks)
    result = {
        "captures": len(todo),
        "missing": missing,
        "tasks": dict(counts),
        "core_hours": _hours(sum(seconds(task) * CORES.get(task.stage.partition(" ")[0], 1.0) for task in tasks)),
        "hours": hours,
        "measured": sorted(stage for stage in counts if durations.seconds.get(stage)),
    }
    report.note(sentence(result, durations))
    return result


def sentence(found: Mapping[str, Any], durations: Durations) -> str:
    """The same in words."""
    number = sum(found["tasks"].values())
    times = ", ".join(f"{hours:g} h on {cores} cores" for cores, hours in found["hours"].items())
    text = f"{found['captures']} captures to do, {number} tasks. About {times}."
    if any(stage not in found["measured"] for stage in found["tasks"]):
        guessed = {stage: durations.of(stage) for stage in found["tasks"] if stage in FIRST_GUESS}
        text += f" That is a guess ({guessed.get('train', 0.0):.0f} s of training a capture) until some are done."
    if found["missing"]:
        text += f" Photos of {len(found['missing'])} are not there: {found['missing'][0]}."
    return text


def _hours(seconds: float) -> float:
    return round(seconds / 3600, 2)
