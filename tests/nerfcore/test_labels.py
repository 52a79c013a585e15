"""Labels from two strokes on the ball: top and bottom, in every verb, and what happens when something is amiss."""

from __future__ import annotations

import errno
import json
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import Cancelled, DiskError, InputError, ProjectError
from fieldwork.nerfcore.evaluate.verb import without_guesses
from fieldwork.nerfcore.images.working import nearest, read_label
from fieldwork.nerfcore.labels.accept import accept
from fieldwork.nerfcore.labels.journal import read_marks
from fieldwork.nerfcore.labels.next_photo import next_photo
from fieldwork.nerfcore.labels.overlay import overlay, photo_labels
from fieldwork.nerfcore.labels.preparation import FOLDER, Preparation, current, prepare
from fieldwork.nerfcore.labels.propagate import propagate
from fieldwork.nerfcore.labels.propagation import propagated
from fieldwork.nerfcore.labels.revisions import computed, load
from fieldwork.nerfcore.labels.seeds import VOID, Carried, Seeds, seeds_of
from fieldwork.nerfcore.labels.stroke import checkout, stroke
from fieldwork.nerfcore.measure.verb import measure
from fieldwork.nerfcore.mesh.verb import mesh
from fieldwork.nerfcore.params import (
    LabelAcceptParams,
    LabelCheckoutParams,
    LabelNextParams,
    LabelOverlayParams,
    LabelPrepareParams,
    LabelPropagateParams,
    LabelStrokeParams,
    MeasureParams,
    MeshParams,
    RenderParams,
    TrainParams,
)
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.label_revision import MAPS, SUGGESTED
from fieldwork.nerfcore.project.runs import CHECKPOINT, INFO, checkpoint_id, geometry_id, run_folder
from fieldwork.nerfcore.project.store import edit_project, load_points, load_poses, load_project, save_poses
from fieldwork.nerfcore.render.run import load_trained
from fieldwork.nerfcore.render.verb import render
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.unlabelled import SIDE
from PIL import Image

TOP, BOTTOM = 1, 2


def truth(folder: Path) -> dict[str, np.ndarray]:
    return {view.name: read_label(folder / "labels" / f"{view.name}.png") for view in load_scene(folder).views}


@pytest.fixture
def ball(unlabelled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(unlabelled, tmp_path / "p"))


def mark(folder: Path, **values: Any) -> int:
    given = {"project": folder, "photo": "01", "width": 3, **values}
    return stroke(LabelStrokeParams.model_validate(given), Reporter())["revision"]


def two_strokes(folder: Path, photo: str = "01") -> None:
    """One to and fro over the upper half of a photo, one over the lower, well away from where they meet."""
    ids = truth(folder)[photo]
    for class_id in (TOP, BOTTOM):
        rows, columns = np.nonzero(ids == class_id)
        points = []
        for number, row in enumerate(np.percentile(rows, [20, 50, 80]).astype(int).tolist()):
            inside = columns[rows == row]
            ends = [(float(inside.min()) + 3, row + 0.5), (float(inside.max()) - 3, row + 0.5)]
            points += ends[:: -1 if number % 2 else 1]
        mark(folder, points=points, class_id=class_id, photo=photo)


def spread(folder: Path, **values: Any) -> dict[str, Any]:
    return propagate(LabelPropagateParams(project=folder, **values), Reporter())


def right_share(folder: Path, revision: int | None = None) -> float:
    """Share of the ball's pixels, in all photos, whose label is the true one; its rim and equator apart."""
    ready, labelling = computed(folder, "main", revision)
    right = total = 0
    for name, ids in truth(folder).items():
        found, _ = photo_labels(ready, labelling, name, 0)
        found = nearest(found, SIDE, SIDE)
        same = np.ones(ids.shape, bool)
        for axis in (0, 1):
            for step in (-2, 2):
                same &= np.roll(ids, step, axis) == ids
        sure = (ids > 0) & same
        right, total = right + np.count_nonzero(sure & (found == ids)), total + np.count_nonzero(sure)
    return right / total


