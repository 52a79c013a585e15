"""Parts of the surface: where they end, what a click on one takes, and what the verb tells of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import Cancelled, InputError
from fieldwork.nerfcore.images.working import read_image
from fieldwork.nerfcore.labels.graph import unlikeness
from fieldwork.nerfcore.labels.journal import read_marks
from fieldwork.nerfcore.labels.lookup import outlines
from fieldwork.nerfcore.labels.part_picture import parts
from fieldwork.nerfcore.labels.parts import segments, spanning_tree, surface_parts
from fieldwork.nerfcore.labels.preparation import FOLDER, Preparation
from fieldwork.nerfcore.labels.seeds import marked_surfels
from fieldwork.nerfcore.labels.surfels import Surfels, nearest_neighbours
from fieldwork.nerfcore.params import LabelPartsParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import run_folder
from fieldwork.tests.nerfcore.support.unlabelled import SIDE
from fieldwork.tests.nerfcore.test_labels import TOP, ball, mark, truth  # noqa: F401


def plane(columns: int = 60, rows: int = 40) -> tuple[Surfels, np.ndarray]:
    """A flat sheet: its left half dark, a third of the right one light, the rest a little lighter; noise everywhere."""
    random = np.random.default_rng(0)
    x, y = (part.reshape(-1) for part in np.meshgrid(np.arange(columns), np.arange(rows)))
    kind = np.where(x < columns // 2, 0, np.where(y < rows // 3, 1, 2))
    count = x.size
    lab = np.zeros((count, 3), np.float32)
    lab[:, 0] = np.array([20.0, 70.0, 82.0])[kind] + random.normal(0, 2, count)
    position = np.stack([x / 100, y / 100, np.zeros(count)], 1).astype(np.float32)
    surfels = Surfels(
        position=position,
        normal=np.tile(np.float32([0, 0, 1]), (count, 1)) + random.normal(0, 0.02, (count, 3)).astype(np.float32),
        lab=lab,
        texture=np.zeros(count, np.float32),
        planarity=np.ones((count, 2), np.float32),
        field=random.normal(0, 1, (count, 16)).astype(np.float32),
        height=np.zeros(count, np.float32),
        pixels=np.ones(count, np.int32),
    )
    return surfels, kind


def test_parts_end_where_looks_change() -> None:
    surfels, kind = plane()
    neighbours = nearest_neighbours(surfels.position)
    found = surface_parts(neighbours, unlikeness(surfels, neighbours))
    assert found.shape == (len(kind), 2)
    for level in (0, 1):
        number = found[:, level]
        assert set(np.unique(number)) == set(range(number.max() + 1))
        # Hardly any surfel is of a part most of which is of another kind: dark and light never join.
        most = np.array([np.bincount(kind[number == part] > 0).argmax() for part in range(number.max() + 1)])
        assert (most[number] == (kind > 0)).mean() > 0.97
    assert found[:, 1].max() <= found[:, 0].max(), "coarse parts are larger"
    assert np.bincount(found[:, 0]).min() >= 10


def test_segments_join_what_differs_little() -> None:
    """A chain of three alike, a gap, and two alike: the gap stays, unless what is smaller than wanted must join."""
    neighbours = np.array([[1], [2], [1], [4], [3]])
    difference = np.array([[0.1], [0.2], [0.2], [0.1], [0.1]])
    edges, values = spanning_tree(neighbours, difference)
    assert len(edges) == 3
    assert (np.diff(values) >= 0).all()
    edges, values = np.concatenate([edges, [[2, 3]]]), np.append(values, 5.0)
    assert segments(5, edges, values, 1.0, 1, lambda: None).tolist() == [0, 0, 0, 1, 1]
    assert segments(5, edges, values, 1.0, 3, lambda: None).tolist() == [0] * 5
    assert segments(5, edges, values, 100.0, 1, lambda: None).tolist() == [0] * 5

    def stop() -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        segments(5, edges, values, 1.0, 1, stop)


def place_of(folder: Path) -> tuple[float, float]:
    rows, columns = np.nonzero(truth(folder)["01"] == TOP)
    return float(np.median(columns)) + 0.5, float(np.median(rows)) + 0.5


@pytest.mark.parametrize(("level", "column"), [("fine", 0), ("coarse", 1)])
def test_a_click_on_a_part_takes_all_of_it(ball: Path, level: str, column: int) -> None:  # noqa: F811
    place = place_of(ball)
    mark(ball, points=[place], class_id=TOP, shape="click", width=1)
    mark(ball, points=[place], class_id=TOP, shape="part", width=1, level=level)
    ready = Preparation(run_folder(ball, "main") / FOLDER)
    clicked, part = (marked_surfels(ready, one, (SIDE, SIDE)) for one in read_marks(ball))
    number = ready.parts[:, column]
    assert 0 < len(clicked) < len(part)
    taken = np.unique(number[clicked])
    assert set(part) == set(np.flatnonzero(np.isin(number, taken))), "the whole part, nothing else"


def told(folder: Path, **values: Any) -> dict[str, Any]:
    return parts(LabelPartsParams.model_validate({"project": folder, "photo": "01", **values}), Reporter())


def test_the_verb_tells_parts_and_draws_them(ball: Path, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "parts.png"
    found = told(ball, points=[place_of(ball), (0.5, 0.5)], out=out)
    ready = Preparation(run_folder(ball, "main") / FOLDER)
    surfel, _ = ready.map_of("01")
    number = np.append(ready.parts[:, 0], -1)[surfel]
    here, beside = found["at"]
    assert here["surfels"] == np.count_nonzero(ready.parts[:, 0] == here["part"])
    assert here["share"] == pytest.approx((number == here["part"]).mean(), abs=1e-3)
    assert (beside["part"], beside["surfels"]) == (None, 0)
    assert found["parts"] >= found["shown"] == len(np.unique(number[number >= 0]))
    picture = read_image(out)[..., :3]
    lines = outlines(number)
    assert 0 < lines.mean() < 0.9
    assert (picture[lines] == 255).all()
    assert told(ball)["file"] is None


def test_wrong_places_and_pictures_are_told(ball: Path, tmp_path: Path) -> None:  # noqa: F811
    with pytest.raises(InputError, match="outside the photo"):
        told(ball, points=[(SIDE + 1, 2)])
    with pytest.raises(InputError, match="no PNG"):
        told(ball, out=tmp_path / "parts.jpg")
    with pytest.raises(InputError, match="no photo"):
        told(ball, photo="nothing")


def test_the_command_line_tells_parts(ball: Path, capfd: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    x, y = place_of(ball)
    words = ["label", "parts", str(ball), "--photo", "01", "--points", f"{x},{y}", "--level", "coarse", "--json"]
    assert main(words) == 0
    assert json.loads(capfd.readouterr().out)["at"][0]["surfels"] > 0
