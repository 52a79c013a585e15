"""What is kept of a project that is imported, or whose cameras are placed, once more."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.capture.ingest import new
from fieldwork.nerfcore.data.importer import import_dataset
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import Cancelled, InputError, ProjectError
from fieldwork.nerfcore.files import file_hash
from fieldwork.nerfcore.geometry.similarity import make_similarity, transform_points, transform_pose
from fieldwork.nerfcore.measure.scale import scale_of
from fieldwork.nerfcore.params import AlignParams, ImportParams, NewParams, PosesParams
from fieldwork.nerfcore.poses import estimate
from fieldwork.nerfcore.poses.align import align
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.kept import motion_of
from fieldwork.nerfcore.project.schema import PosedImage, Poses, SemanticClass
from fieldwork.nerfcore.project.store import edit_project, load_poses, load_project, world_from_marks
from fieldwork.tests.nerfcore.support.ball import ball_project, camera_poses
from fieldwork.tests.nerfcore.support.photos import picture
from fieldwork.tests.nerfcore.support.writers import data_set
from PIL import Image

TURN = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
MOTION = make_similarity(3.5, TURN, np.array([5.0, -6, 7]))


def posed(matrices: list[np.ndarray]) -> Poses:
    images = [PosedImage(name=f"{i:02d}", camera=0, camera_to_world=m.tolist()) for i, m in enumerate(matrices)]
    return Poses(source="sfm", images=images)


def line(bend: float = 0.0) -> list[np.ndarray]:
    """Cameras in a line, which a walk along a wall makes."""
    poses = [np.eye(4) for _ in range(6)]
    for i, pose in enumerate(poses):
        pose[:3, 3] = i, bend * i * i, 0
    return poses


@pytest.mark.parametrize("cameras", [camera_poses(8), line()], ids=["ring", "line"])
@pytest.mark.parametrize("wrong", [0, 1])
def test_the_motion_of_cameras_is_found(cameras: list[np.ndarray], wrong: int) -> None:
    moved = [transform_pose(MOTION, pose) for pose in cameras]
    for pose in moved[:wrong]:
        pose[:3, 3] += 2
    motion, _ = motion_of(posed(moved), posed(cameras))
    assert motion is not None
    assert np.allclose(motion @ MOTION, np.eye(4), atol=0.02)


@pytest.mark.parametrize(
    ("after", "why"),
    [
        (line()[:2], "only 2 photos"),
        (line(bend=0.5), "in another way"),
        ([np.diag([-1.0, -1, 1, 1]) @ np.eye(4)] * 6, "at one place"),
    ],
)
def test_cameras_that_say_nothing_of_their_motion(after: list[np.ndarray], why: str) -> None:
    motion, told = motion_of(posed(after), posed(line()))
    assert motion is None
    assert why in told


def moved_worker(folder: Path, motion: np.ndarray, count: int = 8) -> Any:
    """A pose process that finds the project's poses again, in another frame."""
    known = load_poses(folder)

    def work(job: dict[str, Any], work: Path, report: Reporter) -> dict[str, Any]:
        none, xyz = np.zeros(0, np.int32), np.random.default_rng(0).normal(size=(30, 3))
        np.savez(
            work / "points.npz", xyz=xyz, rgb=np.zeros((30, 3), np.uint8), error=np.ones(30), view=none, point=none
        )
        images: list[dict[str, Any]] = []
        for number, (image, before) in enumerate(zip(job["images"], known.images)):
            pose = transform_pose(motion, np.array(before.camera_to_world)).tolist()
            there = {"status": "ok", "reason": "", "camera": 0, "camera_to_world": pose}
            there |= {"mates": 7, "contradicting": 0}
            away = {"status": "unregistered", "reason": "matches no other photo"}
            images.append({"file": image["file"], **(there if number < count else away)})
        return {
            "cameras": [camera.model_dump(mode="json") for camera in known.cameras],
            "images": images,
            "links": [],
            "groups": [count],
            "reprojection_px": 0.5,
            "contradicting_pairs": 0,
            "level": "fast",
            "points_file": str(work / "points.npz"),
        }

    return work