def test_surfels_lie_on_the_ball_and_photos_show_them(unlabelled: Path) -> None:
    ready = Preparation(run_folder(unlabelled, "main") / FOLDER)
    box = load_trained(unlabelled, "main").info.box(load_project(unlabelled))
    normalised = ready.surfels.position.astype(np.float64) * 2 - 1  # the grid of a field that is not contracted
    world = normalised @ box.world_from_box[:3, :3].T + box.world_from_box[:3, 3]
    distance = np.linalg.norm(world, axis=1)
    assert np.median(np.abs(distance - 0.5)) < 0.04
    outward = (ready.surfels.normal * world / distance[:, None]).sum(1)
    assert np.median(outward) > 0.9
    np.testing.assert_allclose(ready.surfels.height, world[:, 2], atol=1e-4)
    assert len(ready.surfels) <= 3000
    for name, ids in truth(unlabelled).items():
        shown = nearest(ready.map_of(name)[0], SIDE, SIDE) >= 0
        assert (shown == (ids > 0)).mean() > 0.9


def test_two_strokes_label_both_halves(ball: Path) -> None:
    two_strokes(ball)
    told = spread(ball)
    assert (told["revision"], told["marks"], told["conflicts"], told["unused"]) == (2, 2, [], [])
    assert [c["name"] for c in told["classes"]] == ["top", "bottom"]
    # The ball's colours say nothing of its halves, and a field of so few steps has learned little else.
    assert right_share(ball) > 0.7
    again = load(ball, "main", 2)
    assert again is not None
    assert again.probability.min() >= 0
    assert again.probability.sum(1).max() <= 1.001


def test_without_marks_all_is_void(ball: Path) -> None:
    assert spread(ball)["void"] == 1
    mark(ball, points=[(20, 10)], void=True, shape="click")
    told = spread(ball)
    assert (told["void"], told["classes"], told["confidence"]) == (1, [], None)


def test_undo_brings_earlier_labels_back_and_erasing_takes_marks_away(ball: Path) -> None:
    two_strokes(ball)
    spread(ball)
    before = load(ball, "main", 2)
    erased = mark(ball, points=[(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE)], shape="outline", erase=True)
    told = spread(ball)
    assert (told["void"], told["erased"]) == (1, [1, 2])
    checkout(LabelCheckoutParams(project=ball, revision=2), Reporter())
    assert spread(ball)["revision"] == 2
    after = load(ball, "main", 2)
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(after.probability, before.probability, atol=0.05)
    assert mark(ball, points=[(20, 10)], class_id=TOP) == erased + 1
    assert spread(ball)["marks"] == 3


def test_contradicting_strokes_are_listed_and_the_later_one_counts(ball: Path) -> None:
    line = [(14.0, 14.0), (26.0, 14.0)]
    mark(ball, points=line, class_id=TOP)
    mark(ball, points=line, class_id=BOTTOM)
    told = spread(ball)
    assert [(c["revision"], c["other"]) for c in told["conflicts"]] == [(2, 1)]
    assert told["conflicts"][0]["surfels"] > 0
    ready, labelling = computed(ball, "main", None)
    ids, _ = photo_labels(ready, labelling, "01", 0)
    assert nearest(ids, SIDE, SIDE)[14, 20] == BOTTOM


def test_a_contradiction_ends_when_the_later_stroke_is_erased(ball: Path) -> None:
    line = [(14.0, 14.0), (26.0, 14.0)]
    for class_id in (TOP, BOTTOM):
        mark(ball, points=line, class_id=class_id)
    mark(ball, points=line, erase=True, width=12)
    told = spread(ball)
    assert told["conflicts"] == []
    assert 2 in told["erased"]


def test_a_first_mark_of_one_surfel_is_enough(ball: Path) -> None:
    ready = Preparation(ball / "runs/main/surfels")
    surfel, edge = ready.map_of("01")
    row, column = np.argwhere((surfel >= 0) & ~edge)[50]
    point = ((column + 0.5) * SIDE / surfel.shape[1], (row + 0.5) * SIDE / surfel.shape[0])
    mark(ball, points=[point], shape="click", class_id=TOP, width=1)
    assert len(seeds_of(ready, read_marks(ball), [TOP], {"01": (SIDE, SIDE)}).surfel) == 1
    assert spread(ball)["unused"] == []


def test_marks_are_propagated_anew_for_what_needs_them_where_the_world_was_turned(ball: Path) -> None:
    two_strokes(ball)
    spread(ball)
    with edit_project(ball) as project:
        project.frame.world_from_sfm = np.diag([1.0, -1, -1, 1]).tolist()
    assert current(ball, "main") is None
    assert len(next_photo(LabelNextParams(project=ball, count=2), Reporter())["photos"]) == 2
    assert accept(LabelAcceptParams(project=ball, seconds=0.1), Reporter())["revision"] == 2


