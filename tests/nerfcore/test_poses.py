"""Structure from motion on real photos: accuracy, validation, adding photos, being stopped, bad input."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import DiskError, FieldworkError, PosesError
from fieldwork.nerfcore.geometry.similarity import transform_points
from fieldwork.nerfcore.params import PosesParams
from fieldwork.nerfcore.poses import estimate, process
from fieldwork.nerfcore.poses.estimate import in_groups
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import load_points, load_poses, load_project, load_visibility, save_project
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.captures import centre_errors, ingest, poses, rotation_errors, view_errors
from PIL import Image

Data = Callable[[str], Path]


class Quiet:
    """Nobody is told how the pose process gets on."""

    def stage(self, name: str) -> None: ...

    def progress(self, fraction: float, message: str = "") -> None: ...


def test_fountain_is_accurate(fountain: Path, shared_data: Data) -> None:
    errors = centre_errors(fountain, shared_data("fountain_p11"))
    assert len(errors) == 11
    assert errors.max() < 0.1
    assert np.median(view_errors(fountain, shared_data("fountain_p11"))) < 0.1
    project = load_project(fountain)
    assert all(record.status == "ok" and not record.reason for record in project.images)
    assert project.provenance[-1].verb == "poses"


def test_world_is_upright_and_of_sane_size(fountain: Path) -> None:
    project = load_project(fountain)
    assert project.frame.up_confidence > 0.9
    scene = load_scene(fountain)
    ups = np.stack([-view.camera_to_world[:3, 1] for view in scene.views])
    assert ups[:, 2].min() > 0.9  # a tripod at eye level
    centres = np.stack([view.camera_to_world[:3, 3] for view in scene.views])
    assert 1 < np.median(np.linalg.norm(centres - np.median(scene.points.xyz, axis=0), axis=1)) < 6


def test_points_are_where_the_photos_see_them(fountain: Path) -> None:
    from fieldwork.nerfcore.geometry.cameras import project as to_pixels

    poses_, points, seen = load_poses(fountain), load_points(fountain), load_visibility(fountain)
    assert len(points) > 500
    assert 0 < points.error.mean() < 1
    for image in poses_.images:
        camera = poses_.cameras[image.camera]
        local = transform_points(np.linalg.inv(np.array(image.camera_to_world)), points.xyz[seen[image.name]])
        pixels = to_pixels(camera, local)
        assert (pixels > 0).all()
        assert (pixels < [camera.width, camera.height]).all()
        # The colour of a point is the mean of what the photos show there.
        with Image.open(fountain / "images" / f"{image.name}.jpg") as photo:
            shown = np.asarray(photo.convert("RGB"))[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        difference = np.abs(shown.astype(float) - points.rgb[seen[image.name]]).mean()
        assert difference < 25


def test_report(fountain: Path) -> None:
    report = json.loads((fountain / "poses" / "report.json").read_text())
    assert len(report["images"]) == 11
    assert all(image["agreement"] > 0.9 and image["points"] > 100 for image in report["images"])
    assert len(report["links"]) > 20
    with Image.open(fountain / "poses" / "report.png") as picture:
        assert picture.size[0] > 1000
        assert np.asarray(picture.convert("L")).std() > 10


@pytest.fixture(scope="module")
def nine_and_two(shared_data: Data, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A project with nine posed photos of the fountain, and a folder with the other two."""
    place = tmp_path_factory.mktemp("nine")
    (place / "first").mkdir()
    (place / "later").mkdir()
    for i, photo in enumerate(sorted((shared_data("fountain_p11") / "images").iterdir())):
        shutil.copy(photo, place / ("later" if i in (3, 8) else "first"))
    project = ingest(place / "first", place / "p", max_size=1000)
    assert poses(project)["registered"] == 9
    return project, place / "later"


@pytest.mark.parametrize(
    "later",
    [
        "same",
        pytest.param("other preset", marks=pytest.mark.slow),
        pytest.param("features lost", marks=pytest.mark.slow),
    ],
)
def test_adding_photos_keeps_old_cameras(
    shared_data: Data, nine_and_two: tuple[Path, Path], tmp_path: Path, later: str
) -> None:
    """Whatever features the first run used, and whether they are still there."""
    first, more = nine_and_two
    project = Path(shutil.copytree(first, tmp_path / "p"))
    before = {image.name: image.camera_to_world for image in load_poses(project).images}
    frame = load_project(project).frame
    ingest(more, project, add=True, max_size=1000)
    if later == "features lost":
        shutil.rmtree(project / "poses" / "sfm")
    assert poses(project, "standard" if later == "other preset" else "fast")["registered"] == 11
    after = load_poses(project)
    for image in after.images:
        if image.name in before:
            assert np.allclose(image.camera_to_world, before[image.name], atol=1e-9)
    assert load_project(project).frame == frame
    assert centre_errors(project, shared_data("fountain_p11")).max() < 0.3


