"""Campaigns on a real Ray cluster of processes on this machine: a head and two workers."""

from __future__ import annotations

import json
import random
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from fieldwork.nerfcore.cluster import run as runner
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.params import BatchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows import batch as batch_module
from fieldwork.nerfcore.workflows import campaign
from fieldwork.nerfcore.workflows.batch import BatchError, batch
from fieldwork.tests.nerfcore.support import cluster_work
from fieldwork.tests.nerfcore.support.ray_cluster import Cluster, write_list

pytest.importorskip("ray", reason="the extra “cluster” is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]

STAGES = ["new", "poses", "train", "mesh", "evaluate", "render"]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with Cluster() as found:
        yield found


@pytest.fixture(autouse=True)
def tiny_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "STAGE_TASK", cluster_work.NAME)


def work_on(path: Path, cluster: Cluster, report: Reporter | None = None, **values: Any) -> dict[str, Any]:
    params = BatchParams(**{"list": path, "cluster": cluster.address, "keep_free": 0.2, **values})
    with pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.access.items():
            patch.setenv(name, value)
        return batch(params, report or Reporter())


def captures(path: Path) -> dict[str, Any]:
    return json.loads(path.with_name("captures-report.json").read_text())["captures"]


def steps_of(project: Path) -> Counter[str]:
    """How often each step of each stage was done."""
    return Counter((project / "steps.log").read_text().splitlines())


def test_a_poisoned_capture_is_reported_while_the_others_go_on(tmp_path, cluster):
    path = write_list(tmp_path, ["a", "poisoned", "b", "empty", "full", "c"])
    report = Reporter()
    with pytest.raises(BatchError, match="2 of 6 captures failed") as failure:
        work_on(path, cluster, report)
    result = failure.value.result
    assert sorted(Path(p).name for p in result["done"]) == [f"{n}_fieldwork" for n in ("a", "b", "c", "full")]
    assert {Path(f["project"]).name: f["error"] for f in result["failed"]} == {
        "poisoned_fieldwork": "The photos do not overlap.",
        "empty_fieldwork": "There are no photos.",
    }
    known = captures(path)
    assert known[str(tmp_path / "poisoned_fieldwork")]["attempts"] == 2
    assert known[str(tmp_path / "empty_fieldwork")]["attempts"] == 1
    assert list(known[str(tmp_path / "a_fieldwork")]["stages"]) == STAGES
    assert any("No space left" in warning for warning in report.warnings)
    status = json.loads((tmp_path / "captures-campaign/status.json").read_text())
    assert (status["state"], status["counts"]) == ("failed", {"failed": 2, "running": 0, "waiting": 0, "done": 4})
    assert [row["state"] for row in status["captures"]] == ["failed"] * 2 + ["done"] * 4
    page = (tmp_path / "captures-campaign/index.html").read_text()
    assert page.index("There are no photos.") < page.index("a_fieldwork")
    # Resumable from either: on one machine only what failed is asked for again.
    asked = []

    def reconstruct(params, report):
        asked.append(params.out.name)
        return {"project": str(params.out), "stages": {}}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch_module, "reconstruct", reconstruct)
        assert batch(BatchParams(list=path), Reporter())["skipped"] == 4
    assert sorted(asked) == ["empty_fieldwork", "poisoned_fieldwork"]
    assert work_on(path, cluster)["skipped"] == 6


def test_cancelling_takes_less_than_five_seconds_and_the_campaign_goes_on_later(tmp_path, cluster):
    path = write_list(tmp_path, ["a", "b", "c"], seconds=6.0)
    report = Reporter()

    def stop() -> None:
        while not list(tmp_path.glob("*/steps.log")):
            time.sleep(0.1)
        time.sleep(1.0)
        report.cancelled_at = time.monotonic()
        report.cancel()

    threading.Thread(target=stop, daemon=True).start()
    with pytest.raises(Cancelled):
        work_on(path, cluster, report)
    assert time.monotonic() - report.cancelled_at < 5.0
    status = json.loads((tmp_path / "captures-campaign/status.json").read_text())
    assert (status["state"], status["counts"]["running"]) == ("cancelled", 0)
    before = {log.parent.name: sum(steps_of(log.parent).values()) for log in tmp_path.glob("*/steps.log")}
    assert before
    time.sleep(1.5)
    after = {log.parent.name: sum(steps_of(log.parent).values()) for log in tmp_path.glob("*/steps.log")}
    assert after == before, "a worker went on after the cancel"
    path.write_text(path.read_text().replace("6.0", "0.2"))
    assert len(work_on(path, cluster)["done"]) == 3
    for name in before:
        assert set(steps_of(tmp_path / name).values()) == {1}, "a step was done again"