def centres(folder: Path) -> np.ndarray:
    return np.stack([view.camera_to_world[:3, 3] for view in load_scene(folder).views])


def test_a_world_set_by_hand_survives_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = ball_project(tmp_path / "p", views=8, side=24)
    align(AlignParams(project=project, up="x", scale=("00", "04", 9.0), crop="-1,-1,-1,2,2,2"), Reporter())
    before, frame = centres(project), load_project(project).frame
    for _ in range(2):  # what was kept is kept again
        monkeypatch.setattr(estimate, "run_worker", moved_worker(project, MOTION))
        report = Reporter()
        assert estimate.estimate_poses(PosesParams(project=project, restart=True), report)["world_kept"]
        assert report.warnings == []
        assert np.allclose(centres(project), before)
        after = load_project(project).frame
        assert (after.scale_known, after.up_confidence, after.bounds) == (True, 1.0, frame.bounds)


@pytest.mark.parametrize("by_hand", [True, False])
def test_marks_on_the_surface_go_with_the_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_hand: bool
) -> None:
    project = ball_project(tmp_path / "p", views=8, side=24)
    if by_hand:
        align(AlignParams(project=project, up="x"), Reporter())
    marks = transform_points(np.linalg.inv(world_from_marks(load_project(project))), centres(project))
    for _ in range(2):
        monkeypatch.setattr(estimate, "run_worker", moved_worker(project, MOTION))
        estimate.estimate_poses(PosesParams(project=project, restart=True), Reporter())
        assert np.allclose(transform_points(world_from_marks(load_project(project)), marks), centres(project))


def test_a_world_that_cannot_be_kept_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = ball_project(tmp_path / "p", views=8, side=24)
    align(AlignParams(project=project, scale=("00", "04", 9.0)), Reporter())
    monkeypatch.setattr(estimate, "run_worker", moved_worker(project, MOTION, count=2))
    report = Reporter()
    assert not estimate.estimate_poses(PosesParams(project=project, restart=True), report)["world_kept"]
    assert not load_project(project).frame.scale_known
    assert "only 2 photos" in report.warnings[0]
    assert "fieldwork align" in report.warnings[0]
    again = Reporter()  # there is nothing left to lose
    estimate.estimate_poses(PosesParams(project=project, restart=True), again)
    assert not any("align" in text for text in again.warnings)


def test_a_scale_that_poses_took_from_gps_is_as_sure_as_gps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """30 m for a unit, positions that are off by 2 m; later somebody sets the scale by hand."""
    project = ball_project(tmp_path / "p", views=8, side=24)
    off = np.random.default_rng(0).normal(0, 2.0, (8, 2))
    with edit_project(project) as edited:
        for record, center, (east, north) in zip(edited.images, centres(project), off):
            x, y = 30 * center[:2] + [east, north]
            record.exif = {"gps": {"latitude": np.degrees(y / 6.37e6), "longitude": np.degrees(x / 6.37e6)}}
    monkeypatch.setattr(estimate, "run_worker", moved_worker(project, MOTION))
    result = estimate.estimate_poses(PosesParams(project=project, restart=True), Reporter())
    edited = load_project(project)
    assert edited.frame.scale_known
    assert 0.1 < result["gps"]["residual_m"] < 5
    assert edited.provenance[-1].result["gps"] == result["gps"]
    found = scale_of(edited, load_poses(project), [], 0.05, None)
    assert found.source == "GPS positions of the photos"
    assert found.u == pytest.approx(result["gps"]["residual_m"] / np.sqrt(8 * 54**2), rel=0.1)
    align(AlignParams(project=project, scale=("00", "04", 100.0)), Reporter())
    monkeypatch.setattr(estimate, "run_worker", moved_worker(project, MOTION))
    again = estimate.estimate_poses(PosesParams(project=project, restart=True), Reporter())
    assert "gps" not in again  # the world is that of the scale that was set
    assert scale_of(load_project(project), load_poses(project), [], 0.05, None).source == "one distance of 100 m"