def test_second_look_joins_further_features(fountain: Path, tmp_path: Path) -> None:
    """A photo without any match is placed by the features of a second database; the others do not move."""
    import zlib  # noqa: F401

    import pycolmap
    from fieldwork.nerfcore.poses import features, second_look

    (source,) = (fountain / "poses" / "sfm").glob("*.db")
    base, other = shutil.copy(source, tmp_path / "base.db"), shutil.copy(source, tmp_path / "other.db")
    model = pycolmap.Reconstruction(str(fountain / "poses" / "sparse"))
    names = sorted(image.name for image in model.images.values())
    victim = model.find_image_with_name(names[5])
    true = victim.cam_from_world().matrix()
    with features.database(base) as db:
        for image in db.read_all_images():
            if image.image_id != victim.image_id and db.exists_two_view_geometry(image.image_id, victim.image_id):
                db.delete_two_view_geometry(image.image_id, victim.image_id)
                db.delete_matches(image.image_id, victim.image_id)
    model.deregister_frame(victim.frame_id)
    images, before = fountain / "images", {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
    assert second_look.place_rest(model, base, images, tmp_path, names, Quiet()) is None
    second_look.join(base, other, tmp_path / "joined.db")
    placed = second_look.place_rest(model, tmp_path / "joined.db", images, tmp_path, names, Quiet())
    assert placed is not None
    larger, checks, _, dropped = placed
    assert larger.num_reg_images() == 11
    assert not dropped
    assert checks[victim.image_id].agreement > 0.9
    assert np.abs(larger.image(victim.image_id).cam_from_world().matrix() - true).max() < 0.02
    for i, pose in before.items():
        assert np.abs(larger.image(i).cam_from_world().matrix() - pose).max() < 1e-9
    # Matches of the first database are still there, those of the second one behind them.
    with features.database(base) as db, features.database(tmp_path / "joined.db") as both:
        a, b = sorted(i for i in before)[:2]
        ours, all_ = db.read_two_view_geometry(a, b).inlier_matches, both.read_two_view_geometry(a, b).inlier_matches
        count = db.num_keypoints_for_image(a), db.num_keypoints_for_image(b)
        assert np.array_equal(all_, np.concatenate([ours, ours + np.array(count, np.uint32)]))


def test_classes_edited_meanwhile_are_kept(fountain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blender writes names and colours of classes into the project at any time, also while poses are estimated."""
    project = Path(shutil.copytree(fountain, tmp_path / "fountain"))
    run = estimate.run_worker

    def edited_meanwhile(*arguments: Any) -> dict[str, Any]:
        result = run(*arguments)
        edited = load_project(project)
        edited.classes.append(SemanticClass(id=7, name="marble", color=(1, 1, 1)))
        save_project(project, edited)
        return result

    monkeypatch.setattr(estimate, "run_worker", edited_meanwhile)
    poses(project, restart=True)
    after = load_project(project)
    assert [c.name for c in after.classes] == ["marble"]
    assert after.provenance[-1].verb == "poses"
    assert all(record.status == "ok" for record in after.images)


def test_masks_are_honoured(fountain: Path, shared_data: Data, tmp_path: Path) -> None:
    """With the left half of every photo masked out, no point may come from there."""
    (tmp_path / "masks").mkdir()
    for record in load_project(fountain).images:
        mask = np.zeros((record.height, record.width), np.uint8)
        mask[:, record.width // 2 :] = 255
        Image.fromarray(mask).save(tmp_path / "masks" / f"{record.name}.png")
    photos = shared_data("fountain_p11") / "images"
    project = ingest(photos, tmp_path / "p", max_size=1000, masks=tmp_path / "masks")
    poses(project)
    import zlib  # noqa: F401

    import pycolmap

    model = pycolmap.Reconstruction(str(project / "poses" / "sparse"))
    x = [p.xy[0] for image in model.images.values() for p in image.get_observation_points2D()]
    assert len(x) > 300
    assert min(x) >= 499


def test_a_wrong_pose_is_found_and_repaired(fountain: Path, tmp_path: Path) -> None:
    import zlib  # noqa: F401

    import pycolmap
    from fieldwork.nerfcore.poses import mapping
    from fieldwork.nerfcore.poses.validate import check_images

    (database,) = (fountain / "poses" / "sfm").glob("*.db")
    shutil.copy(database, tmp_path / "f.db")
    model = pycolmap.Reconstruction(str(fountain / "poses" / "sparse"))
    right, _ = check_images(model, tmp_path / "f.db")
    assert min(check.agreement for check in right.values()) > 0.9
    assert not any(check.contradicting for check in right.values())
    victim = sorted(model.reg_image_ids())[5]
    frame = model.image(victim).frame
    shift = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.15, 0.05])), np.array([0.3, 0.0, 0.2]))
    frame.rig_from_world = shift * frame.rig_from_world
    wrong, _ = check_images(model, tmp_path / "f.db")
    assert wrong[victim].agreement < 0.4
    assert [i for i, check in wrong.items() if check.bad] == [victim]
    assert wrong[victim].contradicting > wrong[victim].mates / 2
    assert sum(check.contradicting for check in wrong.values()) == 2 * wrong[victim].contradicting
    names = sorted(image.name for image in model.images.values())
    images = fountain / "images"
    model, checks, _, dropped = mapping.repair(model, tmp_path / "f.db", images, tmp_path, False, names, Quiet())
    assert model.num_reg_images() == 11
    assert not dropped
    assert min(check.agreement for check in checks.values()) > 0.9


# --- bad captures ---------------------------------------------------------------------------------------------------


def flat(color: int) -> Image.Image:
    return Image.fromarray(np.full((300, 400, 3), color, np.uint8))


def test_one_photo(shared_data: Data, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    shutil.copy(sorted((shared_data("fountain_p11") / "images").iterdir())[0], tmp_path / "photos")
    project = ingest(tmp_path / "photos", tmp_path / "p")
    with pytest.raises(PosesError, match=r"has 1 usable photo .*at least 3"):
        poses(project)


def test_walls_without_texture(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for i in range(6):
        flat(90 + 20 * i).save(tmp_path / "photos" / f"{i}.png")
    project = ingest(tmp_path / "photos", tmp_path / "p")
    with pytest.raises(PosesError, match=r"6 of them have too little texture"):
        poses(project)


def turned(photo: Image.Image, yaw: float, focal: float) -> Image.Image:
    """What the same camera sees when it turns about its own centre by `yaw` radians."""
    width, height = photo.size
    k = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    c, s = np.cos(yaw), np.sin(yaw)
    h = k @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.linalg.inv(k)
    return photo.transform(photo.size, Image.Transform.PERSPECTIVE, (h / h[2, 2]).ravel()[:8], Image.Resampling.BICUBIC)


@pytest.mark.slow
def test_pure_rotation_has_no_depth(shared_data: Data, tmp_path: Path) -> None:
    """A camera that only turns: plenty of matches, and no parallax."""
    (tmp_path / "photos").mkdir()
    with Image.open(sorted((shared_data("fountain_p11") / "images").iterdir())[0]) as photo:
        photo.thumbnail((1000, 1000))
        for i in range(6):
            turned(photo, 0.04 * (i - 3), 898.0).crop((150, 50, 850, 610)).save(tmp_path / "photos" / f"{i}.png")
    project = ingest(tmp_path / "photos", tmp_path / "p", max_size=1000)
    with pytest.raises(PosesError, match="different positions"):
        poses(project)


@pytest.mark.slow
def test_two_unrelated_scenes(shared_data: Data, tmp_path: Path) -> None:
    """The larger scene is placed; every photo of the other says that it belongs to another group or matches none."""
    (tmp_path / "photos").mkdir()
    for photo in sorted((shared_data("fountain_p11") / "images").iterdir()):
        shutil.copy(photo, tmp_path / "photos" / f"fountain {photo.name}")
    for photo in sorted((shared_data("fox") / "images").iterdir())[10:24:2]:
        shutil.copy(photo, tmp_path / "photos" / f"fox {photo.name}")
    project = ingest(tmp_path / "photos", tmp_path / "p", max_size=800)
    result = poses(project)
    placed = {image["name"] for image in result["images"] if image["status"] == "ok"}
    assert placed == {image["name"] for image in result["images"] if image["name"].startswith("fountain")}
    for image in result["images"]:
        if image["name"].startswith("fox"):
            assert "separate group" in image["reason"] or "without a pose" in image["reason"]
    assert len(load_scene(project).views) == 11
    # The other scene can be had too, and a third one there is not.
    assert result["groups"] == [11, 7]
    other = poses(project, group=1)
    assert {i["name"] for i in other["images"] if i["status"] == "ok"} == {
        i["name"] for i in other["images"] if i["name"].startswith("fox")
    }
    with pytest.raises(PosesError, match="18 photos do not fall into 8 groups"):
        poses(project, group=7)


def test_noise_is_that_of_the_right_matches(fountain: Path) -> None:
    """Displaced features are counted along one axis; a tenth of wild ones changes little."""
    import pycolmap
    from fieldwork.nerfcore.poses.adjust import noise

    model = pycolmap.Reconstruction(str(fountain / "poses" / "sparse"))
    random = np.random.default_rng(0)
    for i in model.reg_image_ids():
        image = model.image(i)
        pose = image.cam_from_world().matrix()
        for point in image.points2D:
            if not point.has_point3D():
                continue
            local = pose[:, :3] @ model.point3D(point.point3D_id).xyz + pose[:, 3]
            wild = 40.0 if random.random() < 0.1 else 1.0
            point.xy = np.asarray(image.camera.img_from_cam(local[None]))[0] + random.normal(0, 0.7 * wild, 2)
    assert noise(model) == pytest.approx(0.7 * 1.08, abs=0.02)  # 1.08: the median of the mixture
    assert noise(pycolmap.Reconstruction()) == 0


def test_wrong_matches_do_not_move_the_lens(fountain: Path, shared_data: Data) -> None:
    """One feature in fifty is moved by ten pixels, the way repeated structure would: always to the same side."""
    import pycolmap
    from fieldwork.nerfcore.poses.adjust import adjust, noise

    model = pycolmap.Reconstruction(str(fountain / "poses" / "sparse"))
    before = model.camera(1).params.copy()
    random = np.random.default_rng(1)
    for i in model.reg_image_ids():
        for point in model.image(i).points2D:
            if point.has_point3D() and random.random() < 0.02:
                point.xy = point.xy + np.array([0.0, 10.0])
    adjusted = adjust(model, keep_cameras=False)
    assert noise(adjusted) < 0.3
    assert np.abs(adjusted.camera(1).params[:3] - before[:3]).max() < 1


# --- the figures of the larger captures -----------------------------------------------------------------------------


@pytest.mark.slow
def test_fountain_at_full_size(shared_data: Data, tmp_path: Path) -> None:
    project = ingest(shared_data("fountain_p11"), tmp_path / "p")
    assert poses(project, "standard")["registered"] == 11
    assert rotation_errors(project, shared_data("fountain_p11")).max() < 0.1
    assert centre_errors(project, shared_data("fountain_p11")).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "median", "largest"), [("standard", 0.03, 0.1), ("fast", 0.06, 0.2)])
def test_fox(shared_data: Data, tmp_path: Path, preset: str, median: float, largest: float) -> None:
    project = ingest(shared_data("fox"), tmp_path / "p")
    result = poses(project, preset)
    assert (result["registered"], result["total"]) == (50, 50)
    errors = centre_errors(project, shared_data("fox"))
    assert np.median(errors) < median
    assert errors.max() < largest


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"), [("temple_ring", 47), ("mary_rose_tankard", 69), ("banana", 16), ("skull", 38)]
)
def test_object_captures(shared_data: Data, tmp_path: Path, name: str, least: int) -> None:
    project = ingest(shared_data(name), tmp_path / "p")
    result = poses(project, "standard")
    assert result["registered"] >= least
    assert all(image["reason"] for image in result["images"] if image["status"] != "ok")
    report = json.loads((project / "poses" / "report.json").read_text())
    assert min(image["agreement"] for image in report["images"] if image["status"] == "ok") > 0.8
    if name not in ("banana", "skull"):
        assert centre_errors(project, shared_data(name)).max() < 2


def test_errors_are_the_kind_the_user_reads() -> None:
    assert issubclass(PosesError, FieldworkError)
    assert process.ERRORS["disk"] is DiskError


def test_groups_are_said_as_groups() -> None:
    said = in_groups([49, 11], 0)
    assert "2 groups of 49 and 11" in said
    assert "--group 1" in said
    assert "--group 0" in in_groups([11, 49, 5], 1)


def test_a_further_try_says_which_groups_there_are() -> None:
    import zlib  # noqa: F401 - before pycolmap

    from fieldwork.nerfcore.poses import pipeline

    model = lambda count: SimpleNamespace(num_reg_images=lambda: count)  # noqa: E731
    one = SimpleNamespace(registered=49, models=[model(49)])
    two = SimpleNamespace(registered=49, models=[model(49), model(11)])
    names = ["x"] * 60
    assert pipeline._placed(one, names) == "49 of 60 photos placed"  # type: ignore[arg-type]
    assert pipeline._placed(two, names).endswith("groups of 49 and 11")  # type: ignore[arg-type]


def test_progress_counts_no_two_groups_together() -> None:
    import zlib  # noqa: F401 - before pycolmap

    from fieldwork.nerfcore.poses import mapping

    said: list[tuple[float, str]] = []
    tell = SimpleNamespace(progress=lambda fraction, message: said.append((fraction, message)))
    progress = mapping._Progress(tell, 60, 0)
    progress.first_pair()
    for _ in range(47):
        progress.place()
    assert said[-1] == (49 / 60, "49 of 60 photos placed")
    progress.first_pair()
    for _ in range(9):
        progress.place()
    assert said[-1] == (1.0, "49 of 60 photos placed, 11 in a separate group")
    resumed = mapping._Progress(tell, 60, 30)
    resumed.first_pair()
    resumed.place()
    assert said[-1][1] == "31 of 60 photos placed"


def test_the_verb_says_groups_and_judges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = ball_project(tmp_path / "p", views=8, side=24)
    known = load_poses(project)

    def two_groups(job: dict[str, Any], work: Path, report: Reporter) -> dict[str, Any]:
        """Five of the photos are placed, the others by themselves."""
        random = np.random.default_rng(0)
        none = np.zeros(0, np.int32)
        colors = np.zeros((30, 3), np.uint8)
        np.savez(
            work / "points.npz", xyz=random.normal(size=(30, 3)), rgb=colors, error=np.ones(30), view=none, point=none
        )
        images = []
        for number, (image, posed) in enumerate(zip(job["images"], known.images)):
            there = {"status": "ok", "reason": "", "camera": 0, "camera_to_world": posed.camera_to_world}
            there |= {"mates": 4, "contradicting": 2 if number in (1, 3) else 1}
            away = {"status": "unregistered", "reason": "belongs to a separate group of 3 photos"}
            images.append({"file": image["file"], **(there if number < 5 else away)})
        cameras = [camera.model_dump(mode="json") for camera in known.cameras]
        return {
            "cameras": cameras,
            "images": images,
            "links": [],
            "groups": [5, 3],
            "reprojection_px": 0.5,
            "contradicting_pairs": 0,
            "level": "fast",
            "points_file": str(work / "points.npz"),
        }

    monkeypatch.setattr(estimate, "run_worker", two_groups)
    report = Reporter()
    result = estimate.estimate_poses(PosesParams(project=project), report)
    assert (result["registered"], result["groups"]) == (5, [5, 3])
    assert result["verdict"]["level"] == "weak"
    few, alike = result["verdict"]["reasons"]
    assert "5 of 8" in few
    first, second = known.images[1].name, known.images[3].name
    assert f"3 of 10 pairs of photos match but contradict their poses, most often those of {first}, {second}" in alike
    assert "2 groups of 5 and 3" in report.warnings[0]
    assert "--group 1" in report.warnings[0]
    # What is known beforehand is told at once.
    monkeypatch.setattr(estimate, "run_worker", lambda *_: pytest.fail("the photos were matched"))
    for group, reason in ((1, "the photos were matched"), (2, "8 photos do not fall into 3 groups")):
        with pytest.raises((PosesError, pytest.fail.Exception), match=reason):
            estimate.estimate_poses(PosesParams(project=project, group=group), Reporter())
    monkeypatch.setattr(estimate, "MIN_PHOTOS", 2)
    for values, reason in (
        ({}, "fall into 2 groups. Choose a smaller --group, or look"),
        ({"restart": True}, "the photos were matched"),
        ({"preset": "robust"}, "the photos were matched"),
    ):
        with pytest.raises((PosesError, pytest.fail.Exception), match=reason):
            estimate.estimate_poses(PosesParams(project=project, group=2, **values), Reporter())


def test_files_that_could_not_be_read_are_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    import zlib  # noqa: F401

    from fieldwork.nerfcore.poses import pipeline

    names = ["a", "b", "c"]
    monkeypatch.setattr(pipeline, "_reasons", lambda *_: dict.fromkeys(names, pipeline.UNREADABLE))
    best = pipeline.Attempt(level=None, database=None, models=[], checks={}, links={}, dropped={})  # type: ignore[arg-type]
    assert "3 of them could not be read" in pipeline._why_nothing(best, names)
