"""The engine’s requests for frames, and the file that they come through."""

from __future__ import annotations

import queue
import struct
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.engine import protocol as rpc
from fieldwork.nerfcore.engine.frames import Frames
from fieldwork.nerfcore.errors import Cancelled, InputError, ProjectError
from fieldwork.nerfcore.film import exposure, fields
from fieldwork.nerfcore.film.exposure import expose
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.film.shared_file import HEADER, SharedFile
from fieldwork.nerfcore.film.shot import Shot
from fieldwork.nerfcore.progress import Reporter
from pydantic import ValidationError

from .support.film import H, W, ball, lens, store, take, taken

__all__ = ["ball", "store"]


def test_shots_that_make_no_sense_are_refused(ball: Path) -> None:
    field = {"name": "Ball", "project": ball, "scene_from_capture": np.eye(4).tolist()}
    good = {"lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": ["Combined"], "file": "none"}
    Shot.model_validate(good)
    for wrong in (
        {"border": (0, 0, W + 1, H)},
        {"border": (5, 0, 5, H)},
        {"passes": ["Colour"]},
        {"passes": []},
        {"samples": 0},
        {"fields": []},
        {"lens": lens(poses=[])},
    ):
        with pytest.raises(ValidationError):
            Shot.model_validate({**good, **wrong})


def test_a_field_that_is_scaled_to_nothing_is_named(ball: Path, store: FieldStore) -> None:
    with pytest.raises(ProjectError, match="Ball"):
        take(ball, store, ["Combined"], {"scene_from_capture": np.diag([0.0, 1, 1, 1]).tolist()})


def test_all_fields_of_a_frame_are_there_for_the_next_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Seen(Exception):
        pass

    def film(*_: Any) -> None:
        raise Seen

    monkeypatch.setattr(exposure, "_Film", film)
    monkeypatch.setattr(exposure, "_placed", lambda shot, item, store, report: store.field(item, report))
    monkeypatch.setattr(fields, "checkpoint_id", lambda *_: "trained")
    monkeypatch.setattr(fields, "load_field", lambda *_: object())
    shown, store = [], FieldStore()
    for number in range(6):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "project.json").touch()
        shown.append({"name": str(number), "project": folder, "scene_from_capture": np.eye(4).tolist()})
    shot = {"lens": lens(), "border": (0, 0, W, H), "fields": shown, "passes": ["Combined"], "file": "none"}
    for _ in range(3):
        with pytest.raises(Seen):
            expose(Shot.model_validate(shot), store, Reporter())
    assert store.loaded == 6


class Answers:
    """What the frames of an engine send."""

    def __init__(self) -> None:
        self.messages: queue.Queue[dict[str, Any]] = queue.Queue()
        self.seen: list[dict[str, Any]] = []
        self.frames = Frames(self.messages.put)

    def ask(self, number: int, **params: Any) -> None:
        self.frames.ask(rpc.Request(number, "frame", params))

    def answer(self, number: int, seconds: float = 120) -> dict[str, Any]:
        end = time.monotonic() + seconds
        while True:
            message = self.messages.get(timeout=end - time.monotonic())
            self.seen.append(message)
            if message.get("id") == number:
                return message


def request(ball: Path, file: Path, name: str, **more: Any) -> dict[str, Any]:
    field = {"name": "Ball", "project": str(ball), "baked": True, "scene_from_capture": np.eye(4).tolist()}
    return {"frame": name, "lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": ["Combined", "Depth"],
            "file": str(file), **more}  # fmt: skip


def shared(folder: Path, floats: int) -> Path:
    path = folder / "pixels"
    path.write_bytes(bytes(HEADER + 4 * floats))
    return path