def test_marks_outrank_what_a_model_guessed(ball: Path) -> None:
    guesses = ball / SUGGESTED
    guesses.mkdir(parents=True)
    with edit_project(ball) as project:
        for image in project.images:
            Image.fromarray(np.full((SIDE, SIDE), TOP, np.uint8)).save(guesses / f"{image.name}.png")
            image.label = f"{SUGGESTED}/{image.name}.png"
    two_strokes(ball)
    spread(ball)
    told = accept(LabelAcceptParams(project=ball, seconds=0.1), Reporter())
    scene = load_scene(ball)
    assert (told["photos"], told["kept"]) == (len(scene.train), 0)
    held_out = {scene.views[i].name for i in scene.test}
    labels = {image.name: image.label for image in load_project(ball).images}
    assert {name for name, label in labels.items() if label is None} == held_out


@pytest.mark.parametrize("made", [SUGGESTED, MAPS.format(1)])
def test_held_out_photos_are_not_measured_by_labels_that_were_made_here(ball: Path, made: str) -> None:
    """As those that were accepted for a run that holds out others."""
    with edit_project(ball) as project:
        own = project.images[0].label
        for image in project.images:
            image.label = f"{made}/{image.name}.png"
    scene = load_scene(ball)
    judged = without_guesses(scene, ball)
    assert own is None
    assert [judged.views[i].label for i in scene.test] == [None] * len(scene.test)
    assert [judged.views[i].label for i in scene.train] == [scene.views[i].label for i in scene.train]
    assert all(scene.views[i].label is not None for i in scene.test)


def test_without_classes_carried_labels_are_void(ball: Path) -> None:
    ready = Preparation(ball / "runs/main/surfels")
    nothing = np.zeros(0, np.int32)
    told = Carried(
        np.full(len(ready.surfels), VOID), np.ones(len(ready.surfels), np.float32), np.zeros(len(ready.surfels), bool)
    )
    seeds = Seeds(nothing, nothing, nothing, [], [], told)
    assert propagated(ready, seeds, 0).shape == (len(ready.surfels), 0)


def test_a_mark_keeps_its_place_when_its_photo_is_read_at_another_size(ball: Path) -> None:
    mark(ball, points=[(14.0, 14.0), (26.0, 14.0)], class_id=TOP)
    ready = Preparation(ball / "runs/main/surfels")
    surfels = [seeds_of(ready, read_marks(ball), [TOP], {"01": (n * SIDE, n * SIDE)}).surfel for n in (1, 2)]
    assert len(surfels[0])
    np.testing.assert_array_equal(*surfels)


def test_marks_beside_the_surface_and_of_lost_classes_are_told(ball: Path) -> None:
    two_strokes(ball)
    beside = mark(ball, points=[(1, 1)], shape="click", class_id=TOP)
    with edit_project(ball) as project:
        project.classes = project.classes[:1]
    told = spread(ball)
    assert told["unused"] == [2, beside]
    assert [c["name"] for c in told["classes"]] == ["top"]


@pytest.mark.parametrize("what", ["pose", "photo"])
def test_marks_on_a_photo_that_is_gone_are_told_and_the_others_count(ball: Path, what: str) -> None:
    two_strokes(ball)
    mark(ball, points=[(20, 20)], shape="click", class_id=TOP, photo="02")
    if what == "photo":
        with edit_project(ball) as project:
            project.images = [image for image in project.images if image.name != "02"]
    poses = load_poses(ball)
    poses.images = [image for image in poses.images if image.name != "02"]
    save_poses(ball, poses, load_points(ball))
    told = spread(ball)
    assert told["unused"] == [3]
    assert [c["name"] for c in told["classes"]] == ["top", "bottom"]
    assert accept(LabelAcceptParams(project=ball, seconds=0.1), Reporter())["revision"] == 3


def test_labels_with_a_class_that_is_gone_are_not_accepted(ball: Path) -> None:
    two_strokes(ball)
    spread(ball)
    with edit_project(ball) as project:
        project.classes = project.classes[:1]
    with pytest.raises(ProjectError, match="propagated before a class of it was removed"):
        accept(LabelAcceptParams(project=ball, seconds=0.1), Reporter())
    spread(ball)
    assert accept(LabelAcceptParams(project=ball, seconds=0.1), Reporter())["classes"] == ["top"]


