"""What the viewport shows of a field and its things: looks of class indices, and what the engine of frames tells of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy")

from fieldwork.addon.errors import EngineError
from fieldwork.addon.live import thing_texels, voxels

RED, BLUE, GREEN = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
META = {"class_ids": [7, 9, 11]}
MARKS = np.array([[1, 0, 0, 0, 0], [0, 0, 1, 1, 0], [1, 0, 0, 0, 1]], bool)  # three blocks, five indices
TOLD = thing_texels.Told(["cup", "plate"], [1, 0], [], None, MARKS)


def entry(number: int, color: tuple, shown: float = 1.0, tint: float = 0.0) -> SimpleNamespace:
    return SimpleNamespace(id=number, color=color, shown=shown, tint=tint)


def test_looks_of_classes_are_found_by_their_ids() -> None:
    looks = voxels.class_looks(META, [entry(9, BLUE, 0.5, 0.25), entry(7, RED)])
    assert looks[0] == (RED, 1.0, 0.0, RED)
    assert looks[1] == (BLUE, 0.5, 0.25, BLUE)
    assert looks[2] == (voxels.BLACK, 1.0, 0.0, voxels.BLACK), "one that the object does not know yet"


def test_things_look_as_their_classes_but_for_what_is_edited() -> None:
    classes = voxels.class_looks(META, [entry(7, RED, tint=0.5), entry(9, BLUE, 0.5)])
    looks = voxels.thing_looks(classes, TOLD, {})
    assert looks[:3] == classes
    assert looks[3:] == [classes[1], classes[0]]
    edited = {
        "cup": {"opacity": 0.5, "tint": 1.0, "color": GREEN},
        "plate": {"opacity": 0.0, "tint": 0.0, "color": GREEN},
    }
    cup, plate = voxels.thing_looks(classes, TOLD, edited)[3:]
    assert cup == (GREEN, 0.25, 1.0, BLUE), "factors of opacity; among the labels it has the color of its class"
    assert plate == (RED, 0.0, 0.5, RED), "without a tint of its own it has that of its class"
    only = voxels.alone(classes, TOLD, "cup", edited["cup"])
    assert [look.opacity for look in only] == [0, 0, 0, 0.25, 0]
    assert only[3] == cup


def test_rows_of_the_table_are_those_that_the_shader_reads() -> None:
    rows = np.array(voxels.rows(voxels.thing_looks(voxels.class_looks(META, [entry(7, RED, 0.5, 0.25)]), TOLD, {})))
    table = rows.reshape(2, 256, 4)
    assert table[0, 0].tolist() == table[0, 4].tolist() == [*RED, 0.5]
    assert table[1, 0].tolist() == [0.25, *RED]
    assert (table[0, 5:] == [0, 0, 0, 1]).all()
    assert (table[1, 5:] == 0).all()


def test_blocks_are_marked_that_have_something_edited() -> None:
    classes = voxels.class_looks(META, [entry(7, RED), entry(9, BLUE)])
    hidden = {"opacity": 0.0, "tint": 0.0, "color": GREEN}

    def marked(looks: list) -> list:
        return voxels.marks(looks, TOLD)[:3].tolist()

    assert marked(voxels.thing_looks(classes, TOLD, {})) == [0, 0, 0]
    assert marked(voxels.thing_looks(classes, TOLD, {"cup": hidden})) == [0, 1, 0]
    assert marked(voxels.thing_looks(classes, TOLD, {"cup": hidden, "plate": hidden})) == [0, 1, 1]
    assert marked(voxels.alone(classes, TOLD, "cup", None)) == [1, 1, 1], "also where there is only what is hidden"
    assert voxels.marks(classes, None).min() == 1, "nothing is known of the blocks"
    assert len(voxels.marks(classes, None)) == voxels.MARKS[0] * voxels.MARKS[1] >= 28**3


class Engine:
    """An engine of frames that answers when it is told to."""

    def __init__(self, folder: Path) -> None:
        self.place, self.process, self.busy = folder, object(), False
        self.asked: list = []

    def folder(self) -> Path:
        return self.place

    def pump(self) -> None:
        pass

    def ask(self, method, params, ended) -> bool:
        if not self.busy:
            self.asked.append((method, params, ended))
        return not self.busy

    def answer(self) -> None:
        _, params, ended = self.asked[-1]
        np.savez(params["file"], texels=np.zeros((9, 9, 9, 4), np.uint8), marks=MARKS)
        ended({"names": ["cup"], "of_class": [0], "cubes": [np.eye(4).tolist()]}, None)


@pytest.fixture
def engine(tmp_path, monkeypatch):
    from fieldwork.addon.live import engine as module

    made = Engine(tmp_path)
    monkeypatch.setattr(module, "frames", lambda: made)
    monkeypatch.setattr(thing_texels, "answers", thing_texels.Answers())
    monkeypatch.setattr(thing_texels, "redraw_views", lambda: None)
    yield made
    thing_texels.unregister()


def known(project: Path, key: int = 1) -> thing_texels.Answer:
    found = voxels.Baked(project / "voxels", {}, (str(project / "voxels"), key))
    return thing_texels.answers.of(found, project, "main")


def mesh(project: Path) -> None:
    (project / "exports" / "main").mkdir(parents=True)
    (project / "exports" / "main" / "mesh.npz").write_bytes(b"")


def test_things_are_asked_for_once_for_each_bake_and_mesh(engine, tmp_path):
    first = known(tmp_path)
    assert first.waits
    engine.busy = True  # a frame is rendered
    assert thing_texels.attend() == thing_texels.PERIOD
    assert engine.asked == []
    engine.busy = False
    for _ in range(3):
        thing_texels.attend()
    assert [asked[0] for asked in engine.asked] == ["field_things"]
    engine.answer()
    assert thing_texels.attend() is None, "the timer ends"
    assert first.told is not None
    assert first.told.names == ["cup"]
    assert not list(tmp_path.glob("*.npz")), "the file is gone"
    assert known(tmp_path) is first
    mesh(tmp_path)
    again = known(tmp_path)
    assert again.waits
    assert again.told is first.told, "what was told is shown until there is something newer"
    assert known(tmp_path, key=2).told is None, "of an earlier bake it is of no use"


def test_an_engine_that_ends_before_it_answers_is_asked_again(engine, tmp_path):
    known(tmp_path)
    thing_texels.attend()
    engine.process = object()
    thing_texels.attend()
    assert len(engine.asked) == 2
    engine.answer()
    thing_texels.attend()
    assert known(tmp_path).told is not None


def test_what_went_wrong_is_told_and_tried_again_later(engine, tmp_path, monkeypatch):
    first = known(tmp_path)
    thing_texels.attend()
    engine.asked[-1][2](None, EngineError("project", "There is no mesh yet."))
    assert thing_texels.attend() is None
    assert "no mesh" in first.error
    assert known(tmp_path) is first
    monkeypatch.setattr(thing_texels, "RETRY", 0.0)
    assert known(tmp_path) is not first
