"""Pictures of a field for viewports while it is trained."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.film import training_view
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project import live
from fieldwork.nerfcore.render.unfinished import Unfinished
from fieldwork.nerfcore.verbs import run_verb
from safetensors.torch import load_file

from .support.ball import SMALL, ball_project, pattern
from .support.viewing import Viewer, perspective

FRONT = perspective((0, -1.2, 0))


class Watched(Reporter):
    """Trains with somebody who looks: `act` is called after each step, with its number."""

    def __init__(self, act: Callable[[int], None]) -> None:
        super().__init__()
        self.act, self.steps = act, 0

    @contextmanager
    def watching(self, training: Unfinished) -> Iterator[Callable[[], None]]:
        with training_view.watched(training, self.check) as show:

            def step() -> None:
                show()
                self.steps += 1
                self.act(self.steps)

            yield step


def train(project: Path, act: Callable[[int], None], steps: int, run: str = "main") -> Watched:
    report = Watched(act)
    run_verb("train", TrainParams(project=project, run=run, preset="draft", steps=steps, set=SMALL), report)
    return report


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures come with every step, whatever they take."""
    monkeypatch.setattr(training_view, "SHARE", 1.0)
    monkeypatch.setattr(training_view, "MOVING_SHARE", 1.0)
    monkeypatch.setattr(training_view, "FIRST", 0.0)
    monkeypatch.setattr(training_view, "LONGEST", 1e9)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return ball_project(tmp_path / "ball", views=24)


@pytest.mark.slow
@pytest.mark.usefixtures("eager")
def test_pictures_become_finer_and_converge_to_the_photos(project, tmp_path):
    viewer, found, running = Viewer(project, tmp_path, side=32), [], []

    def act(step: int) -> None:
        running.append(live.training_run(project))
        if step == 1:
            viewer.ask(FRONT)
        if (picture := viewer.look()) is not None:
            found.append((step, *picture))

    train(project, act, 130)
    assert set(running) == {"main"}
    assert live.training_run(project) is None, "it is over"
    sizes = [color.shape[0] for _, _, color, _ in found]
    assert sizes[0] == 16, "the first picture is coarse"
    assert sizes == sorted(sizes)
    assert sizes[-1] == viewer.side
    assert found[0][0] == 2, "it comes with the next step"
    errors = []
    place = (np.arange(32) + 0.5) / 16 - 1
    x, z = np.meshgrid(place, place)
    # Rays from (0, −1.2, 0) through (x, 1, z) meet the ball of radius 0.5.
    a, b, c = x**2 + z**2 + 1, -2 * 1.2, 1.2**2 - 0.25
    root = np.sqrt(np.maximum(b * b - 4 * a * c, 0))
    t = (-b - root) / (2 * a)
    point = np.stack([x * t, t - 1.2, z * t], -1)
    inside = np.hypot(x, z) < 0.35
    truth = pattern(point)
    for _, number, color, _ in found:
        assert number == 1
        if len(color) == 32:
            errors.append(np.abs(color[inside][:, :3] - truth[inside]).mean())
    assert errors[-1] < 0.75 * errors[0], "one sees it converge"
    _, _, color, depth = found[-1]
    beside = np.hypot(x, z) > 0.6
    assert (color[beside][:, 3] < 0.05).mean() > 0.9
    clip = np.stack([x, z, 2 * depth - 1, np.ones_like(x)], -1) @ np.linalg.inv(FRONT).T
    met = clip[..., :3] / clip[..., 3:]
    assert np.abs(np.linalg.norm(met[inside], axis=-1) - 0.5).mean() < 0.1, "depth is that of the ball"


@pytest.mark.usefixtures("eager")
def test_a_view_that_moves_begins_anew_and_follows_the_class_panel(project, tmp_path):
    viewer, found = Viewer(project, tmp_path, side=32), {}

    def act(step: int) -> None:
        if step == 100:
            viewer.ask(FRONT)
        if step == 104:
            viewer.ask(FRONT, classes={1: {"opacity": 0.0}, 2: {"tint": 1.0, "color": (0, 1, 0)}})
        if step == 108:
            viewer.ask(perspective((0, 1.2, 0)))  # looks away from it
        if (picture := viewer.look()) is not None:
            found.setdefault(picture[0], []).append(picture[1])

    train(project, act, 112)
    assert sorted(found) == [1, 2, 3]
    for pictures in found.values():
        assert len(pictures[0]) == 16
        assert len(pictures[-1]) == 32
    plain, edited, away = (found[number][-1] for number in (1, 2, 3))
    above, below = (slice(18, 21), slice(13, 19)), (slice(11, 14), slice(13, 19))
    assert plain[above][..., 3].mean() > 0.9
    assert edited[below][..., :3].mean((0, 1)) == pytest.approx([0, 1, 0], abs=0.25), "the lower class is tinted"
    assert edited[above][..., 0].mean() < 0.5 * plain[above][..., 0].mean(), "the upper class is hidden"
    assert away[..., 3].max() < 0.3


def test_watching_does_not_change_what_is_learnt(project, tmp_path):
    viewer = Viewer(project, tmp_path)
    pictures = []

    def act(step: int) -> None:
        if step == 3:
            viewer.ask(FRONT)
        pictures.extend([step] if viewer.look() is not None else [])

    train(project, act, 30, "main")
    train(project, lambda step: None, 30, "alone")
    assert pictures
    one, other = (load_file(project / "runs" / run / "field.safetensors") for run in ("main", "alone"))
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


