"""The texture in which things of a baked field have class indices of their own, as the viewport asks for it."""

from __future__ import annotations

import queue
import shutil
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.engine import protocol as rpc
from fieldwork.nerfcore.engine.frames import Frames
from fieldwork.nerfcore.film import instance_cells
from fieldwork.nerfcore.film.fields import LoadedField, load_field
from fieldwork.nerfcore.film.instance_cells import vertex_places
from fieldwork.nerfcore.film.thing_texture import write_thing_texture
from fieldwork.nerfcore.kernels.voxel_field import VERTICES
from fieldwork.nerfcore.render.baked import BakedField, from_texture, voxels_folder

from .support.film import ball
from .support.halves import write_halves

__all__ = ["ball"]


@pytest.fixture(scope="module")
def things(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    project = Path(shutil.copytree(ball, tmp_path_factory.mktemp("things") / "ball"))
    write_halves(project)
    return project


def vertices(texture: np.ndarray, field: LoadedField) -> np.ndarray:
    """The texels (N, 4) of a field's vertices in a texture."""
    assert isinstance(field.shown, BakedField)
    blocks = len(field.shown.field.vertices) // (2 * VERTICES**3)
    return from_texture(texture, blocks).reshape(-1, 4)


def test_each_thing_has_an_index_after_the_classes(things: Path, tmp_path: Path) -> None:
    field = load_field(things, "main", True)
    told = write_thing_texture(field, tmp_path / "told.npz")
    assert sorted(told["names"]) == ["left", "right"]
    assert told["of_class"] == [0, 0]
    folder = voxels_folder(things, "main")
    plain, found = np.load(folder / "T1.npy"), np.load(tmp_path / "told.npz")["texels"]
    assert (found.shape, found.dtype) == (plain.shape, plain.dtype)
    assert isinstance(field.shown, BakedField)
    place = vertex_places(field.shown, np.linalg.inv(field.box_from_world))
    before, after = vertices(plain, field), vertices(found, field)
    solid = vertices(np.load(folder / "T0.npy"), field)[:, 3] > 0
    assert np.array_equal(before[:, [1, 3]], after[:, [1, 3]]), "probabilities stay"
    assert np.array_equal(before[~solid], after[~solid])
    index = {name: 2 + number for number, name in enumerate(told["names"])}
    for byte in (0, 2):
        top = solid & (before[:, byte] == 0)
        assert set(after[top, byte]) == set(index.values())
        for name, side in (("left", place[:, 0] < -0.05), ("right", place[:, 0] > 0.05)):
            # Between the upper half and the lower one, where the mesh has no such face, the nearest counts.
            assert (after[top & side & (place[:, 2] > 0.05), byte] == index[name]).all()
        assert np.array_equal(after[~top, byte], before[~top, byte])
    marks = np.load(tmp_path / "told.npz")["marks"]
    by_block = after[:, 0].reshape(-1, VERTICES**3)
    assert marks.shape == (len(by_block), 4)
    for number in range(2):
        has = ((by_block == 2 + number) & solid.reshape(by_block.shape)).any(1)
        assert has.any()
        assert not has.all()
        assert marks[has, 2 + number].all()
    assert not marks[:, 0].any(), "all of that class is told apart"
    assert (marks.sum(1) > 0).all()
    for name, cube in zip(told["names"], told["cubes"]):
        corner = np.array([[x, y, z, 1] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) @ np.array(cube).T
        low, high = corner[:, :3].min(0), corner[:, :3].max(0)
        assert (low < [-0.5 if name == "left" else 0, -0.5, 0]).all()
        assert (high > [0 if name == "left" else 0.5, 0.5, 0.5]).all()
        assert (high - low).max() < 1.5


def test_where_there_is_no_room_for_all_the_largest_are_told_apart(
    things: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(instance_cells, "MOST_INDICES", 3)
    told = write_thing_texture(load_field(things, "main", True), tmp_path / "told.npz")
    assert len(told["names"]) == len(told["cubes"]) == 1
    assert np.load(tmp_path / "told.npz")["texels"][..., 0].max() == 2


def test_the_engine_answers_and_says_what_is_wrong(things: Path, ball: Path, tmp_path: Path) -> None:
    messages: queue.Queue = queue.Queue()
    frames = Frames(messages.put)

    def asked(number: int, **params: object) -> dict:
        frames.ask(rpc.Request(number, "field_things", {"frame": f"t{number}", **params}))
        while (message := messages.get(timeout=120)).get("id") != number:
            pass
        return message

    answer = asked(1, project=str(things), run="main", file=str(tmp_path / "told.npz"))
    assert sorted(answer["result"]["names"]) == ["left", "right"]
    assert (tmp_path / "told.npz").is_file()
    assert "no mesh yet" in asked(2, project=str(ball), file=str(tmp_path / "no.npz"))["error"]["message"]
    wrong = asked(3, project=str(things), file=str(tmp_path / "no.npz"), colour=1)["error"]
    assert wrong["code"] == rpc.INVALID_PARAMS
    assert "field_things" in wrong["message"]
    assert "colour" in wrong["message"]
