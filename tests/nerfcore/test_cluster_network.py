"""Campaigns on workers that have networks and disks of their own: namespaces of this machine, cables that are pulled,
a disk that is really full, a worker that is slow."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from fieldwork.nerfcore.cluster import run as runner
from fieldwork.nerfcore.params import BatchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows import campaign
from fieldwork.nerfcore.workflows.batch import batch
from fieldwork.tests.nerfcore.support import cluster_work
from fieldwork.tests.nerfcore.support.namespaces import NamespacedCluster, refusal
from fieldwork.tests.nerfcore.support.ray_cluster import Cluster, write_list

pytest.importorskip("ray", reason="the extra “cluster” is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]
STAGES = 6


@pytest.fixture(scope="module")
def namespaced() -> Iterator[NamespacedCluster]:
    if why := refusal():
        pytest.skip(why)
    with NamespacedCluster() as found:
        yield found


@pytest.fixture(autouse=True)
def tiny_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "STAGE_TASK", cluster_work.NAME)


def work_on(path: Path, cluster: Cluster, report: Reporter | None = None, **values: Any) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.access.items():
            patch.setenv(name, value)
        params = BatchParams(**{"list": path, "cluster": cluster.address, "keep_free": 0.2, **values})
        return batch(params, report or Reporter())


def entries(path: Path) -> list[dict[str, Any]]:
    return list(json.loads(path.with_name("captures-report.json").read_text())["captures"].values())


def by_worker(path: Path) -> Counter[str]:
    """How many stages each worker did."""
    made = [stage for entry in entries(path) for stage in entry["result"].values() if isinstance(stage, dict)]
    return Counter(stage["worker"] for stage in made if "worker" in stage)


def repeated(folder: Path) -> int:
    """Steps of all captures that were done more than once."""
    counts = [Counter(log.read_text().splitlines()) for log in folder.glob("*/steps.log")]
    return sum(sum(count.values()) - len(count) for count in counts)


def wait_for(condition: Any, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.2)


def test_a_cable_is_pulled(
    tmp_path: Path,
    namespaced: NamespacedCluster,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The network of one of two workers fails while both work: what it had goes on at the other."""
    monkeypatch.setattr(runner, "SILENT", 10.0)
    monkeypatch.setattr(runner, "DEAF", 5.0)
    path = write_list(tmp_path, [f"c{i}" for i in range(4)], seconds=0.5)

    def pull() -> None:
        wait_for(lambda: len(list(tmp_path.glob("*/steps.log"))) >= 2)
        wait_for(lambda: all(node.workers() for node in namespaced.nodes))
        namespaced.pull(namespaced.nodes[0])

    thread = threading.Thread(target=pull, daemon=True)
    thread.start()
    result = work_on(path, namespaced)
    thread.join()
    namespaced.nodes.pop(0).kill()
    namespaced.nodes.append(namespaced.add())
    assert len(result["done"]) == 4
    lost = sum(entry["losses"] for entry in entries(path))
    print(f"cable pulled: {lost} tasks lost, {repeated(tmp_path)} steps done again")
    # On a busy machine the head may be late with its answer as well: then all tasks are given anew, and none counts as lost.
    assert lost >= 1 or "head is gone" in caplog.text
    # A worker that is cut off works on for a while; what it does nobody counts, and the project's lock keeps two apart.
    assert repeated(tmp_path) <= cluster_work.STEPS


def test_the_head_is_restarted_in_another_namespace_than_its_workers(
    tmp_path: Path, namespaced: NamespacedCluster
) -> None:
    path = write_list(tmp_path, [f"c{i}" for i in range(3)], seconds=0.5)
    report = Reporter()

    def restart() -> None:
        wait_for(lambda: list(tmp_path.glob("*/poses.json")))
        namespaced.stop()
        time.sleep(3.0)
        namespaced.start()

    thread = threading.Thread(target=restart, daemon=True)
    thread.start()
    result = work_on(path, namespaced, report)
    thread.join()
    assert len(result["done"]) == 3
    assert any("head is gone" in warning for warning in report.warnings)
    print(f"head restarted: {repeated(tmp_path)} steps done again")
    assert repeated(tmp_path) <= 2


def test_a_slow_worker_does_less_and_nothing_is_lost(tmp_path: Path) -> None:
    """One of two workers is stopped for three quarters of the time."""
    path, over = write_list(tmp_path, [f"c{i}" for i in range(8)], seconds=0.5), threading.Event()
    with Cluster(0) as cluster:
        slow = cluster.add(FIELDWORK_TEST_WORKER="slow")
        cluster.nodes = [slow, cluster.add(FIELDWORK_TEST_WORKER="quick")]

        def hold() -> None:
            while not over.is_set():
                working = slow.workers()
                for action, seconds in (("suspend", 0.6), ("resume", 0.2)):
                    for process in working:
                        try:
                            getattr(process, action)()
                        except psutil.NoSuchProcess:
                            continue
                    time.sleep(seconds)

        thread = threading.Thread(target=hold, daemon=True)
        thread.start()
        result = work_on(path, cluster)
        over.set()
        thread.join()
    assert len(result["done"]) == 8
    assert sum(entry["losses"] for entry in entries(path)) == 0
    assert repeated(tmp_path) == 0
    done = by_worker(path)
    print(f"slow worker: stages of each {dict(done)}")
    assert sum(done.values()) == 8 * STAGES
    assert 0 < done["slow"] < done["quick"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 400 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=400k", "none", str(place)], capture_output=True, text=True
    )
    if made.returncode:
        pytest.skip(f"mounting a disk is not permitted: {made.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_the_disk_of_one_worker_is_really_full(tmp_path: Path, small_disk: Path) -> None:
    """It says so in the middle of writing; its stages are done by the other worker, and no capture fails."""
    path = write_list(tmp_path, [f"c{i}" for i in range(4)], seconds=0.3)
    report = Reporter()
    with Cluster(0) as cluster:
        full = {"FIELDWORK_TEST_WORKER": "full", "FIELDWORK_TEST_DISK": str(small_disk)}
        cluster.nodes = [cluster.add(**full), cluster.add(FIELDWORK_TEST_WORKER="roomy")]
        result = work_on(path, cluster, report, keep_free=0.0)
    assert len(result["done"]) == 4
    assert any("No space left" in warning and str(small_disk) in warning for warning in report.warnings)
    done = by_worker(path)
    print(f"full disk: stages of each worker {dict(done)}")
    assert set(done) == {"roomy"}
    assert all(entry["state"] == "done" for entry in entries(path))
