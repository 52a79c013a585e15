"""A Ray cluster whose workers have networks of their own: each in a Linux network namespace, joined by a bridge."""

from __future__ import annotations

import os
import shutil
import subprocess
from typing import Any

from fieldwork.tests.nerfcore.support.ray_cluster import Cluster, Node

SUBNET = "10.231.77"


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True, timeout=20)


def refusal() -> str | None:
    """Why there can be no namespaces here; None where there can."""
    if shutil.which("ip") is None:
        return "there is no program ip (iproute2)"
    name = f"fwtry{os.getpid() % 10000}"
    try:
        ip("netns", "add", name)
        ip("netns", "del", name)
        ip("link", "add", name, "type", "bridge")
        ip("link", "del", name)
    except (subprocess.SubprocessError, OSError) as error:
        return f"network namespaces are not permitted: {getattr(error, 'stderr', '') or error}".strip()
    return None


class NamespacedCluster(Cluster):
    """A head on a bridge of this machine, and workers that reach it through a cable each, which can be pulled."""

    def __init__(self, workers: int = 2) -> None:
        super().__init__(workers)
        self.name = f"fw{os.getpid() % 10000}"
        self.ends: list[str] = []  # of cables, on our side; each namespace has the name of its cable
        self.cables: dict[int, str] = {}  # by the worker's process

    @property
    def host(self) -> str:
        return f"{SUBNET}.1"

    def __enter__(self) -> NamespacedCluster:
        ip("link", "add", self.name, "type", "bridge")
        ip("addr", "add", f"{self.host}/24", "dev", self.name)
        ip("link", "set", self.name, "up")
        super().__enter__()
        return self

    def __exit__(self, *reason: object) -> None:
        super().__exit__(*reason)
        for end in self.ends:
            ip("netns", "del", end)
        ip("link", "del", self.name)

    def _worker(self, **more: Any) -> Node:
        number = len(self.ends) + 1
        end, address = f"{self.name}w{number}", f"{SUBNET}.{number + 1}"
        ip("netns", "add", end)
        self.ends.append(end)
        ip("link", "add", end, "type", "veth", "peer", "name", "eth0", "netns", end)
        ip("link", "set", end, "master", self.name, "up")
        for words in (("link", "set", "lo", "up"), ("addr", "add", f"{address}/24", "dev", "eth0")):
            ip("-n", end, *words)
        ip("-n", end, "link", "set", "eth0", "up")
        arguments = [*self.worker_arguments(), f"--node-ip-address={address}"]
        node = Node(arguments, ("ip", "netns", "exec", end), **self.access, **more)
        self.cables[node.process.pid] = end
        return node

    def pull(self, node: Node) -> None:
        """Unplug the cable of a worker."""
        ip("link", "set", self.cables[node.process.pid], "down")
