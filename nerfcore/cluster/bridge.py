"""The process that speaks with Ray: `python -m …cluster.bridge ADDRESS` reads lines of JSON and answers with such.

A process of its own, because Ray ends the process that uses it when its head is gone: the campaign goes on and starts
another one. Commands: {"do": "submit", "id", "text", "cores", "memory", "gpu", "avoid": [nodes]}, {"do": "cancel", "id",
"force"}, {"do": "drop", "id"} (what comes of it is not wanted any more), {"do": "end"}. Answers have a "kind": ready, nodes, told, answer (of a task), lost (its worker), fatal.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import tempfile
import threading
import time
import zipfile
from pathlib import Path
from typing import IO, Any

import ray
from ray import exceptions as failures
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from . import worker

NODES_EVERY = 2.0
BOARDS = 3  # attempts to make a board
NAMESPACE = "fieldwork"


@ray.remote(num_cpus=0, max_restarts=0)
class Board:
    """Where workers write how far they are, until the bridge reads it."""

    def __init__(self) -> None:
        self.told: dict[str, str] = {}

    def tell(self, task: str, text: str) -> None:
        self.told[task] = text

    def take(self) -> dict[str, str]:
        told, self.told = self.told, {}
        return told


@ray.remote(max_retries=0)
def run_task(text: str, task: str, board: Any) -> str:
    """A task on a worker: text in, text out."""
    node = ray.get_runtime_context().get_node_id()
    board.tell.remote(task, json.dumps({"node": node}))
    answer = worker.execute(text, lambda told: board.tell.remote(task, json.dumps({**told, "node": node})))
    return json.dumps({**json.loads(answer), "node": node}, ensure_ascii=False)


class Bridge:
    def __init__(self, out: IO[str]) -> None:
        self.out, self.lock = out, threading.Lock()
        self.scratch = tempfile.TemporaryDirectory(prefix="fieldwork-wheel-")
        self.refs: dict[Any, str] = {}
        self.commands: queue.Queue[dict[str, Any] | None] = queue.Queue()

    def say(self, kind: str, **data: Any) -> None:
        with self.lock:
            self.out.write(json.dumps({"kind": kind, **data}, ensure_ascii=False) + "\n")
            self.out.flush()

    def connect(self, address: str, must_exist: bool, wheel: str) -> bool:
        """Join the cluster; for “auto” one of this machine, or a new one where none runs. Whether it was joined."""
        environment = {"py_modules": unpacked(Path(wheel), Path(self.scratch.name))} if wheel else {}
        shared: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "namespace": NAMESPACE}
        shared["runtime_env"] = environment or None
        try:
            ray.init(address=address, **shared)
            return True
        except ConnectionError:
            if address != "auto" or must_exist:
                raise
        ray.init(address="local", include_dashboard=False, **shared)
        return False

    def run(self, address: str, must_exist: bool, wheel: str) -> None:
        joined = self.connect(address, must_exist, wheel)
        self.board = made_board(ray.get_runtime_context().get_node_id())
        self.say("ready", joined=joined, address=ray.get_runtime_context().gcs_address, nodes=nodes())
        threading.Thread(target=self._read, daemon=True).start()
        looked = time.monotonic()
        while True:
            if not self._obey():
                return
            self._collect()
            if time.monotonic() - looked > NODES_EVERY:
                looked = time.monotonic()
                told: Any = ray.get(self.board.take.remote(), timeout=30)
                for task, text in told.items():
                    self.say("told", id=task, **json.loads(text))
                self.say("nodes", nodes=nodes())

    def _read(self) -> None:
        for line in sys.stdin:
            self.commands.put(json.loads(line))
        self.commands.put(None)

    def _obey(self) -> bool:
        """Do what was asked for; whether to go on."""
        while True:
            try:
                command = self.commands.get(timeout=0.0 if self.refs else 0.05)
            except queue.Empty:
                return True
            if command is None or command["do"] == "end":
                return False
            if command["do"] == "submit":
                self._submit(command)
            elif command["do"] == "drop":
                self.refs = {ref: task for ref, task in self.refs.items() if task != command["id"]}
            elif command["do"] == "cancel":
                for ref in [ref for ref, task in self.refs.items() if task == command["id"]]:
                    ray.cancel(ref, force=command["force"])

    def _submit(self, command: dict[str, Any]) -> None:
        options: dict[str, Any] = {"num_cpus": command["cores"], "memory": command["memory"], "name": command["id"]}
        if command["gpu"]:
            options["num_gpus"] = command["gpu"]
        if command["avoid"]:
            options["label_selector"] = {"ray.io/node-id": f"!in({','.join(command['avoid'])})"}
        ref = run_task.options(**options).remote(command["text"], command["id"], self.board)
        self.refs[ref] = command["id"]

    def _collect(self) -> None:
        """Tell of tasks that have ended."""
        if not self.refs:
            return
        done, _ = ray.wait(list(self.refs), num_returns=1, timeout=0.05)
        for ref in done:
            task = self.refs.pop(ref)
            try:
                self.say("answer", id=task, answer=json.loads(ray.get(ref)))
            except (failures.TaskCancelledError, KeyboardInterrupt):
                self.say("answer", id=task, answer={"state": "cancelled"})
            except failures.RayTaskError as error:
                if isinstance(error.cause, KeyboardInterrupt):  # between the check and the work
                    self.say("answer", id=task, answer={"state": "cancelled"})
                else:
                    self.say("answer", id=task, answer={"state": "refused", "error": unusable(error)})
            except failures.RayError as error:
                self.say("lost", id=task, reason=f"{type(error).__name__}: {str(error).splitlines()[0]}")


def made_board(node: str, attempts: int = BOARDS) -> Any:
    """A board on a node. Just after another campaign has ended, Ray may give it a process that ends with that one."""
    board = Board.options(  # pyright: ignore[reportAttributeAccessIssue] - what ray.remote makes of it
        scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=True)
    ).remote()
    try:
        ray.get(board.take.remote())
    except failures.RayActorError:
        if attempts <= 1:
            raise
        return made_board(node, attempts - 1)
    return board


def unpacked(wheel: Path, folder: Path) -> list[str]:
    """The package folders in a wheel, unpacked: of a wheel itself Ray would install all requirements again on each worker."""
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder)
    return [str(path) for path in sorted(folder.iterdir()) if path.is_dir() and not path.name.endswith(".dist-info")]


def unusable(error: Exception) -> dict[str, str]:
    """What it means that a worker cannot even begin."""
    last = str(error).strip().splitlines()[-1]
    message = f"A worker of the cluster cannot run Fieldwork: {last}."
    return {"code": "worker", "message": message, "hint": worker.HINT_VERSION}


def nodes() -> list[dict[str, Any]]:
    """The machines of the cluster: id, cores, memory_gb, gpus."""
    found = []
    for node in ray.nodes():
        if node["Alive"]:
            has = node["Resources"]
            found.append(
                {
                    "id": node["NodeID"],
                    "host": node["NodeManagerHostname"],
                    "cores": has.get("CPU", 0.0),
                    "memory_gb": round(has.get("memory", 0.0) / 1e9, 2),
                    "gpus": has.get("GPU", 0.0),
                }
            )
    return found


def main() -> None:
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    address, must_exist, wheel = sys.argv[1], sys.argv[2] == "joined", sys.argv[3]
    bridge = Bridge(out)
    try:
        bridge.run(address, must_exist, wheel)
    except Exception as error:  # noqa: BLE001 - the boundary of the process: the parent tells the user
        bridge.say("fatal", message=f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
    ray.shutdown()
    bridge.scratch.cleanup()
    os._exit(0)


if __name__ == "__main__":
    main()
