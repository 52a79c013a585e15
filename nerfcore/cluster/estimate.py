"""How long a campaign still takes: the tasks that are left, laid out on the cores there are."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Mapping
from statistics import median

from .tasks import FINISHED, Task

# Seconds before anything was measured: the stages of a draft of 50 photos on two cores.
FIRST_GUESS = {"new": 5.0, "poses": 60.0, "train": 120.0, "evaluate": 15.0, "mesh": 40.0, "render": 20.0, "blend": 10.0}


class Durations:
    """Seconds that a stage takes: the median of what was measured, a first guess before."""

    def __init__(self, known: Mapping[str, Iterable[float]] | None = None) -> None:
        self.seconds: dict[str, list[float]] = {stage: list(values) for stage, values in (known or {}).items()}

    def add(self, stage: str, seconds: float) -> None:
        self.seconds.setdefault(stage, []).append(seconds)

    def of(self, stage: str) -> float:
        measured = self.seconds.get(stage)
        return median(measured) if measured else FIRST_GUESS.get(stage.partition(" ")[0], 30.0)


def finish_times(
    tasks: Iterable[Task], cores: float, seconds: Callable[[Task], float], overhead: float = 0.0
) -> dict[str, float]:
    """When each task that is not finished ends, in seconds from now, if each goes to the first cores that are free.

    Args:
        tasks: in the order in which they are begun, those that a task needs before it.
        cores: of the cluster. seconds: of one task. overhead: seconds that each takes besides.
    """
    ends: dict[str, float] = {}
    free = max(1, int(cores))
    heap = [0.0] * free  # when each core is free
    for task in tasks:
        if task.state in FINISHED:
            continue
        wanted = min(max(1, round(task.need.cores)), free)
        taken = [heapq.heappop(heap) for _ in range(wanted)]
        ready = max((ends.get(need, 0.0) for need in task.needs), default=0.0)
        end = max(taken[-1], ready) + seconds(task) + overhead
        ends[task.id] = end
        for _ in range(wanted):
            heapq.heappush(heap, end)
    return ends


def remaining(task: Task, durations: Durations, now: float) -> float:
    """Seconds that are left of a task."""
    whole = durations.of(task.stage)
    if task.state != "running":
        return whole
    elapsed = now - task.begun
    if task.fraction > 0.05:
        return max(0.0, elapsed / task.fraction - elapsed)
    return max(1.0, whole - elapsed)
