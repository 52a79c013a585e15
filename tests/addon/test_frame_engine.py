"""The link to the engine of frames, without Blender."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from fieldwork.addon.engine.link import Link
from fieldwork.addon.errors import EngineError
from fieldwork.tests.addon.rendered import ball

__all__ = ["ball"]


def shot(project: Path, samples: int, source: bool) -> dict:
    pose = [[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1]]
    lens = {"kind": "perspective", "width": 64, "height": 48, "scale": (80, 80), "center": (32, 24), "clip": (0.1, 10)}
    field = {"name": "Ball", "project": str(project), "baked": source, "scene_from_capture": np.eye(4).tolist()}
    return {"lens": {**lens, "poses": [pose]}, "border": (0, 0, 64, 48), "samples": samples, "fields": [field],
            "passes": ["Combined"]}  # fmt: skip


def test_stopping_a_frame_takes_no_time_and_the_engine_goes_on(ball, tmp_path):
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    frames = FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    sizes, told, shown = Sizes(64, 48, {"Combined": 4}), [], []
    try:
        first = frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: told.append(said))
        assert first.passes["Combined"][24, 32, 3] > 0.9
        process = frames.process
        stopped = []

        def stop() -> bool:
            if len(shown) > 2 and not stopped:
                stopped.append(time.monotonic())
            return bool(stopped)

        with pytest.raises(EngineError) as caught:
            frames.render(shot(ball, 4096, False), sizes, stop, lambda *said: told.append(said), shown.append)
        assert caught.value.kind == "cancelled"
        assert time.monotonic() - stopped[0] < 0.5
        assert shown[0].shape == (48, 64, 4)
        begin = time.monotonic()
        frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: None)
        assert time.monotonic() - begin < 2, "the stopped frame is given up"
        assert frames.process is process
        assert any(stage == "Rendering" and share > 0 for stage, share in told)
        assert list(frames.folder().iterdir()) == []
    finally:
        folder = frames.folder()
        frames.close()
    assert not folder.exists()
    assert process.poll() is not None


def test_an_engine_that_does_not_give_up_a_frame_is_ended(ball, tmp_path):
    from fieldwork.addon.live import frames as module

    frames = module.FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    sizes = module.Sizes(64, 48, {"Combined": 4})
    try:
        frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: None)
        process = frames.process
        os.kill(process.pid, signal.SIGSTOP)  # as if a native call did not come back
        end = time.monotonic() + 0.5
        with pytest.raises(EngineError):
            frames.render(shot(ball, 1, True), sizes, lambda: time.monotonic() > end, lambda *said: None)
        frames._left = dict.fromkeys(frames._left, time.monotonic() - module.PATIENCE - 1)
        again = frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: None)
        assert again.passes["Combined"][24, 32, 3] > 0.9
        assert frames.process is not process
        assert process.wait(5) == -signal.SIGKILL
    finally:
        frames.close()


def test_a_frame_whose_engine_is_stopped_fails_instead_of_waiting(tmp_path):
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    silent = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    frames, failed, stop = FrameEngine(lambda: Link(sys.executable, tmp_path / "log", silent)), [], threading.Event()

    def render() -> None:
        try:
            frames.render({}, Sizes(8, 8, {"Combined": 4}), stop.is_set, lambda *said: None)
        except EngineError as error:
            failed.append(error.kind)

    thread = threading.Thread(target=render)
    thread.start()
    try:
        while frames.process is None:
            time.sleep(0.01)
        time.sleep(0.2)  # it is waited for by now
        frames.rest()
        thread.join(5)
        assert failed == ["stopped"]
    finally:
        stop.set()
        thread.join(5)
        frames.close()


def test_what_the_engine_says_of_a_frame_that_was_cancelled_is_not_passed_on(ball, tmp_path):
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    frames = FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    sizes, said = Sizes(64, 48, {"Combined": 4}), []
    try:
        frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *_: None)
        os.kill(frames.process.pid, signal.SIGSTOP)
        with pytest.raises(EngineError):
            frames.render(shot(ball, 1, True), sizes, lambda: True, lambda *told: said.append(told), said.append)
        (name,) = frames._left
        for kind in ("progress", "event"):
            frames._link._messages.put({"method": kind, "params": {"job": name, "stage": "Rendering", "fraction": 0.5}})
        frames.pump()
        assert frames._link._messages.empty()
        assert said == []
        os.kill(frames.process.pid, signal.SIGCONT)
    finally:
        frames.close()


def test_frames_of_several_threads_wait_for_each_other(ball, tmp_path):
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    frames = FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    found: list = []

    def one() -> None:
        frame = frames.render(shot(ball, 2, True), Sizes(64, 48, {"Combined": 4}), lambda: False, lambda *said: None)
        found.append(frame.passes["Combined"][24, 32, 3])

    threads = [threading.Thread(target=one) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    frames.close()
    assert len(found) == 4
    assert min(found) > 0.9


def test_what_is_asked_beside_frames_is_answered_by_pumping_and_by_frames(ball, tmp_path):
    """The viewport asks without waiting; while a frame is rendered it asks again later."""
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    frames = FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    outcomes: list = []
    params = {"project": str(ball), "run": "main", "file": str(tmp_path / "told.npz")}

    def ended(*outcome) -> None:
        outcomes.append(outcome)

    try:
        assert frames.ask("field_things", params, ended)
        end = time.monotonic() + 120
        while not outcomes and time.monotonic() < end:
            frames.pump()
            time.sleep(0.05)
        assert "no mesh yet" in str(outcomes[0][1]), "the ball has no mesh"
        asked = []

        def stop() -> bool:
            asked.append(frames.ask("field_things", params, ended))
            return False

        sizes = Sizes(64, 48, {"Combined": 4})
        assert frames.ask("field_things", params, ended)
        frames.render(shot(ball, 1, True), sizes, stop, lambda *said: None)
        assert len(outcomes) == 2, "the frame's wait hands the answer out"
        assert asked
        assert not any(asked)
    finally:
        frames.close()
