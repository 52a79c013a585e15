"""What a campaign decides before anything runs: order of tasks, room, estimates, plans."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.cluster.estimate import Durations, finish_times, remaining
from fieldwork.nerfcore.cluster.run import limited
from fieldwork.nerfcore.cluster.tasks import Need, Tasks
from fieldwork.nerfcore.workflows.campaign import plan
from fieldwork.nerfcore.workflows.captures import read_list
from fieldwork.tests.nerfcore.support.cluster_tasks import chain, order


def test_a_capture_that_was_begun_is_brought_to_its_end_first():
    tasks = Tasks([*chain("a"), *chain("b"), *chain("c", priority=2)])
    assert order(tasks) == ["c0", "c1", "c2", "a0", "a1", "a2", "b0", "b1", "b2"]
    assert tasks.finished


def test_what_depends_on_a_failure_is_left_out_and_nothing_else():
    tasks = Tasks([*chain("a"), *chain("b")])
    assert order(tasks, fail="a1") == ["a0", "a1", "b0", "b1", "b2"]
    assert [tasks.all[f"a{i}"].state for i in range(3)] == ["done", "failed", "left out"]
    assert tasks.finished


def test_a_task_that_waits_for_room_is_not_overtaken_for_ever():
    tasks = Tasks([*chain("big", 1, need=Need(cores=2)), *chain("small", 1)])
    assert tasks.take(0.0, lambda task: task.need.cores <= 1) is None
    assert tasks.take(0.0, lambda task: task.need.cores <= 2).id == "big0"


def test_a_task_that_was_put_back_waits_its_time():
    tasks = Tasks(chain("a", 1))
    task = tasks.take(0.0, lambda _: True)
    tasks.put_back(task, not_before=5.0)
    assert tasks.take(4.0, lambda _: True) is None
    assert tasks.take(6.0, lambda _: True) is task


def test_no_more_is_asked_for_than_a_worker_has():
    def node(cores: float, memory: float, gpus: float = 0.0) -> dict[str, Any]:
        return {"cores": cores, "memory_gb": memory, "gpus": gpus}

    small, large, gpu = node(1, 4), node(8, 32), node(4, 16, 1)
    assert limited(Need(2, 3), [small]) == Need(1, 3)
    assert limited(Need(2, 30), [small, large]) == Need(2, 30)
    assert limited(Need(2, 100), [small, large]) == Need(2, 0.95 * 32)
    assert limited(Need(2, 8, 0.5), [small, large]) == Need(2, 8, 0)
    assert limited(Need(8, 8, 0.5), [large, gpu]) == Need(4, 8, 0.5)


def test_estimates_follow_what_was_measured_and_the_cores_there_are():
    durations = Durations({"stage0": [4.0, 2.0, 3.0]})
    durations.add("stage1", 10.0)
    tasks = chain("a", 2) + chain("b", 2)
    one, two = (finish_times(tasks, cores, lambda t: durations.of(t.stage)) for cores in (1, 2))
    assert one == {"a0": 3.0, "a1": 13.0, "b0": 16.0, "b1": 26.0}
    assert max(two.values()) == 13.0
    wide = finish_times([*chain("a", 1, need=Need(cores=2)), *chain("b", 1)], 2, lambda _: 1.0, overhead=0.5)
    assert wide == {"a0": 1.5, "b0": 3.0}
    tasks[0].state = "done"
    assert max(finish_times(tasks, 1, lambda t: durations.of(t.stage)).values()) == 23.0
    running = tasks[1]
    running.state, running.begun, running.part_begun, running.fraction = "running", 100.0, 100.0, 0.5
    assert remaining(running, durations, 106.0) == pytest.approx(6.0)


def test_time_left_does_not_jump_where_a_part_of_a_stage_ends():
    durations, task = Durations({"stage0": [100.0]}), chain("a", 1)[0]
    task.state, task.begun, left = "running", 0.0, []
    for second in range(100):  # in two parts of 50 seconds, whose progress is told
        task.part_begun, task.fraction = (0.0, second / 50) if second < 50 else (50.0, second / 50 - 1)
        left.append(remaining(task, durations, float(second)))
    assert left == pytest.approx([100.0 - second for second in range(100)])
    # What takes longer than it did before is known from the part that it is at.
    task.part_begun, task.fraction = 50.0, 0.25
    assert remaining(task, durations, 150.0) == pytest.approx(300.0)


def test_two_thousand_captures_are_planned_in_five_seconds(tmp_path):
    path = tmp_path / "list.csv"
    path.write_text("photos,preset\n" + "".join(f"c{i}/photos,standard\n" for i in range(2000)))
    begin = time.process_time()
    captures = read_list(path)
    tasks = plan(captures, tmp_path)
    finish_times(Tasks(tasks).all.values(), 64, lambda task: 1.0)
    seconds = time.process_time() - begin
    print(f"2000 captures, {len(tasks)} tasks: {seconds:.2f} s of a core")
    assert len(tasks) == 12_000
    assert seconds < 5.0


def test_memory_and_shares_of_a_gpu_follow_the_plan_of_the_run(tmp_path):
    path = tmp_path / "list.csv"
    path.write_text(
        "photos,preset,set\na,draft,field.table_log2=14\nb,high,field.table_log2=22\nc,high,field.table_log2=24\n"
    )
    needs = [{task.stage: task.need for task in plan([c], tmp_path)} for c in read_list(path)]
    shares = [need["train"].gpu for need in needs]
    assert shares == sorted(shares)
    assert shares[0] < 1.0 == shares[-1]
    assert [need["poses"].gpu for need in needs] == [0.0] * 3
    assert needs[0]["train"].memory_gb < needs[1]["train"].memory_gb < needs[2]["train"].memory_gb


def test_photos_of_a_rig_are_counted_in_the_folders_of_its_cameras(tmp_path: Path) -> None:
    """By them memory is planned, and in how many parts pairs are matched."""
    for side in ("images/left", "images/right", "labels/left"):
        (tmp_path / "rig" / side).mkdir(parents=True)
        for number in range(150):
            (tmp_path / "rig" / side / f"{number:04d}.png").touch()
    (tmp_path / "rig/images/left/notes.txt").touch()
    path = tmp_path / "list.csv"
    path.write_text("photos,preset\nrig,standard\nfilm.mp4,standard\n")
    rig, film = ({task.stage: task for task in plan([capture], tmp_path)} for capture in read_list(path))
    assert [stage for stage in rig if "pairs" in stage] == ["poses pairs 1", "poses pairs 2", "poses pairs 3"]
    assert not any("pairs" in stage for stage in film)
    assert rig["train"].need.memory_gb > film["train"].need.memory_gb
