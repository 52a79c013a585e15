"""Photos of different exposure are brought to a common one: found from the sparse points, and used wherever photos are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.data.load import load_scene, view_inputs
from fieldwork.nerfcore.data.photo import photo_of
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.geometry.cameras import Camera, project
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.images.exposure import common_gains
from fieldwork.nerfcore.params import PosesParams, ReconstructParams
from fieldwork.nerfcore.poses.estimate import with_gains
from fieldwork.nerfcore.poses.exposure import exposure_gains
from fieldwork.nerfcore.poses.inputs import posed, posing_inputs
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import ImageRecord, PosedImage, Poses, Project
from fieldwork.nerfcore.project.store import (
    edit_project,
    load_points,
    load_poses,
    load_project,
    save_poses,
    save_project,
)
from fieldwork.nerfcore.workflows.reconstruct import Pipeline, stage_params
from PIL import Image

VIEWS, SIZE = 6, 96
CAMERA = Camera(model="PINHOLE", width=SIZE, height=SIZE, fx=80, fy=80, cx=SIZE / 2, cy=SIZE / 2)


def capture(
    folder: Path, gains: np.ndarray, seed: int = 0
) -> tuple[Poses, Points, tuple[np.ndarray, np.ndarray], list[Path]]:
    """A wall of coloured squares at z = 2 with points on it, photographed by cameras side by side; each photo's colours are
    divided by its gain (VIEWS, 3)."""
    rng = np.random.default_rng(seed)
    squares = rng.uniform(60, 150, (12, 12, 3))
    (folder / "images").mkdir(parents=True)
    posed, files, seen = [], [], []
    cells = (np.arange(12) - 5.5) * 0.25
    points = np.stack([*np.meshgrid(cells, cells, indexing="xy"), np.full((12, 12), 2.0)], -1).reshape(-1, 3)
    for number in range(VIEWS):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * (number - 2.5)
        x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
        wall_x, wall_y = 2 * (x - SIZE / 2) / 80 + pose[0, 3], 2 * (y - SIZE / 2) / 80
        column = np.clip(np.round(wall_x / 0.25 + 5.5), 0, 11).astype(int)
        row = np.clip(np.round(wall_y / 0.25 + 5.5), 0, 11).astype(int)
        shown = squares[row, column] / gains[number] + rng.normal(size=(SIZE, SIZE, 1))
        path = folder / "images" / f"p{number}.png"
        Image.fromarray(np.clip(np.round(shown), 0, 255).astype(np.uint8)).save(path)
        files.append(path)
        posed.append(PosedImage(name=f"p{number}", camera=0, camera_to_world=pose.tolist()))
        place = project(CAMERA, points - pose[:3, 3])
        inside = np.flatnonzero(((place > 4) & (place < SIZE - 4)).all(1))
        seen.append(np.stack([np.full(len(inside), number), inside]))
    visibility = np.concatenate(seen, 1)
    known = Points(points, np.zeros((len(points), 3), np.uint8), np.zeros(len(points)))
    poses = Poses(source="sfm", cameras=[CAMERA], images=posed)
    return poses, known, (visibility[0], visibility[1]), files


def differing(seed: int = 1) -> np.ndarray:
    gains = np.exp(np.random.default_rng(seed).normal(0, 0.15, (VIEWS, 3)))
    return gains / np.exp(np.log(gains).mean(0))


def test_gains_are_found(tmp_path: Path) -> None:
    gains = differing()
    found = exposure_gains(*capture(tmp_path, gains), Reporter())
    assert found is not None
    assert np.abs(np.log(found) - np.log(gains)).max() < 0.01


def test_photos_of_one_exposure_stay_as_they_are(tmp_path: Path) -> None:
    assert exposure_gains(*capture(tmp_path, np.ones((VIEWS, 3))), Reporter()) is None
    poses, points, _, files = capture(tmp_path / "lonely", differing())
    nothing = np.zeros(0, np.int64)
    assert exposure_gains(poses, points, (nothing, nothing), files, Reporter()) is None


def test_wrong_points_do_not_matter(tmp_path: Path) -> None:
    """A tenth of all observations show another place."""
    gains = differing(2)
    poses, points, (view, point), files = capture(tmp_path, gains)
    rng = np.random.default_rng(0)
    wrong = rng.uniform(size=len(point)) < 0.1
    mixed = np.where(wrong, rng.permutation(point), point)
    found = exposure_gains(poses, points, (view, mixed), files, Reporter())
    assert found is not None
    assert np.abs(np.log(found) - np.log(gains)).max() < 0.04


def test_gains_that_nothing_ties_together_stay_one() -> None:
    """Photos 0 and 1 share places, photo 2 shares none."""
    photo = np.array([[0, 1], [0, 1], [2, 2]])
    color = np.full((3, 2, 3), 100.0)
    color[:2, 1] = 50.0
    use = np.array([[True, True], [True, True], [True, False]])
    gains = common_gains(photo, color, use, 3)
    assert gains[1] / gains[0] == pytest.approx(2.0, rel=1e-2)
    assert gains[2] == pytest.approx(1.0, rel=1e-2)
    assert np.log(gains).mean(0) == pytest.approx(0, abs=1e-6)


def test_photos_are_read_at_the_common_exposure(tmp_path: Path) -> None:
    gains = differing()
    poses, points, visibility, files = capture(tmp_path, gains)
    records = [
        ImageRecord(name=file.stem, file=f"images/{file.name}", width=SIZE, height=SIZE, status="ok") for file in files
    ]
    save_project(tmp_path, Project(images=records))
    save_poses(tmp_path, poses, points, visibility)
    plain = load_scene(tmp_path)
    with_them = with_gains(tmp_path, records, poses, points, visibility, Reporter())
    save_poses(tmp_path, with_them, points, visibility)
    scene = load_scene(tmp_path)
    for view, before, gain in zip(scene.views, plain.views, gains):
        stored = photo_of(before).pixels
        assert np.abs(photo_of(view).pixels - np.minimum(stored * gain, 255)).max() < 4  # gains are found to 1 %
        assert np.array_equal(stored, np.asarray(Image.open(view.image)))
    store = PixelStore(scene, [3], [], np.eye(4), SIZE, torch.device("cpu"), Reporter())
    assert np.array_equal(store.rgba.numpy()[:, :3], photo_of(scene.views[3]).pixels.reshape(-1, 3))
    chosen = list(range(VIEWS))
    assert view_inputs(scene, chosen, files=True)["photos"] != view_inputs(plain, chosen, files=True)["photos"]
    assert view_inputs(scene, chosen, files=True)["cameras"] == view_inputs(plain, chosen, files=True)["cameras"]


@pytest.fixture
def posed_project(tmp_path: Path) -> Path:
    """A project whose poses have gains, as `poses` leaves it that was called with settings of its own."""
    poses, points, visibility, files = capture(tmp_path, differing())
    records = [
        ImageRecord(name=file.stem, file=f"images/{file.name}", width=SIZE, height=SIZE, status="ok") for file in files
    ]
    project = Project(images=records)
    asked = PosesParams(project=tmp_path, preset="robust")
    project.record(
        "poses", asked.model_dump(mode="json"), {"registered": VIEWS}, posing_inputs(tmp_path, project, asked)
    )
    save_project(tmp_path, project)
    save_poses(tmp_path, with_gains(tmp_path, records, poses, points, visibility, Reporter()), points, visibility)
    return tmp_path


def test_exposures_are_kept_of_a_project_that_has_poses(posed_project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `reconstruct` asks for it, and back again: the poses stay, whatever preset they were estimated with."""
    monkeypatch.setattr("fieldwork.nerfcore.poses.reuse.estimate_poses", lambda *_: pytest.fail("estimated anew"))
    before = load_poses(posed_project)
    for keep in (False, True, False):
        pipeline = Pipeline(posed_project, Reporter())
        asked = ReconstructParams(photos=posed_project / "photos", out=posed_project, keep_exposure=keep)
        values = stage_params(asked, "poses")
        assert values is not None
        pipeline.do("poses", values)
        poses = load_poses(posed_project)
        gains = [image.gain for image in poses.images]
        assert gains == ([None] * VIEWS if keep else [image.gain for image in before.images])
        assert [image.camera_to_world for image in poses.images] == [i.camera_to_world for i in before.images]
        assert pipeline.results["poses"]["registered"] == VIEWS
    assert pipeline.redone == {"poses": "changed: exposure"}
    assert load_points(posed_project).xyz.shape == (144, 3)
    # They are no new world: what was aligned by hand since the poses were estimated stays so.
    assert [s.result.get("world_kept") for s in load_project(posed_project).provenance if s.verb == "poses"][1:] == [
        True,
        True,
    ]


def test_records_from_before_say_whether_exposures_were_kept(posed_project: Path) -> None:
    with edit_project(posed_project) as project:
        project.provenance[-1].settings["keep_exposure"] = True
    asked = PosesParams(project=posed_project, keep_exposure=True)
    assert posed(asked).result is not None
    assert posed(asked.model_copy(update={"keep_exposure": False})).reason == "changed: exposure"