def imported(dataset: Path, project: Path) -> list[str]:
    report = Reporter()
    import_dataset(ImportParams(dataset=dataset, project=project), report)
    return report.warnings


def test_importing_again_keeps_what_was_decided(tmp_path: Path) -> None:
    dataset, project = data_set(tmp_path / "d", {"aabb_scale": 1}), tmp_path / "p"
    imported(dataset, project)
    align(AlignParams(project=project, up="y", scale=("f0", "f2", 9.0), crop="-1,-1,-1,2,2,2"), Reporter())
    (project / "labels" / "imported").mkdir(parents=True)
    with edit_project(project) as edited:
        edited.classes = [SemanticClass(id=3, name="ivy", color=(0, 1, 0), priority=2.0)]
        for record in edited.images:
            record.label = f"labels/imported/{record.name}.png"
            Image.new("L", (320, 200), 3).save(project / record.label)
    before = load_project(project)
    picture(50).save(dataset / "images" / "f2.png")
    assert imported(dataset, project) == []
    after = load_project(project)
    assert after.frame == before.frame
    assert after.classes == before.classes
    assert after.images[:2] == before.images[:2]
    assert after.images[2].label is None
    assert [step.verb for step in after.provenance] == ["import", "align", "import"]
    assert after.uuid == before.uuid


def test_importing_again_with_other_poses_moves_the_world(tmp_path: Path) -> None:
    dataset, project = data_set(tmp_path / "d", {"aabb_scale": 1}), tmp_path / "p"
    imported(dataset, project)
    align(AlignParams(project=project, scale=("f0", "f2", 9.0)), Reporter())
    before = centres(project)
    value = json.loads((dataset / "transforms.json").read_text())
    for frame in value["frames"]:
        frame["transform_matrix"] = transform_pose(MOTION, np.array(frame["transform_matrix"])).tolist()
    (dataset / "transforms.json").write_text(json.dumps(value))
    assert imported(dataset, project) == []
    assert np.allclose(centres(project), before)
    # Without an alignment by hand the world is that of the data set.
    imported(dataset, tmp_path / "q")
    (dataset / "transforms.json").write_text(json.dumps({**value, "up": [0, 1, 0]}))
    imported(dataset, tmp_path / "q")
    assert load_project(tmp_path / "q").frame.world_from_sfm[2][1] == pytest.approx(1)


VERBS = {
    "import": lambda source, project: import_dataset(ImportParams(dataset=source, project=project), Reporter()),
    "new": lambda source, project: new(NewParams(photos=source / "images", project=project), Reporter()),
}


@pytest.mark.parametrize("verb", list(VERBS))
def test_paths_of_one_name_in_two_folders_are_two_captures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    project = tmp_path / "p"
    for place in ("a", "b"):
        data_set(tmp_path / place / "data", {"aabb_scale": 1})
    monkeypatch.chdir(tmp_path / "a")
    VERBS[verb](Path("data"), project)
    before = load_project(project)
    monkeypatch.chdir(tmp_path / "b")
    with pytest.raises(ProjectError, match="already holds another capture"):
        VERBS[verb](Path("data"), project)
    assert load_project(project) == before


@pytest.mark.parametrize("verb", list(VERBS))
def test_a_capture_is_known_however_its_path_is_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    source, project = data_set(tmp_path / "a" / "data", {"aabb_scale": 1}), tmp_path / "p"
    monkeypatch.chdir(tmp_path / "a")
    VERBS[verb](Path("data"), project)
    before = load_project(project).images
    monkeypatch.chdir(tmp_path)
    for typed in (source, Path("a/data"), Path("a/../a/data")):
        VERBS[verb](typed, project)
        assert [(record.name, record.file) for record in load_project(project).images] == [
            (record.name, record.file) for record in before
        ]
        assert all(Path(record.source).is_absolute() for record in load_project(project).images)