def test_another_version_is_refused_with_a_sentence(tmp_path, cluster, monkeypatch):
    path = write_list(tmp_path, ["a"])
    monkeypatch.setattr(runner, "__version__", "9.9.9")
    monkeypatch.setattr(runner, "PATIENCE", 3.0)
    with pytest.raises(Exception, match=r"has Fieldwork 0\.1\.0, this campaign 9\.9\.9") as failure:
        work_on(path, cluster)
    assert "No worker could be used" in str(failure.value)
    assert not (tmp_path / "a_fieldwork").exists()


def test_workers_use_the_wheel_that_is_given(tmp_path, cluster):
    wheel, root = tmp_path / "fieldwork-0.1.0-py3-none-any.whl", Path(cluster_work.__file__).parents[3]
    folders = [root / "nerfcore", root / "tests" / "nerfcore" / "support"]
    with zipfile.ZipFile(wheel, "w") as packed:
        for path in [root / "__init__.py", *(path for folder in folders for path in sorted(folder.rglob("*")))]:
            if path.is_file() and "__pycache__" not in path.parts:
                packed.write(path, Path("fieldwork") / path.relative_to(root))
    path = write_list(tmp_path, ["a"])
    work_on(path, cluster, wheel=wheel)
    code = captures(path)[str(tmp_path / "a_fieldwork")]["result"]["new"]["code"]
    assert Path(code).parts[-4:] == ("tests", "nerfcore", "support", "cluster_work.py")
    assert not Path(code).is_relative_to(root), "a worker used its own code"


def test_a_full_disk_pauses_the_campaign(tmp_path, cluster, monkeypatch):
    path = write_list(tmp_path, ["a"])
    monkeypatch.setattr(runner, "PATIENCE", 3.0)
    report = Reporter()
    with pytest.raises(Exception, match="GB free in"):
        work_on(path, cluster, report, keep_free=900_000)
    assert any("The campaign waits" in warning for warning in report.warnings)
    assert not (tmp_path / "a_fieldwork").exists()


def test_an_unknown_cluster_is_told(tmp_path):
    path = write_list(tmp_path, ["a"])
    with pytest.raises(Exception, match="cannot be reached") as failure:
        batch(BatchParams(list=path, cluster="127.0.0.1:9"), Reporter())
    assert "ray start --head" in str(failure.value)


def test_overhead_of_a_task(tmp_path, cluster):
    """Tasks that do nothing: what Ray and we take for each, with two workers."""
    work_on(write_list(tmp_path, ["warm", "up"], seconds=0.001), cluster)
    folder = tmp_path / "many"
    folder.mkdir()
    path = write_list(folder, [f"c{i:02d}" for i in range(16)], seconds=0.001)
    (tasks, begin) = 16 * len(STAGES), time.monotonic()
    result = work_on(path, cluster)
    own = sum(sum(entry["stages"].values()) for entry in captures(path).values())
    startup = startup_seconds(cluster)
    each = (time.monotonic() - begin - startup - own / 2) / tasks
    print(f"overhead {each:.3f} s for each of {tasks} tasks, connecting {startup:.1f} s")
    assert len(result["done"]) == 16
    assert each <= 0.3


def startup_seconds(cluster: Cluster) -> float:
    from fieldwork.nerfcore.cluster.link import Link

    begin, link = time.monotonic(), Link(cluster.address)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.access.items():
            patch.setenv(name, value)
        link.open(lambda: None)
    link.close()
    return time.monotonic() - begin


def test_killed_workers_lose_no_capture_and_little_work(tmp_path, cluster):
    """SIGKILL to processes that work, 20 times at random moments."""
    names = [f"c{i:02d}" for i in range(24)]
    path = write_list(tmp_path, names, seconds=0.5)
    generator, kills, over = random.Random(5), [], threading.Event()

    def killer() -> None:
        while len(kills) < 20 and not over.wait(generator.uniform(0.5, 1.5)):
            working = [worker for node in cluster.nodes for worker in node.workers()]
            if working:
                victim = generator.choice(working)
                victim.kill()
                kills.append(victim.pid)

    thread = threading.Thread(target=killer, daemon=True)
    thread.start()
    result = work_on(path, cluster)
    over.set()
    thread.join()
    assert len(kills) >= 20
    assert len(result["done"]) == 24
    again = 0
    for name in names:
        counts = steps_of(tmp_path / f"{name}_fieldwork")
        assert len(counts) == len(STAGES) * cluster_work.STEPS
        again += sum(counts.values()) - len(counts)
    losses = sum(entry["losses"] for entry in captures(path).values())
    print(f"{len(kills)} kills, {losses} tasks lost, {again} steps done again")
    assert again <= len(kills), "more than one checkpoint's work was done again for a kill"