@pytest.mark.usefixtures("eager")
def test_nobody_looks_any_more(project, tmp_path):
    """A watcher that died, one that is gone with its files, one that asks for nonsense, and one that looks at another run."""
    viewer, seen = Viewer(project, tmp_path), []
    requests = live.views_file(project)

    def act(step: int) -> None:
        if step == 2:
            viewer.ask(FRONT)
        if step == 6:
            past = time.time() - 2 * live.STALE
            os.utime(requests, (past, past))
        if step == 10:
            viewer.ask(FRONT)
        if step == 14:
            viewer.file.unlink()
            viewer.ask(FRONT)
        if step == 18:
            live.write(requests, {"views": [{"number": 1}]})
        if step == 22:
            Viewer(project, tmp_path, run="other").ask(FRONT)
        if viewer.look() is not None:
            seen.append(step)

    train(project, act, 26)
    assert set(seen) <= {3, 4, 5, 6, 11, 12, 13, 14}
    assert {3, 11} <= set(seen)
    assert not live.training_file(project).exists()


@pytest.mark.slow
def test_pictures_take_a_small_part_of_the_time(project, tmp_path, monkeypatch):
    """By the clock of the pictures themselves: what a picture takes is waited for many times over before the next."""
    viewer, spent = Viewer(project, tmp_path, side=400), []
    plain = training_view.view_picture

    def timed(*arguments):
        begin = time.perf_counter()
        try:
            return plain(*arguments)
        finally:
            spent.append((begin, time.perf_counter()))

    monkeypatch.setattr(training_view, "view_picture", timed)
    train(project, lambda step: viewer.ask(FRONT) if step == 1 else None, 100)
    assert len(spent) >= 2
    for (begin, end), (following, _) in zip(spent, spent[1:]):
        taken = min(end - begin, training_view.LONGEST)
        assert following - end >= (1 / training_view.SHARE - 1.05) * taken


class Making(NamedTuple):
    """A picture: the number of its request, when it was made by the clock of the test, and its width."""

    number: int
    begin: float
    end: float
    width: int


def clocked(
    monkeypatch: pytest.MonkeyPatch, seconds: Callable[[int, list[Making]], float]
) -> tuple[list[float], list[Making]]:
    """A clock [now] that stands still but for pictures, which take `seconds` (of the request's number and the pictures before),
    and the pictures that are made."""
    makings, clock, make = [], [0.0], training_view.view_picture

    def slow(field, request, width, height, check):
        begin, made = clock[0], make(field, request, width, height, check)
        clock[0] += seconds(request.number, makings)
        makings.append(Making(request.number, begin, clock[0], width))
        return made

    class Clock:
        time = staticmethod(time.time)
        perf_counter = staticmethod(lambda: clock[0])

    monkeypatch.setattr(training_view, "view_picture", slow)
    monkeypatch.setattr(training_view, "time", Clock)
    return clock, makings


@pytest.mark.slow
def test_a_picture_in_a_busy_moment_does_not_keep_the_next_away_for_long(project, tmp_path, monkeypatch):
    """What took twenty seconds is not waited for eleven times over."""
    viewer = Viewer(project, tmp_path, side=64)
    clock, makings = clocked(monkeypatch, lambda _, before: 0.01 if before else 20.0)

    def act(step: int) -> None:
        clock[0] += 0.2
        if step == 1:
            viewer.ask(FRONT)

    train(project, act, 60)
    longest = training_view.LONGEST * (1 / training_view.SHARE - 1)
    assert makings[1].begin - makings[0].end <= longest + 0.21
    assert makings[-1].width > makings[0].width, "the pictures become finer again"


@pytest.mark.slow
@pytest.mark.usefixtures("eager")
def test_a_view_that_moves_does_not_wait_for_the_fine_picture_before(project, tmp_path, monkeypatch):
    """A picture that took three seconds keeps finer ones away for long, but not the first one of another view."""
    viewer = Viewer(project, tmp_path)
    clock, makings = clocked(monkeypatch, lambda number, before: 0.01 if number == 1 and not before else 3.0)

    def act(step: int) -> None:
        clock[0] += 0.05
        if step == 1:
            viewer.ask(FRONT)
        if len(makings) == 2 and viewer.number == 1:
            viewer.ask(perspective((0.05, -1.2, 0)))

    train(project, act, 60)
    assert [making.number for making in makings[:3]] == [1, 1, 2]
    wait = makings[2].begin - makings[1].end
    assert wait <= training_view.FIRST * (1 / training_view.MOVING_SHARE - 1) + 0.11


def test_cancelling_in_a_picture_leaves_a_checkpoint(project, tmp_path, monkeypatch):
    viewer, report = Viewer(project, tmp_path), None
    plain = training_view.view_picture

    def cancelled(*arguments):
        report.cancel()
        return plain(*arguments)

    monkeypatch.setattr(training_view, "view_picture", cancelled)
    report = Watched(lambda step: viewer.ask(FRONT) if step == 5 else None)
    with pytest.raises(Cancelled):
        run_verb("train", TrainParams(project=project, preset="draft", steps=50, set=SMALL), report)
    assert report.steps == 5
    assert (project / "runs/main/field.safetensors").is_file()
    assert live.training_run(project) is None
