"""A Ray cluster of processes on this machine: a head without cores, and workers that can be killed one by one."""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).resolve().parents[3]
PACKAGE_PARENT = str(ROOT.parent)


def environment(**more: str) -> dict[str, str]:
    """What the processes of the cluster get: this checkout, one thread each, no word to Ray's makers."""
    path = os.pathsep.join([PACKAGE_PARENT, os.environ.get("PYTHONPATH", "")])
    return {
        **os.environ,
        "PYTHONPATH": path,
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_health_check_period_ms": "500",
        "RAY_health_check_timeout_ms": "2000",
        "RAY_health_check_failure_threshold": "3",
        "RAY_gcs_rpc_server_reconnect_timeout_s": "5",
        **more,
    }


class Node:
    """One `ray start --block`, in a session of its own."""

    def __init__(self, arguments: list[str], prefix: Sequence[str] = (), **more: str) -> None:
        command = [*prefix, sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--disable-usage-stats"]
        self.log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the node
        self.process = subprocess.Popen(
            [*command, "--object-store-memory", "80000000", *arguments],
            env=environment(**more),
            stdout=self.log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def wait(self) -> bool:
        """Whether the node has come up."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and self.process.poll() is None:
            self.log.seek(0)
            if b"--block" in self.log.read():
                return True
            time.sleep(0.2)
        return False

    def children(self) -> list[psutil.Process]:
        try:
            return psutil.Process(self.process.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            return []

    def workers(self) -> list[psutil.Process]:
        """The processes that run tasks now."""
        found = []
        for process in self.children():
            try:
                name = " ".join(process.cmdline())  # ray::NAME OF THE TASK while it has one
                if name.startswith("ray::/") and ":" in name:
                    found.append(process)
            except psutil.Error:
                continue
        return found

    def kill(self) -> None:
        """SIGKILL to the whole node: as if its plug was pulled."""
        for process in [*self.children(), psutil.Process(self.process.pid) if self.process.poll() is None else None]:
            try:
                if process is not None:
                    process.kill()
            except psutil.NoSuchProcess:
                continue
        self.process.wait(timeout=20)


class Cluster:
    """A head and workers with one core each. Use as a context manager."""

    def __init__(self, workers: int = 2) -> None:
        self.count, self.port = workers, free_port()
        self.folder = Path(tempfile.mkdtemp(prefix="fwray"))
        token = self.folder / "token"
        token.write_text(secrets.token_hex(32), encoding="ascii")
        self.access = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
        self.nodes: list[Node] = []
        self.head: Node | None = None

    @property
    def host(self) -> str:
        return "127.0.0.1"

    @property
    def address(self) -> str:
        return f"{self.host}:{self.port}"

    def __enter__(self) -> Cluster:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        shutil.rmtree(self.folder, ignore_errors=True)

    def start(self) -> None:
        head = ["--head", f"--port={self.port}", "--num-cpus=0", "--include-dashboard=false"]
        place = [] if self.host == "127.0.0.1" else [f"--node-ip-address={self.host}"]
        self.head = Node([*head, *place, f"--temp-dir={self.folder}"], **self.access)
        self.head.wait()
        self.nodes = [self.add() for _ in range(self.count)]

    def add(self, **more: str) -> Node:
        """One more worker, when it has joined; one that Ray could not start is started again."""
        for _ in range(3):
            node = self._worker(**more)
            if node.wait():
                return node
        raise AssertionError("a worker does not start")

    def worker_arguments(self) -> list[str]:
        return [f"--address={self.address}", "--num-cpus=1", "--memory=4000000000"]

    def _worker(self, **more: str) -> Node:
        return Node(self.worker_arguments(), **self.access, **more)

    def stop(self) -> None:
        for node in [*self.nodes, *([self.head] if self.head else [])]:
            node.kill()
        self.nodes, self.head = [], None


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def write_list(folder: Path, names: list[str], seconds: float = 0.1, **columns: Any) -> Path:
    path = folder / "captures.csv"
    extra = "".join(f",{key}" for key in columns)
    values = "".join(f",{value}" for value in columns.values())
    rows = "".join(f"{name}/photos,draft,{seconds}{values}\n" for name in names)
    path.write_text(f"photos,preset,time_limit{extra}\n{rows}")
    return path