def test_a_worker_that_stands_still_is_given_up(tmp_path, cluster, monkeypatch):
    monkeypatch.setattr(runner, "SILENT", 5.0)
    path = write_list(tmp_path, ["a", "b", "c"], seconds=2.0)
    frozen: list[psutil.Process] = []

    def freeze() -> None:
        while not frozen:
            time.sleep(0.2)
            working = [worker for node in cluster.nodes for worker in node.workers()]
            if working and list(tmp_path.glob("*/steps.log")):
                working[0].suspend()
                frozen.append(working[0])

    threading.Thread(target=freeze, daemon=True).start()
    result = work_on(path, cluster)
    assert len(result["done"]) == 3
    assert frozen
    assert sum(entry["losses"] for entry in captures(path).values()) >= 1


@pytest.mark.timeout(900)  # on a busy machine
def test_two_workers_are_faster_than_one(tmp_path, cluster):
    """24 captures of the same work, with one of the workers and with both; about a minute and half of one on free cores."""
    work_on(write_list(tmp_path, ["warm", "up"], seconds=0.001), cluster)
    seconds, busy = {}, {}
    for workers in (2, 1):
        folder = tmp_path / str(workers)
        folder.mkdir()
        path = write_list(folder, [f"c{i:02d}" for i in range(24)], seconds=0.8)
        if workers == 1:
            cluster.nodes.pop().kill()
            wait_for_workers(cluster, 1)
        begin, processor = time.monotonic(), processor_seconds()
        assert len(work_on(path, cluster)["done"]) == 24
        seconds[workers] = time.monotonic() - begin
        busy[workers] = (processor_seconds() - processor) / seconds[workers]
    cluster.nodes.append(cluster.add())
    gain = seconds[1] / seconds[2]
    print(
        f"24 captures: {seconds[1]:.1f} s with one worker, {seconds[2]:.1f} s with two: {gain:.2f} times as fast "
        f"(cores busy: {busy[1]:.1f} and {busy[2]:.1f} of {psutil.cpu_count()})"
    )
    # With one worker a core and a little are at work: more than that is of other programs.
    if psutil.cpu_count() < 2 or busy[1] > 1.5:
        pytest.skip(f"other programs use the cores: {gain:.2f} times as fast, {busy[1]:.1f} cores busy with one worker")
    assert gain >= 1.7


def processor_seconds() -> float:
    """Of all programs since the machine was started."""
    times = psutil.cpu_times()
    return sum(getattr(times, name, 0.0) for name in ("user", "nice", "system", "irq", "softirq"))


def wait_for_workers(cluster: Cluster, count: int) -> None:
    """Until the cluster knows of so many workers."""
    from fieldwork.nerfcore.cluster.link import Link

    with pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.access.items():
            patch.setenv(name, value)
        end = time.monotonic() + 60
        while True:
            link = Link(cluster.address)
            known = sum(node["cores"] > 0 for node in link.open(lambda: None)["nodes"])
            link.close()
            if known == count:
                return
            assert time.monotonic() < end, f"the cluster still has {known} workers"


def test_the_head_is_restarted(tmp_path):
    with Cluster() as cluster:
        path = write_list(tmp_path, [f"c{i}" for i in range(4)], seconds=2.0)
        report = Reporter()

        def restart() -> None:
            while not list(tmp_path.glob("*/poses.json")):
                time.sleep(0.2)
            cluster.stop()
            time.sleep(3.0)
            cluster.start()

        thread = threading.Thread(target=restart, daemon=True)
        thread.start()
        result = work_on(path, cluster, report)
        thread.join()
    assert len(result["done"]) == 4
    assert any("head is gone" in warning for warning in report.warnings)
    for number in range(4):
        counts = steps_of(tmp_path / f"c{number}_fieldwork")
        assert max(counts.values()) <= 2
        assert sum(counts.values()) - len(counts) <= 2
