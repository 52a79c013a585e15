"""Marks on the surface itself, and labels of an earlier epoch carried to the next capture, on the ball."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import InputError, ProjectError
from fieldwork.nerfcore.geometry.similarity import transform_points
from fieldwork.nerfcore.labels.accept import accept
from fieldwork.nerfcore.labels.carry import carry, classes_of
from fieldwork.nerfcore.labels.journal import append_mark, read_marks
from fieldwork.nerfcore.labels.preparation import Preparation, current
from fieldwork.nerfcore.labels.propagate import propagate
from fieldwork.nerfcore.labels.revisions import computed, load, save
from fieldwork.nerfcore.labels.seeds import placed_surfels
from fieldwork.nerfcore.labels.stroke import checkout, stroke
from fieldwork.nerfcore.params import (
    LabelAcceptParams,
    LabelCarryParams,
    LabelCheckoutParams,
    LabelPropagateParams,
    LabelStrokeParams,
)
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import edit_project, load_project, save_project
from fieldwork.tests.nerfcore.support.ball import RADIUS, ball_project
from fieldwork.tests.nerfcore.test_labels import BOTTOM, TOP, ball  # noqa: F401
from pydantic import ValidationError
from scipy.spatial.transform import Rotation


def on_ball(azimuth: float, height: float) -> list[float]:
    """A place on the ball, `height` in units of its radius."""
    flat = np.sqrt(1 - height**2)
    return (RADIUS * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), height])).tolist()


def ring(height: float) -> list[list[float]]:
    return [on_ball(a, height) for a in np.linspace(0, 2 * np.pi, 12)]


def place(folder: Path, class_id: int, places: list[list[float]], **values: object) -> int:
    given = {"project": folder, "class_id": class_id, "places": places, "width": 0.1, **values}
    return stroke(LabelStrokeParams.model_validate(given), Reporter())["revision"]


def prepared(folder: Path) -> Preparation:
    found = current(folder, "main")
    assert found is not None
    return found


def right(folder: Path, turn: np.ndarray | None = None) -> float:
    """Share of the surfels away from the border between the halves that have their class."""
    ready = prepared(folder)
    places = ready.world[0] if turn is None else transform_points(np.linalg.inv(turn), ready.world[0])
    shown = propagate(LabelPropagateParams(project=folder), Reporter())["revision"]
    labelling = load(folder, "main", shown)
    assert labelling is not None
    clear = np.abs(places[:, 2]) > 0.15 * RADIUS
    return float((labelling.label(0) == np.where(places[:, 2] > 0, TOP, BOTTOM))[clear].mean())


def test_a_stroke_on_the_surface_marks_what_lies_under_it(ball: Path) -> None:  # noqa: F811
    revision = place(ball, TOP, [on_ball(0, 0.5), on_ball(0.8, 0.5)])
    ready = prepared(ball)
    mark = read_marks(ball)[revision - 1]
    assert mark.photo == ""
    marked = placed_surfels(ready, mark)
    assert len(marked) > 5
    along = np.array([on_ball(a, 0.5) for a in np.linspace(0, 0.8, 50)])
    distance = np.linalg.norm(ready.world[0][marked][:, None] - along[None], axis=2).min(1)
    assert distance.max() < 0.1
    assert place(ball, BOTTOM, ring(-0.5)) == 2
    place(ball, TOP, ring(0.5))
    assert right(ball) > 0.97
    # The marks lie in the frame of the poses: where the world is turned, they turn with the surface.
    with edit_project(ball) as project:
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
        project.frame.world_from_sfm = turned.tolist()
    assert np.array_equal(placed_surfels(prepared_anew(ball), mark), marked)


@pytest.mark.parametrize(
    "shape", ["line", pytest.param("click", marks=pytest.mark.slow), pytest.param("part", marks=pytest.mark.slow)]
)
def test_places_far_from_the_surface_mark_nothing(ball: Path, shape: str) -> None:  # noqa: F811
    """As when they are given in millimetres."""
    far = [place(ball, TOP, [[value, 400.0, 900.0]], shape=shape) for value in (1200.0, 1e300)]
    told = propagate(LabelPropagateParams(project=ball), Reporter())
    assert told["unused"] == far
    assert told["void"] == 1


def test_a_stroke_marks_nothing_where_it_is_off_the_surface(ball: Path) -> None:  # noqa: F811
    ends = [on_ball(0, 0.2), on_ball(np.pi, 0.2)]  # the way between them goes through the ball
    place(ball, TOP, ends)
    ready = prepared(ball)
    (mark,) = read_marks(ball)
    marked = ready.world[0][placed_surfels(ready, mark)]
    distance = np.linalg.norm(marked[:, None] - np.array(ends)[None], axis=2)
    assert (distance.min(0) < 0.1).all(), "both ends are marked"
    assert distance.min(1).max() < 0.2


def test_a_stroke_of_a_thin_brush_reaches_its_end(ball: Path) -> None:  # noqa: F811
    ready = prepared(ball)
    ends = np.array([on_ball(0, 0.3), on_ball(60, 0.3)])
    at_end = set(ready.tree.query(ends)[1].tolist())
    place(ball, TOP, ends.tolist(), width=1e-5)
    (mark,) = read_marks(ball)
    assert at_end <= set(placed_surfels(ready, mark).tolist())


def prepared_anew(folder: Path) -> Preparation:
    """The same surfels where the world lies otherwise."""
    return Preparation(folder / "runs/main/surfels")


def test_a_mark_on_the_surface_is_made_on_the_command_line(ball: Path) -> None:  # noqa: F811
    words = ["label", "stroke", str(ball), "--class-id", "1", "--width", "0.05"]
    assert main([*words, "--places", "0,0,0.5 0.1,0,0.49"]) == 0
    (mark,) = read_marks(ball)
    assert mark.points == []
    np.testing.assert_allclose(np.shape(mark.places), (2, 3))
    assert main([*words, "--places", "0,0 0.1,0"]) != 0
    assert len(read_marks(ball)) == 1


def test_what_is_wrong_with_a_mark_on_the_surface_is_told(ball: Path) -> None:  # noqa: F811
    with pytest.raises(ValidationError, match="a photo with points, or places"):
        place(ball, TOP, [on_ball(0, 0)], photo="01", points=[(1, 1)])
    with pytest.raises(ValidationError, match="outline"):
        place(ball, TOP, ring(0.5), shape="outline")
    with pytest.raises(InputError, match="no class 9"):
        place(ball, 9, [on_ball(0, 0)])
    with pytest.raises(ValidationError, match="finite"):
        place(ball, TOP, [[0.0, float("inf"), 0.0]])


def epochs(unlabelled: Path, folder: Path) -> tuple[Path, Path, np.ndarray, Path]:
    """An epoch with labels, a later one without any whose world lies otherwise, the way from one to the other, and common
    points."""
    before, now = (Path(shutil.copytree(unlabelled, folder / name)) for name in ("before", "now"))
    place(before, TOP, ring(0.5))
    place(before, BOTTOM, ring(-0.5))
    assert right(before) > 0.97
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("zx", [100, 70], degrees=True).as_matrix()
    turn[:3, 3] = [3, -1, 0.5]
    shutil.rmtree(now / "marks", ignore_errors=True)
    with edit_project(now) as project:
        project.frame.world_from_sfm = (turn @ np.array(project.frame.world_from_sfm)).tolist()
    save_project(now, project.model_copy(update={"classes": []}))
    rows = ["name,x,y,z,other_x,other_y,other_z"]
    for number, there in enumerate(np.array([[0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5], [-0.5, 0, 0]])):
        here = transform_points(turn, there[None])[0]
        rows.append(",".join(map(str, [number, *here, *there])))
    (folder / "points.csv").write_text("\n".join(rows))
    return before, now, turn, folder / "points.csv"


def test_labels_of_an_earlier_epoch_are_carried_shown_as_such_and_confirmed(unlabelled: Path, tmp_path: Path) -> None:
    before, now, turn, points = epochs(unlabelled, tmp_path)
    result = carry(LabelCarryParams(project=now, other=before, points=points, author="Ada"), Reporter())
    assert result["carried"] > 0.9
    assert result["unmatched"] < 0.05
    assert sorted(result["classes"]) == sorted(c.name for c in load_project(before).classes)
    assert read_marks(now)[0].author == "Ada"
    assert right(now, turn) > 0.97
    first = load(now, "main", 1)
    assert first is not None
    assert first.carried is not None
    assert first.carried.mean() > 0.9
    assert first.told["carried"] == pytest.approx(first.carried.mean(), abs=1e-3)
    # A stroke corrects, and what it marks is no longer carried.
    mark = stroke(
        LabelStrokeParams.model_validate(
            {"project": now, "void": True, "places": transform_points(turn, np.array(ring(0.8))).tolist(), "width": 0.1}
        ),
        Reporter(),
    )["revision"]
    propagate(LabelPropagateParams(project=now), Reporter())
    second = load(now, "main", mark)
    assert second is not None
    assert second.carried is not None
    assert (second.label(0) == 0).sum() > (first.label(0) == 0).sum()
    assert not second.carried[second.label(0) == 0].any()
    confirmed = carry(LabelCarryParams(project=now, confirm=True, author="Bob"), Reporter())
    told = propagate(LabelPropagateParams(project=now), Reporter())
    assert told["revision"] == confirmed["revision"]
    assert told["carried"] == 0
    assert read_marks(now)[-1].author == "Bob"
    with pytest.raises(InputError, match="no carried labels to confirm"):
        carry(LabelCarryParams(project=now, confirm=True), Reporter())
    # Undo shows them as carried again, and accepting works with what is shown.
    checkout(LabelCheckoutParams(project=now, revision=1), Reporter())
    assert propagate(LabelPropagateParams(project=now), Reporter())["carried"] > 0.9
    done = accept(LabelAcceptParams(project=now, seconds=1.0), Reporter())
    assert done["revision"] == 1
    assert sorted(done["classes"]) == sorted(c.name for c in load_project(before).classes)


def test_carried_classes_get_ids_that_neither_classes_nor_marks_nor_void_have(tmp_path: Path) -> None:
    folder = ball_project(tmp_path / "p", views=3)
    append_mark(folder, {"photo": "00", "shape": "line", "points": [(1, 1)], "class_id": 3})
    with edit_project(folder) as project:
        project.ignore_id, kept = 65535, project.classes
        project.classes = [*kept, SemanticClass(id=4, name="gone", color=(0, 0, 0))]
    with edit_project(folder) as project:
        project.classes = kept
    grey = (0.5, 0.5, 0.5)
    wanted = [SemanticClass(id=i, name=name, color=grey) for i, name in ((3, "brick"), (65535, "glass"), (7, "top"))]
    assert classes_of(folder, wanted) == ({3: 5, 65535: 6, 7: TOP}, ["brick", "glass"])


def test_epochs_that_do_not_fit_and_damaged_files_are_told(unlabelled: Path, tmp_path: Path) -> None:
    before, now, _, points = epochs(unlabelled, tmp_path)
    far = tmp_path / "far.csv"
    far.write_text(points.read_text().replace("\n0,", "\n0,9"))
    text = ["name,x,y,z,other_x,other_y,other_z"]
    text += [f"{n},{x + 500},{y},0,{x},{y},0" for n, (x, y) in enumerate([(0, 0), (1, 0), (0, 1)])]
    far.write_text("\n".join(text))
    with pytest.raises(InputError, match="were not registered"):
        carry(LabelCarryParams(project=now, other=before, points=far), Reporter())
    assert read_marks(now) == []
    with pytest.raises(ProjectError, match="not propagated"):
        carry(LabelCarryParams(project=before, other=now), Reporter())
    _, shown = computed(before, "main", None)
    save(before, "main", replace(shown, probability=np.zeros_like(shown.probability)))
    with pytest.raises(InputError, match="shows no class where"):
        carry(LabelCarryParams(project=now, other=before, points=points), Reporter())
    assert read_marks(now) == []
    save(before, "main", shown)
    carry(LabelCarryParams(project=now, other=before, points=points), Reporter())
    (now / read_marks(now)[0].file).write_bytes(b"")
    with pytest.raises(ProjectError, match=r"carried are not readable: .*carried_"):
        propagate(LabelPropagateParams(project=now), Reporter())