def test_frames_come_through_the_file_and_load_the_field_once(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 5 * W * H)
    for number in range(100):
        answers.ask(number, **request(ball, file, f"f{number}"))
    results = [answers.answer(number)["result"] for number in range(100)]
    assert {result["loaded"] for result in results} == {1}
    data = file.read_bytes()
    assert struct.unpack("<q", data[:8])[0] == 200, "twice for each frame: begun and done"
    pixels = np.frombuffer(data[HEADER : HEADER + 16 * W * H], np.float32).reshape(H, W, 4)
    expected = taken(ball, FieldStore(), ["Combined"], {"baked": True}).passes["Combined"]
    assert np.allclose(pixels, expected, atol=1e-6)
    assert any(message.get("method") == "progress" for message in answers.seen)


def test_colours_come_sample_by_sample(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 5 * W * H)
    answers.ask(1, **request(ball, file, "one", samples=5))
    assert "result" in answers.answer(1)
    counters = [m["params"]["counter"] for m in answers.seen if m.get("params", {}).get("kind") == "pixels"]
    assert counters == [2, 4, 6, 8]


def test_a_frame_is_cancelled_within_two_seconds(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 5 * W * H)
    slow = request(ball, file, "slow", samples=4096)
    slow["fields"][0]["baked"] = False
    answers.ask(1, **slow)
    answers.ask(2, **request(ball, file, "next"))
    while answers.messages.get(timeout=60).get("params", {}).get("kind") != "pixels":
        pass
    begin = time.monotonic()
    answers.frames.cancel("slow")
    assert answers.answer(1)["error"]["code"] == rpc.CANCELLED
    assert time.monotonic() - begin < 2
    assert "result" in answers.answer(2), "others go on"


def test_wrong_frames_are_answered_with_sentences(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 3)
    answers.ask(1, **request(ball, file, "small"))
    assert "bytes" in answers.answer(1)["error"]["message"]
    answers.ask(2, **request(ball, tmp_path / "none", "lost"))
    assert "none" in answers.answer(2)["error"]["message"]
    file = shared(tmp_path, 5 * W * H)
    answers.ask(3, **request(tmp_path / "nothing", file, "unknown"))
    assert "nothing" in answers.answer(3)["error"]["message"]
    answers.ask(4, **request(ball, file, "wrong", samples=0))
    assert answers.answer(4)["error"]["code"] == rpc.INVALID_PARAMS
    with pytest.raises(rpc.RpcError):
        answers.ask(5, **{**request(ball, file, "wrong"), "frame": ""})


def test_readers_notice_pixels_that_are_being_written(tmp_path: Path) -> None:
    """Ten thousand frames, read while they are written: every picture that the counter says is whole is whole."""
    size = 2000
    path = shared(tmp_path, size)
    file = SharedFile(path, {"Combined": (1, size // 4, 4)})
    done = threading.Event()

    def write() -> None:
        for number in range(10_000):
            file.write({"Combined": np.full((1, size // 4, 4), number, np.float32)})
            if number % 100 == 0:
                time.sleep(1e-4)  # between two frames, so that the reader's thread has its turn there too
        done.set()

    pixels = np.memmap(path, np.uint8, "r")
    counter, values = pixels[:8].view(np.int64), pixels[HEADER:].view(np.float32)
    writer = threading.Thread(target=write)
    writer.start()
    whole, seen = 0, set()
    while not done.is_set():
        before = int(counter[0])
        copy = values.copy()
        if before % 2 == 0 and int(counter[0]) == before:
            assert (copy == copy[0]).all()
            whole += 1
            seen.add(float(copy[0]))
    writer.join()
    assert int(counter[0]) == 20_000
    assert values[0] == 9_999
    assert whole > 0
    with pytest.raises(InputError):
        SharedFile(path, {"Combined": (1, 1, 4)})


def test_cancel_stops_an_exposure(ball: Path, store: FieldStore) -> None:
    report = Reporter()
    report.cancel()
    field = {"name": "Ball", "project": ball, "scene_from_capture": np.eye(4).tolist()}
    shot = {"lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": ["Combined"], "file": "none"}
    with pytest.raises(Cancelled):
        expose(Shot.model_validate(shot), store, report)
