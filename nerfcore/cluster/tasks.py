"""What a campaign has to do, as tasks that depend on each other, and which of them is next."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

FINISHED = ("done", "failed", "left out")


@dataclass(frozen=True)
class Need:
    """What a task takes of a worker: cores, memory in GB, and a share of a GPU (0: none)."""

    cores: float = 1.0
    memory_gb: float = 1.0
    gpu: float = 0.0

    def fits(self, room: Need) -> bool:
        return self.cores <= room.cores and self.memory_gb <= room.memory_gb and self.gpu <= room.gpu


@dataclass
class Task:
    """One piece of work for a worker.

    `function` is "module:name" below this package's parent, called as function(values, report) → JSON-ready dict;
    `values` is all it is told, JSON-ready, beside the number of the “attempt”. `group` is the capture it belongs to, `stage` what is done of it. Tasks with
    a higher `priority` come first, then those of captures begun earlier. `needs` are tasks that must be done before.
    """

    id: str
    group: str
    stage: str
    function: str
    values: dict[str, Any]
    needs: tuple[str, ...] = ()
    need: Need = Need()
    priority: int = 0
    state: str = "waiting"  # waiting, running, done, failed, left out
    attempts: int = 0  # that failed
    losses: int = 0  # workers that were lost
    disks: int = 0  # workers whose disk was full
    not_before: float = 0.0  # monotonic time
    begun: float = 0.0
    part_begun: float = 0.0  # the part of its stage that `message` names
    heard: float = 0.0
    fraction: float = 0.0
    message: str = ""
    node: str = ""
    answer: dict[str, Any] = field(default_factory=dict)


class Tasks:
    """All tasks of a campaign, in the order in which workers get them."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self.all: dict[str, Task] = {}
        self.followers: dict[str, list[str]] = {}
        self.open: dict[str, int] = {}  # how many of its needs are not done
        self._ready: list[tuple[int, int, str]] = []
        self._order: dict[str, int] = {}
        for task in tasks:
            if task.id in self.all:
                raise ValueError(f"two tasks are called {task.id}")
            self.all[task.id] = task
            self._order[task.id] = len(self._order)
        for task in self.all.values():
            self.open[task.id] = len(task.needs)
            for need in task.needs:
                self.followers.setdefault(need, []).append(task.id)
            if not task.needs:
                self._push(task)

    def _push(self, task: Task) -> None:
        heapq.heappush(self._ready, (-task.priority, self._order[task.id], task.id))

    def take(self, now: float, fits: Callable[[Task], bool]) -> Task | None:
        """The next task that may begin, if there is room for it; it is running from now on."""
        held, found = [], None
        while self._ready:
            entry = heapq.heappop(self._ready)
            task = self.all[entry[2]]
            if task.not_before <= now and fits(task):
                found = task
                break
            held.append(entry)
            if task.not_before <= now:  # what is first waits for its room; smaller ones do not overtake it for ever
                break
        for entry in held:
            heapq.heappush(self._ready, entry)
        if found is not None:
            found.state, found.begun, found.part_begun, found.heard = "running", now, now, now
            found.fraction, found.message = 0.0, ""
        return found

    def put_back(self, task: Task, not_before: float = 0.0) -> None:
        """Let a task begin again, from what it left on disk."""
        task.state, task.not_before, task.node = "waiting", not_before, ""
        self._push(task)

    def finish(self, task: Task, answer: dict[str, Any]) -> None:
        """A task is done: those that waited for it may begin."""
        task.state, task.answer, task.fraction = "done", answer, 1.0
        for follower in self.followers.get(task.id, []):
            self.open[follower] -= 1
            if self.open[follower] == 0 and self.all[follower].state == "waiting":
                self._push(self.all[follower])

    def fail(self, task: Task, answer: dict[str, Any]) -> None:
        """A task failed for good: what depends on it is left out."""
        task.state, task.answer = "failed", answer
        rest = list(self.followers.get(task.id, []))
        while rest:
            follower = self.all[rest.pop()]
            if follower.state == "waiting":
                follower.state = "left out"
                rest += self.followers.get(follower.id, [])

    @property
    def running(self) -> list[Task]:
        return [task for task in self.all.values() if task.state == "running"]

    @property
    def finished(self) -> bool:
        return all(task.state in FINISHED for task in self.all.values())
