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
    """When each task that is not finished ends, in seconds from now, if the first that may begin gets the cores that are free.

    Args:
        tasks: in the order in which they are begun.
        cores: of the cluster. seconds: of one task. overhead: seconds that each takes besides.
    """
    todo = {task.id: task for task in tasks if task.state not in FINISHED}
    place = {name: number for number, name in enumerate(todo)}
    open_needs = {name: sum(need in todo for need in task.needs) for name, task in todo.items()}
    followers: dict[str, list[str]] = {}
    for name, task in todo.items():
        for need in task.needs:
            followers.setdefault(need, []).append(name)
    ready = [(place[name], name) for name, count in open_needs.items() if count == 0]
    heapq.heapify(ready)
    ends: dict[str, float] = {}
    running: list[tuple[float, int, str]] = []  # when it ends, cores, which
    free, now = max(1, int(cores)), 0.0
    most = free
    while ready or running:
        while ready:
            wanted = min(max(1, round(todo[ready[0][1]].need.cores)), most)
            if wanted > free:
                break
            _, name = heapq.heappop(ready)
            ends[name] = now + seconds(todo[name]) + overhead
            heapq.heappush(running, (ends[name], wanted, name))
            free -= wanted
        now, cores_back, name = heapq.heappop(running)
        free += cores_back
        for follower in followers.get(name, []):
            open_needs[follower] -= 1
            if open_needs[follower] == 0:
                heapq.heappush(ready, (place[follower], follower))
    return ends


def remaining(task: Task, durations: Durations, now: float) -> float:
    """Seconds that are left of a task: of what its stage takes, and at least those of the part that it is at."""
    whole = durations.of(task.stage)
    if task.state != "running":
        return whole
    left = max(1.0, whole - (now - task.begun))
    if task.fraction > 0.05:  # of this part
        elapsed = now - task.part_begun
        left = max(left, elapsed / task.fraction - elapsed)
    return left