def test_overlays_are_looked_up_and_photos_suggested(ball: Path, tmp_path: Path) -> None:
    two_strokes(ball)
    spread(ball)
    ready, labelling = computed(ball, "main", None)
    ids, sure = photo_labels(ready, labelling, "05", 0)
    for kind in ("ids", "colors", "confidence"):
        out = tmp_path / f"{kind}.png"
        told = overlay(LabelOverlayParams(project=ball, photo="05", kind=kind, out=out), Reporter())
        picture = np.asarray(Image.open(told["file"]))
        assert picture.shape[:2] == (told["height"], told["width"]) == ids.shape
        if kind == "ids":
            np.testing.assert_array_equal(picture, ids)
        if kind == "confidence":
            np.testing.assert_allclose(picture / 255, sure, atol=0.01)
    assert sure[ids == 0].max(initial=0) <= 1
    listed = next_photo(LabelNextParams(project=ball, count=12), Reporter())["photos"]
    scores = [photo["score"] for photo in listed]
    assert scores == sorted(scores, reverse=True)
    assert {photo["name"] for photo in listed} == set(truth(ball))
    assert sum(photo["marks"] for photo in listed) == 2


def test_accepted_labels_are_the_fields_and_renders_name_the_revision(ball: Path, tmp_path: Path) -> None:
    two_strokes(ball)
    spread(ball)
    density, before = geometry_id(ball, "main"), checkpoint_id(ball, "main")
    old = load_trained(ball, "main").model.state_dict()
    told = accept(LabelAcceptParams(project=ball, seconds=3), Reporter())
    assert told["classes"] == ["top", "bottom"]
    assert told["agreement"] > 0.75
    assert (told["photos"], told["kept"]) == (len(load_scene(ball).train), 0)
    new = load_trained(ball, "main")
    assert new.info.class_ids == [TOP, BOTTOM]
    for name, value in new.model.state_dict().items():
        if name in old and "semantic" not in name and name != "priorities":
            assert (value == old[name]).all(), name
    assert geometry_id(ball, "main") == density
    assert checkpoint_id(ball, "main") != before
    assert current(ball, "main") is not None
    result = render(RenderParams(project=ball, out=tmp_path / "r", test=True, passes=["rgb", "semantic"]), Reporter())
    assert result["label_revision"] == 2
    surface = mesh(MeshParams(project=ball, resolution=48), Reporter())
    assert surface["label_revision"] == 2
    assert measure(MeasureParams(project=ball), Reporter())["label_revision"] == 2
    area = {name: values["area"] for name, values in surface["classes"].items()}
    assert min(area["top"], area["bottom"]) > 0.15 * sum(area.values())
    held_out, right = {load_scene(ball).views[i].name for i in load_scene(ball).test}, []
    for image in load_project(ball).images:
        assert (image.label is None) == (image.name in held_out)
        if image.label:
            assert image.label == f"{MAPS.format(2)}/{image.name}.png"
            ids = read_label(ball / image.label)
            wanted = truth(ball)[image.name]
            both = (ids > 0) & (wanted > 0)
            right.append((ids == wanted)[both])
    assert np.concatenate(right).mean() > 0.7
    # A training cannot go on over other labels; an own label map is kept by the next accept.
    with pytest.raises(ProjectError, match="labels"):
        train(TrainParams(project=ball, steps=260, resume=True, set=SMALL), Reporter())
    own = sorted(set(truth(ball)) - held_out)[0]
    with edit_project(ball) as project:
        next(i for i in project.images if i.name == own).label = f"labels/{own}.png"
    mark(ball, points=[(20, 12)], shape="click", class_id=TOP)
    spread(ball)
    told = accept(LabelAcceptParams(project=ball, seconds=1), Reporter())
    assert (told["revision"], told["kept"]) == (3, 1)
    assert next(i for i in load_project(ball).images if i.name == own).label == f"labels/{own}.png"
    assert not (ball / MAPS.format(2)).exists()
    assert (ball / MAPS.format(3)).is_dir()


def test_photos_that_another_run_holds_out_lose_the_maps_that_were_accepted_before(ball: Path) -> None:
    two_strokes(ball)
    spread(ball)
    accept(LabelAcceptParams(project=ball, seconds=0.1), Reporter())
    shutil.copytree(run_folder(ball, "main"), run_folder(ball, "other"))
    config = run_folder(ball, "other") / INFO
    config.write_text(json.dumps(json.loads(config.read_text()) | {"holdout": 3}))
    mark(ball, points=[(20, 12)], shape="click", class_id=TOP)
    spread(ball, run="other")
    accept(LabelAcceptParams(project=ball, run="other", seconds=0.1), Reporter())
    scene = load_scene(ball, 3)
    train_names = {scene.views[i].name for i in scene.train}
    for image in load_project(ball).images:
        wanted = f"{MAPS.format(3)}/{image.name}.png" if image.name in train_names else None
        assert image.label == wanted
        assert (image.confidence is None) == (wanted is None)


