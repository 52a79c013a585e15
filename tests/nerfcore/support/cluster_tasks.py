"""Tasks of a made-up campaign, and a line to workers that answer by a function."""

from __future__ import annotations

from typing import Any

from fieldwork.nerfcore.cluster.tasks import Need, Task, Tasks


def chain(group: str, stages: int = 3, priority: int = 0, need: Need | None = None) -> list[Task]:
    return [
        Task(
            f"{group}{i}",
            group,
            f"stage{i}",
            "m:f",
            {},
            needs=(f"{group}{i - 1}",) if i else (),
            priority=priority,
            need=need or Need(),
        )
        for i in range(stages)
    ]


def order(tasks: Tasks, fail: str = "") -> list[str]:
    """The tasks in the order in which one worker gets them."""
    taken = []
    while (task := tasks.take(0.0, lambda _: True)) is not None:
        taken.append(task.id)
        tasks.fail(task, {}) if task.id == fail else tasks.finish(task, {})
    return taken


class FakeLink:
    """Answers every task by a function of its job; None loses the worker."""

    def __init__(self, answer: Any, nodes: int = 1) -> None:
        self.answer, self.told, self.closed = answer, [], False
        self.nodes = [
            {"id": f"n{i}", "host": f"h{i}", "cores": 1.0, "memory_gb": 64.0, "gpus": 0.0} for i in range(nodes)
        ]
        self.messages: Any = self
        self.waiting: list[dict[str, Any] | None] = []
        self.sent: list[dict[str, Any]] = []

    def open(self, check: Any) -> dict[str, Any]:
        return {"nodes": self.nodes, "joined": True, "address": "10.0.0.1:6379"}

    open_again = open

    def send(self, **command: Any) -> None:
        self.sent.append(command)
        if command["do"] == "submit":
            found = self.answer(command)
            if found is not None:
                self.waiting.append({"kind": "answer", "id": command["id"], "answer": found})
            else:
                self.waiting.append({"kind": "lost", "id": command["id"], "reason": "gone"})

    def get(self, timeout: float) -> dict[str, Any] | None:
        return self.waiting.pop(0) if self.waiting else {}

    def empty(self) -> bool:
        return not self.waiting

    def close(self) -> None:
        self.closed = True


def good(command: dict[str, Any]) -> dict[str, Any]:
    return {"state": "done", "result": {}, "seconds": 1.0, "warnings": [], "node": "n0"}


def bad(code: str) -> dict[str, Any]:
    error = {"code": code, "message": f"{code}!", "hint": "Mend it."}
    return {"state": "failed", "error": error, "seconds": 1.0, "warnings": [], "node": "n0"}
