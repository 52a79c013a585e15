"""Running a campaign: tasks to the workers, their answers back, until all are done, failed or cancelled."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import Cancelled, DiskError
from ..progress import Reporter
from .estimate import Durations, finish_times, remaining
from .link import Link
from .tasks import Need, Task, Tasks

SILENT = 60.0  # seconds without a sign of life after which a worker is given up
DEAF = 30.0  # seconds in which a silent worker may obey; then it is taken to be out of reach
MOST_LOSSES = 8  # of workers with one task: then it is the task that ends them
GRACE = 2.5  # seconds in which tasks may end by themselves after a cancel
PATIENCE = 600.0  # seconds in which no worker could be used, after which the campaign ends
RESTED = 20.0  # seconds until a worker that was refused or full is asked again
# Other photos or settings are the user's to give; what another campaign has taken is not taken back.
USER_FAULTS = ("input", "setting", "taken")


@dataclass
class Options:
    """How a campaign is run. `folder` is all that workers may write in; a worker whose disk has less than
    `keep_free_gb` gets nothing to do. `storage` is where files are, if workers do not see the folder."""

    folder: Path
    retries: int = 1
    keep_free_gb: float = 2.0
    storage: str | None = None


@dataclass
class Progress:
    """Where a campaign stands, for those who watch."""

    tasks: Tasks
    nodes: list[dict[str, Any]]
    ends: dict[str, float]  # seconds until each task is done
    excluded: dict[str, str]  # node → why it gets nothing


class Runner:
    """One run of the tasks of a campaign.

    `ended` is called with each task that is done, failed or left out; `watch` about once a second.
    """

    def __init__(
        self,
        tasks: Iterable[Task],
        link: Link,
        options: Options,
        report: Reporter,
        ended: Callable[[Task], None],
        watch: Callable[[Progress], None],
        durations: Durations | None = None,
    ) -> None:
        self.tasks, self.link, self.options, self.report = Tasks(tasks), link, options, report
        self.ended, self.watch = ended, watch
        self.durations = durations or Durations()
        self.nodes: list[dict[str, Any]] = []
        self.excluded: dict[str, tuple[float, str]] = {}  # node → until when, why
        self.cut_short: dict[str, float] = {}  # silent tasks that were given up, and when
        self.starved = 0.0  # since when no node may be used
        self.watched = 0.0
        self.attempts = 0  # that were handed out

    def run(self) -> None:
        """Work until every task has ended.

        Raises:
            Cancelled: the workers have stopped. ClusterError: the cluster is gone. DiskError: no worker has room.
        """
        try:
            ready = self.link.open(self.report.check)
            self.nodes = ready["nodes"]
            self.report.note(welcome(ready))
            while not self.tasks.finished:
                self.report.check()
                self._submit()
                self._listen(0.1)
                self._give_up_silent()
                self._look(force=False)
            self._look(force=True)
        except Cancelled:
            self._cancel()
            raise
        finally:
            self.link.close()

    def _allowed(self) -> list[dict[str, Any]]:
        now = time.monotonic()
        self.excluded = {node: entry for node, entry in self.excluded.items() if entry[0] > now}
        return [node for node in self.nodes if node["cores"] >= 1 and node["id"] not in self.excluded]

    def _submit(self) -> None:
        """Hand out what fits on the cluster now; nothing waits at the workers."""
        allowed = self._allowed()
        if not allowed:
            if not self.tasks.running:
                self._starve()
            return
        used = [limited(task.need, allowed) for task in self.tasks.running]
        cores = sum(node["cores"] for node in allowed) - sum(need.cores for need in used)
        memory = sum(node["memory_gb"] for node in allowed) - sum(need.memory_gb for need in used)
        gpus = sum(node["gpus"] for node in allowed) - sum(need.gpu for need in used)
        while cores > 0:
            room = Need(cores, memory, gpus)
            task = self.tasks.take(time.monotonic(), lambda task, room=room: limited(task.need, allowed).fits(room))
            if task is None:
                return
            self.cut_short.pop(task.id, None)  # that was another attempt
            need = limited(task.need, allowed)
            cores, memory, gpus = cores - need.cores, memory - need.memory_gb, gpus - need.gpu
            self.attempts += 1
            job = {
                "function": task.function,
                "values": {**task.values, "attempt": self.attempts},
                "version": __version__,
                "folder": str(self.options.folder),
                "storage": self.options.storage,
                "cores": need.cores,
                "keep_free_gb": self.options.keep_free_gb,
            }
            self.link.send(
                do="submit",
                id=task.id,
                text=json.dumps(job, ensure_ascii=False),
                cores=need.cores,
                memory=int(need.memory_gb * 1e9),
                gpu=need.gpu,
                avoid=sorted(self.excluded),
            )

    def _starve(self) -> None:
        """No worker may be used: wait, and say why."""
        now = time.monotonic()
        reasons = sorted({why for _, why in self.excluded.values()}) or ["The cluster has no workers."]
        if not self.starved:
            self.starved = now
            self.report.warn(f"The campaign waits. {' '.join(reasons[:3])}")
        if now - self.starved > PATIENCE:
            raise DiskError(
                f"No worker could be used for {PATIENCE:.0f} s. {' '.join(reasons[:3])}",
                "Mend that, then run the same command: finished work is kept.",
            )

    def _listen(self, timeout: float) -> None:
        message = self.link.get(timeout)
        while message:
            self._take(message)
            message = self.link.get(0.0) if not self.link.messages.empty() else {}
        if message is None:
            self._head_lost()

    def _take(self, message: dict[str, Any]) -> None:
        if message["kind"] == "nodes":
            self.nodes = message["nodes"]
            return
        task = self.tasks.all.get(message.get("id", ""))
        if task is None or task.state != "running":
            return
        if message["kind"] == "told":
            task.heard = time.monotonic()
            task.node = message["node"]
            if "stage" in message:  # it works, and was not only reached
                self.starved = 0.0
            if message.get("stage", task.message) != task.message:
                task.part_begun = task.heard
            task.fraction, task.message = message.get("fraction", task.fraction), message.get("stage", task.message)
        elif message["kind"] == "lost":
            self._lost(task, message["reason"])
        elif message["kind"] == "answer":
            self._answered(task, message["answer"])

    def _answered(self, task: Task, answer: dict[str, Any]) -> None:
        for warning in answer.get("warnings", []):
            self.report.warn(f"{Path(task.group).name}: {warning}")
        state = answer["state"]
        if state in ("done", "failed"):
            self.starved = 0.0
        if state == "done":
            self.durations.add(task.stage, answer["seconds"])
            self.tasks.finish(task, answer)
            self.ended(task)
        elif state == "cancelled":
            self._lost(task, "it was silent" if task.id in self.cut_short else "it was cancelled on the cluster")
        elif state in ("refused", "full") and answer.get("node"):
            self._exclude(answer["node"], answer["error"])
            self.tasks.put_back(task)
        else:
            self._failed(task, answer)

    def _failed(self, task: Task, answer: dict[str, Any]) -> None:
        error = answer["error"]
        # Rights may be those of a worker; where they lack again, they are the capture's.
        denied = error.get("denied", False) and task.disks > 0
        if error["code"] == "disk" and answer.get("node") and task.disks < MOST_LOSSES and not denied:
            # It is the worker's fault, not the capture's: others may have room.
            task.disks += 1
            self._exclude(answer["node"], error)
            self.tasks.put_back(task)
            return
        task.attempts += 1
        if error["code"] in USER_FAULTS or task.attempts > self.options.retries:
            self._fail(task, answer)
            return
        self.report.warn(f"{Path(task.group).name}: {error['message']} It is tried again.")
        self.tasks.put_back(task)

    def _fail(self, task: Task, answer: dict[str, Any]) -> None:
        self.tasks.fail(task, answer)
        self.ended(task)

    def _lost(self, task: Task, reason: str) -> None:
        """A worker is gone: the task goes on elsewhere from what is on disk."""
        self.cut_short.pop(task.id, None)
        task.losses += 1
        if task.losses < MOST_LOSSES:
            self.report.note(
                f"{Path(task.group).name}, {task.stage}: its worker was lost ({reason}); it goes on elsewhere."
            )
            self.tasks.put_back(task, time.monotonic() + 0.2 * task.losses)
            return
        message = f"{task.losses} workers were lost one after the other while at “{task.stage}” of it."
        hint = "It may need more memory than they have, or end them: run it alone and look."
        self._fail(task, {"state": "failed", "error": {"code": "lost", "message": message, "hint": hint}})

    def _exclude(self, node: str, error: dict[str, Any]) -> None:
        if not node:
            return
        if node not in self.excluded:
            self.report.warn(f"{error['message']} {error['hint']}")
        self.excluded[node] = (time.monotonic() + RESTED, error["message"])

    def _head_lost(self) -> None:
        self.report.warn("The cluster's head is gone; the campaign waits for it.")
        for task in self.tasks.running:
            self.tasks.put_back(task)
        self.nodes = []
        self.nodes = self.link.open_again(self._wait)["nodes"]
        self.report.note("The cluster is back.")

    def _wait(self) -> None:
        """While nothing can be done: those who watch are told that the campaign lives."""
        self.report.check()
        self._look(force=False)

    def _give_up_silent(self) -> None:
        now = time.monotonic()
        for task in self.tasks.running:
            # It is told of only once a worker has it.
            if task.node and now - task.heard > SILENT and task.id not in self.cut_short:
                self.cut_short[task.id] = now
                self.link.send(do="cancel", id=task.id, force=True)
            elif now - self.cut_short.get(task.id, now) > DEAF:
                self.link.send(do="drop", id=task.id)
                self._lost(task, "it cannot be reached")

    def _cancel(self) -> None:
        """Let running tasks write what they have, then end those that have not."""
        for force, wait in ((False, GRACE), (True, 0.5)):
            for task in self.tasks.running:
                self.link.send(do="cancel", id=task.id, force=force)
            deadline = time.monotonic() + wait
            while self.tasks.running and time.monotonic() < deadline:
                message = self.link.get(0.1)
                if message is None:
                    return
                task = self.tasks.all.get(message.get("id", ""))
                if task is None or message["kind"] not in ("answer", "lost"):
                    continue
                if message["kind"] == "answer" and message["answer"]["state"] == "done":
                    self.tasks.finish(task, message["answer"])
                    self.ended(task)
                else:
                    task.state = "waiting"

    def _look(self, force: bool) -> None:
        now = time.monotonic()
        if not force and now - self.watched < 1.0:
            return
        self.watched = now
        cores = sum(node["cores"] for node in self._allowed())
        ends = finish_times(
            self.in_order(), max(cores, 1.0), lambda task: remaining(task, self.durations, now), overhead=0.0
        )
        excluded = {node: why for node, (_, why) in self.excluded.items()}
        self.watch(Progress(self.tasks, self.nodes, ends, excluded))

    def in_order(self) -> list[Task]:
        """What runs, then what waits in its order."""
        tasks = list(self.tasks.all.values())
        return sorted(tasks, key=lambda task: (task.state != "running", -task.priority))


def welcome(ready: dict[str, Any]) -> str:
    """Which cluster it is: “auto” takes the one that runs on this machine, which may be somebody else's."""
    cores = sum(node["cores"] for node in ready["nodes"])
    workers = sum(node["cores"] > 0 for node in ready["nodes"])
    there = f"{workers} worker{'' if workers == 1 else 's'}, {cores:g} core{'' if cores == 1 else 's'}"
    if not ready["joined"]:
        return f"No cluster runs here: one of this machine was started for the time of the campaign ({there})."
    return f"Joined the cluster at {ready['address']} ({there})."


def limited(need: Need, nodes: list[dict[str, Any]]) -> Need:
    """What is asked of a worker: no more than one of them has, and a GPU only where there is one.

    Args:
        nodes: those with cores.
    """
    gpu = min(need.gpu, max(node["gpus"] for node in nodes))
    roomy = [node for node in nodes if node["gpus"] >= gpu]
    if any(node["cores"] >= need.cores and node["memory_gb"] >= need.memory_gb for node in roomy):
        return Need(need.cores, need.memory_gb, gpu)
    largest = max(roomy, key=lambda node: (node["memory_gb"], node["cores"]))
    return Need(min(need.cores, largest["cores"]), min(need.memory_gb, 0.95 * largest["memory_gb"]), gpu)