def test_paths_that_earlier_versions_noted_as_typed_are_compared_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data_set(tmp_path / "data", {"aabb_scale": 1})
    monkeypatch.chdir(tmp_path)
    VERBS["import"](Path("data"), tmp_path / "p")
    with edit_project(tmp_path / "p") as edited:
        edited.provenance[0].settings["dataset"] = "data"
    VERBS["import"](Path("data"), tmp_path / "p")
    with pytest.raises(ProjectError, match="another capture"):
        VERBS["import"](data_set(tmp_path / "other"), tmp_path / "p")


def contents(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): file_hash(path)
        for path in folder.rglob("*")
        if path.is_file() and "jobs" not in path.parts
    }


class StoppedAtThird(Reporter):
    def progress(self, fraction: float, message: str = "") -> None:
        if message == "f2":
            raise Cancelled


@pytest.mark.parametrize("how", ["damaged", "stopped", "too many classes"])
def test_an_import_that_fails_leaves_the_project_as_it_was(tmp_path: Path, how: str) -> None:
    dataset, project = data_set(tmp_path / "d", {"aabb_scale": 1}), tmp_path / "p"
    for name in ("labels", "masks"):
        (dataset / name).mkdir()
        for i in range(3):
            Image.new("L", (320, 200), 3 if name == "labels" else 255).save(dataset / name / f"f{i}.png")
    imported(dataset, project)
    before = contents(project)
    assert {"labels/f0.png", "masks/f0.png", "images/f0.png"} <= set(before)
    picture(50).save(dataset / "images" / "f0.png")
    Image.new("L", (320, 200), 5).save(dataset / "labels" / "f0.png")
    half = Image.new("L", (320, 200), 255)
    half.paste(0, (0, 0, 320, 40))
    half.save(dataset / "masks" / "f0.png")
    if how == "damaged":
        (dataset / "labels" / "f2.png").write_bytes(b"no picture")
    if how == "too many classes":
        ids = np.arange(300, dtype=np.uint16)[None].repeat(200, 0)
        Image.fromarray(np.pad(ids, ((0, 0), (0, 20)))).save(dataset / "labels" / "f2.png")
    report = StoppedAtThird() if how == "stopped" else Reporter()
    with pytest.raises((InputError, Cancelled)):
        import_dataset(ImportParams(dataset=dataset, project=project), report)
    assert contents(project) == before
    Image.new("L", (320, 200), 3).save(dataset / "labels" / "f2.png")
    imported(dataset, project)
    after = contents(project)
    assert {name for name in after if after[name] != before.get(name)} - {"poses/points.npz"} == {
        "images/f0.png", "labels/f0.png", "masks/f0.png", "project.json",
    }  # fmt: skip


@pytest.mark.parametrize("file", [None, "transforms.json"])
def test_a_data_set_is_not_written_over_by_its_own_project(tmp_path: Path, file: str | None) -> None:
    folder = data_set(tmp_path / "set")
    before = contents(folder)
    with pytest.raises(InputError, match="where the project would keep its own files"):
        import_dataset(ImportParams(dataset=folder / file if file else folder, project=folder), Reporter())
    assert contents(folder) == before


@pytest.mark.parametrize("verb", list(VERBS))
def test_a_capture_that_was_moved_with_its_project_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    data_set(tmp_path / "job" / "data", {"aabb_scale": 1})
    monkeypatch.chdir(tmp_path / "job")
    VERBS[verb](Path("data"), Path("p"))
    before = [image.name for image in load_project(Path("p")).images]
    (tmp_path / "job").rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path / "moved")
    VERBS[verb](Path("data"), Path("p"))
    images = load_project(Path("p")).images
    assert [image.name for image in images] == before
    assert all(Path(image.source).is_file() for image in images)
