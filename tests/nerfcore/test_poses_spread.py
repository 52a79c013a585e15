"""Matching the photos of one capture in parts, as several machines do at the same time."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path

import pytest
from fieldwork.nerfcore.errors import PosesError
from fieldwork.nerfcore.params import PosesParams, ReconstructParams
from fieldwork.nerfcore.poses import matching_parts
from fieldwork.nerfcore.poses.estimate import estimate_poses
from fieldwork.nerfcore.poses.spread import find_features, match_part
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.lock import project_lock
from fieldwork.nerfcore.workflows.campaign import capture_tasks, matching_shares
from fieldwork.nerfcore.workflows.stage_task import run_stage


class Stages(Reporter):
    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def stage(self, name: str) -> None:
        self.seen.append(name)


def geometries(path: Path) -> int:
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as connection:
        return connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]


@pytest.mark.slow
def test_parts_of_the_pairs_become_one_model(unposed_fountain: Path, tmp_path: Path) -> None:
    project = Path(shutil.copytree(unposed_fountain, tmp_path / "p"))
    params, work = PosesParams(project=project, preset="fast"), project / "poses/sfm"
    with pytest.raises(PosesError, match=r"pairs\.json is missing"):
        match_part(params, 0, 3, Reporter())
    total = find_features(params, Reporter())["pairs"]
    (database,) = work.glob("*.db")
    assert geometries(database) == 0
    with project_lock(project, "train"):  # parts only read the project
        counts = [match_part(params, part, 3, Reporter())["pairs"] for part in range(3)]
    assert sum(counts) == total
    assert max(counts) - min(counts) <= 1
    again = Stages()
    match_part(params, 1, 3, again)
    assert "Matching features" not in again.seen, "a part that is done is kept"
    report = Stages()
    result = estimate_poses(params, report)
    assert "Finding features" not in report.seen
    assert "Matching features" not in report.seen
    assert result["registered"] == result["total"]
    assert result["reprojection_px"] < 1.0
    assert geometries(database) == total
    assert not (work / "parts").exists()
    assert find_features(params, Reporter()) == {"pairs": 0}, "where poses are there nothing is done"


@pytest.mark.slow
def test_a_part_that_is_missing_or_of_other_photos_is_matched_by_the_stage_itself(
    unposed_fountain: Path, tmp_path: Path
) -> None:
    project = Path(shutil.copytree(unposed_fountain, tmp_path / "p"))
    params, work = PosesParams(project=project, preset="fast"), project / "poses/sfm"
    find_features(params, Reporter())
    for part in range(2):
        match_part(params, part, 3, Reporter())
    with sqlite3.connect(work / "parts/1-3.db") as connection:
        connection.execute("UPDATE images SET name = 'other.jpg' WHERE image_id = 1")
    report = Stages()
    result = estimate_poses(params, report)
    assert "Matching features" in report.seen
    assert result["registered"] == result["total"]


def test_large_captures_are_spread_and_small_ones_are_not(tmp_path: Path) -> None:
    assert [matching_shares(count) for count in (20, 199, 200, 1000, 100_000)] == [0, 0, 2, 10, 16]
    params = ReconstructParams(photos=tmp_path / "photos", out=tmp_path / "p")
    tasks = capture_tasks(params, 0, [], {"folder": str(tmp_path), "storage": None}, shares=2)
    assert [task.stage for task in tasks[:6]] == [
        "new",
        "poses features",
        "poses pairs 1",
        "poses pairs 2",
        "poses",
        "train",
    ]
    assert tasks[2].needs == tasks[3].needs == (tasks[1].id,)
    assert tasks[4].needs == (tasks[2].id, tasks[3].id)
    assert [task.values.get("matching") for task in tasks[1:5]] == ["features", [0, 2], [1, 2], None]


def test_a_worker_does_each_piece(unposed_fountain: Path, tmp_path: Path) -> None:
    project = Path(shutil.copytree(unposed_fountain, tmp_path / "p"))
    params = ReconstructParams(photos=tmp_path / "photos", out=project)
    tasks = capture_tasks(params, 0, [], {"folder": str(tmp_path), "storage": None}, shares=2)
    made = [run_stage(task.values, Reporter())["result"]["pairs"] for task in tasks[1:4]]
    assert made[0] == made[1] + made[2] > 0
    known = json.loads((project / "poses/sfm" / matching_parts.PAIRS).read_text())
    assert len(known["pairs"]) == made[0]