def test_a_stale_preparation_is_noticed_and_made_again(ball: Path) -> None:
    two_strokes(ball)
    spread(ball)
    assert prepare(LabelPrepareParams(project=ball, surfels=3000), Reporter())["reused"]
    train(TrainParams(project=ball, steps=255, resume=True), Reporter())
    assert current(ball, "main") is None
    with pytest.raises(ProjectError, match="not prepared for labelling since it was trained"):
        overlay(LabelOverlayParams(project=ball, photo="01"), Reporter())
    assert spread(ball)["revision"] == 2
    with edit_project(ball) as project:
        project.frame.world_from_sfm[0][3] += 1.0
    with pytest.raises(ProjectError, match="since it was trained, aligned"):
        computed(ball, "main", None)
    assert spread(ball)["revision"] == 2
    assert current(ball, "main") is not None
    assert right_share(ball) > 0.6


@pytest.mark.parametrize("name", ["prepared.json", "position.npy", "pixel_surfel.npy"])
def test_a_damaged_preparation_is_made_again(ball: Path, name: str) -> None:
    path = run_folder(ball, "main") / FOLDER / name
    path.write_bytes(path.read_bytes()[:20])
    assert current(ball, "main") is None
    assert not prepare(LabelPrepareParams(project=ball, surfels=3000), Reporter())["reused"]


def test_what_is_missing_is_told(ball: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    two_strokes(ball)
    with pytest.raises(ProjectError, match="was not propagated"):
        overlay(LabelOverlayParams(project=ball, photo="01"), Reporter())
    with pytest.raises(InputError, match="no revision 7"):
        spread(ball, revision=7)
    with pytest.raises(ProjectError, match="no run “other”"):
        spread(ball, run="other")
    untrained = ball_project(tmp_path / "untrained")
    assert main(["label", "prepare", str(untrained), "--json"]) == 1
    assert "fieldwork train" in json.loads(capfd.readouterr().out)["error"]["hint"]
    spread(ball, revision=0)
    with pytest.raises(InputError, match="has no class"):
        accept(LabelAcceptParams(project=ball, revision=0), Reporter())


def files_of(folder: Path) -> dict[str, int]:
    return {
        str(p.relative_to(folder)): p.stat().st_size for p in folder.rglob("*") if p.is_file() and "jobs" not in p.parts
    }


def test_on_a_full_disk_nothing_is_half_written(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two_strokes(ball)
    spread(ball)
    before, trained_field = files_of(ball), (run_folder(ball, "main") / CHECKPOINT).read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for place, work in (
        ("accept.write_checkpoint", lambda: accept(LabelAcceptParams(project=ball, seconds=0.5), Reporter())),
        ("preparation.np.save", lambda: prepare(LabelPrepareParams(project=ball, surfels=2000), Reporter())),
        ("revisions.np.savez", lambda: spread(ball, revision=1)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(f"fieldwork.nerfcore.labels.{place}", full)
            with pytest.raises(DiskError, match="No space left"):
                work()
        assert files_of(ball) == before, place
    assert (run_folder(ball, "main") / CHECKPOINT).read_bytes() == trained_field


def cancelled_after(seconds: float, work: Any) -> float:
    """Seconds from a cancel to the end of some work that would take longer."""
    report = Reporter()
    at: list[float] = []

    def cancel() -> None:
        at.append(time.monotonic())
        report.cancel()

    timer = threading.Timer(seconds, cancel)
    timer.start()
    with pytest.raises(Cancelled):
        work(report)
    return time.monotonic() - at[0]


def test_a_cancel_takes_two_seconds_at_most(ball: Path) -> None:
    two_strokes(ball)
    spread(ball)
    before = files_of(ball)
    assert cancelled_after(0.5, lambda r: accept(LabelAcceptParams(project=ball, seconds=60), r)) < 2
    stopped = Reporter()
    stopped.cancel()
    for work in (
        lambda r: prepare(LabelPrepareParams(project=ball, surfels=2000), r),
        lambda r: propagate(LabelPropagateParams(project=ball, revision=1), r),
    ):
        with pytest.raises(Cancelled):
            work(stopped)
    assert files_of(ball) == before


def test_what_was_propagated_tells_of_itself_later(ball: Path) -> None:
    two_strokes(ball)
    told = spread(ball)
    found = load(ball, "main", 2)
    assert found is not None
    assert found.told == {name: value for name, value in told.items() if name != "file"}
