"""Recorded steps: what is replayed is what a step would do, and nothing that the host tells is missed by its key."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.train.replay import Replay, asked_mode
from fieldwork.nerfcore.train.results import Learned
from fieldwork.nerfcore.train.schedule import padded_capacity
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import config_of, trainer_of

STEPS = 40


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("replay") / "ball", views=6, side=24, depth=True)


class AgainRecording:
    """A recording for devices without graphs: the work itself, with what the host told it when it was recorded."""

    def __init__(self, work: Callable[[], Learned]) -> None:
        self.work = work
        self.learned: Learned | None = None

    @property
    def result(self) -> Learned:
        assert self.learned is not None
        return self.learned

    def replay(self) -> None:
        self.learned = self.work()


def static(project: Path, recorded: bool, **settings: str) -> Trainer:
    """A trainer whose steps have a fixed capacity, as on CUDA, and are recorded or not."""
    trainer = trainer_of(project, **settings)
    trainer.model.fixed_capacity = True
    trainer.replay = Replay(AgainRecording)
    if not recorded:
        trainer.replay.run = lambda key, work: work()  # type: ignore[method-assign]
    return trainer


def state(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.detach().float() for name, value in trainer.model.state_dict().items()}


def addresses(trainer: Trainer) -> dict[str, int]:
    """Where in memory is what a step reads and writes and steps have in common."""
    tensors = {**dict(trainer.model.named_parameters()), **dict(trainer.model.named_buffers())}
    guard = trainer.guard
    tensors |= {
        "scale": guard.scale,
        "good": guard.good_steps,
        "rgba": trainer.store.rgba,
        "label": trainer.store.label,
    }
    return {name: tensor.data_ptr() for name, tensor in tensors.items()}


@pytest.mark.parametrize(
    "settings",
    [
        {},
        pytest.param(
            {"loss.depth_weight": "0.1", "loss.distortion_weight": "0.01", "loss.distortion_start": "0.5"},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"field.appearance": "2", "field.precision": "float16", "loss.rgb_warmup": "30"}, marks=pytest.mark.slow
        ),
    ],
    ids=lambda s: " ".join(s) or "default",
)
def test_recorded_steps_are_ordinary_steps(ball: Path, settings: dict[str, str]) -> None:
    found, numbers = [], []
    for recorded in (False, True):
        trainer = static(ball, recorded, **settings)
        for step in range(STEPS):
            trainer.step(0.3 + 0.4 * step / STEPS)
        found.append(state(trainer))
        numbers.append(trainer.take_measured())
        if recorded:
            assert trainer.replay.replayed > STEPS / 4
            assert 0 < trainer.replay.recorded < trainer.replay.replayed
    for name, value in found[0].items():
        assert torch.allclose(found[1][name], value, rtol=1e-4, atol=1e-5 * float(value.abs().max().clamp(min=1))), name
    assert float(numbers[1].mse) == pytest.approx(float(numbers[0].mse), rel=1e-4)
    assert (numbers[1].rays, numbers[1].steps) == (numbers[0].rays, STEPS)


@pytest.mark.slow
def test_nothing_moves_in_memory_while_a_recording_is_used(ball: Path) -> None:
    """A recording reads and writes where it did when it was made."""
    trainer = static(ball, True, **{"field.precision": "float16"})
    for _ in range(20):
        trainer.step(0.5)
    before = addresses(trainer)
    for _ in range(40):
        trainer.step(0.5)
    assert trainer.replay.replayed > 20
    assert addresses(trainer) == before


def test_a_capacity_that_is_outgrown_is_not_replayed(ball: Path) -> None:
    trainer = static(ball, True)
    for _ in range(40):  # the next step is no update of the grid, after which the number of rays may be another one
        trainer.step(0.5)
    small, replayed, recorded = trainer._capacity(0.5, 1), trainer.replay.replayed, trainer.replay.recorded
    assert replayed > 0
    trainer.step(0.95)
    assert trainer._capacity(0.95, 1) > small
    assert trainer.replay.replayed == replayed  # an ordinary step, with the room it needs
    trainer.step(0.95)
    assert trainer.replay.replayed == replayed + 1
    assert trainer.replay.recorded == recorded + 1


def test_capacities_come_in_few_sizes_and_are_enough() -> None:
    sizes = [padded_capacity(wanted, 5e4) for wanted in range(1000, 50000, 100)]
    assert len(set(sizes)) < 30
    assert all(1 <= size / wanted < 1.2 for size, wanted in zip(sizes, range(1000, 50000, 100)))
    assert max(sizes) <= 5e4
    assert padded_capacity(7e4, 5e4) == 7e4


def test_a_recording_that_fails_leaves_ordinary_steps(caplog: pytest.LogCaptureFixture) -> None:
    def broken(work: Callable[[], int]) -> AgainRecording:
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    replay: Replay = Replay(broken)
    with caplog.at_level(logging.WARNING, "fieldwork"):
        assert [replay.run("a", lambda k=k: k) for k in range(4)] == [0, 1, 2, 3]
    assert caplog.text.count("not recorded") == 1
    assert "operation not permitted" in caplog.text
    assert not replay.active
    strict: Replay = Replay(broken, "on")
    assert strict.run("a", lambda: 1) == 1
    with pytest.raises(RuntimeError, match="not permitted"):
        strict.run("a", lambda: 1)


def test_what_has_no_key_is_never_recorded() -> None:
    replay: Replay = Replay(AgainRecording)
    assert [replay.run(None, lambda k=k: k) for k in range(4)] == [0, 1, 2, 3]
    assert replay.recorded == 0
    off: Replay = Replay(AgainRecording, "off")
    assert [off.run("a", lambda k=k: k) for k in range(4)] == [0, 1, 2, 3]
    assert off.recorded == 0


def test_steps_on_the_cpu_are_not_recorded(ball: Path) -> None:
    trainer = trainer_of(ball)
    assert not trainer.replay.active


def test_cameras_that_move_are_not_recorded(ball: Path) -> None:
    trainer = static(ball, True, **{"train.refine_poses": "true", "train.pose_start": "0"})
    for _ in range(8):
        trainer.step(0.5)
    assert trainer.replay.recorded == 0


def test_the_mode_is_one_of_three(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FIELDWORK_GRAPHS", raising=False)
    assert asked_mode() == "auto"
    monkeypatch.setenv("FIELDWORK_GRAPHS", "off")
    assert asked_mode() == "off"
    monkeypatch.setenv("FIELDWORK_GRAPHS", "yes")
    with pytest.raises(SettingError, match="FIELDWORK_GRAPHS"):
        asked_mode()


# So that only the levels' gains change between two steps.
EVEN = {
    "train.batch_samples": "2048",
    "train.max_rays": "64",
    "loss.entropy_start": "0.5",
    "loss.distortion_start": "0.5",
}


def assert_finest_level_fades_in(trainer: Trainer) -> None:
    """It has no part in the first steps, and learns in a step that was recorded among those."""
    grid, replay = trainer.model.field.grid, trainer.replay
    assert grid is not None
    first, rows = grid.levels[-1][1:]
    finest = grid.table[first : first + rows]
    for _ in range(40):
        before = finest.clone()
        for _ in range(5):
            trainer.step(0.02)
        assert torch.equal(finest, before)
        recorded, replayed = replay.recorded, replay.replayed
        trainer.step(0.19)
        if recorded and (replay.recorded, replay.replayed) == (recorded, replayed + 1):
            assert float((finest - before).abs().max()) > 1e-3
            return
    pytest.fail("no step was replayed")


def test_one_recording_is_enough_while_levels_fade_in(ball: Path) -> None:
    assert_finest_level_fades_in(static(ball, True, **EVEN))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")
def test_a_graph_reads_the_gains_of_levels_that_fade_in(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDWORK_GRAPHS", "on")
    info, scene = plan_run(ball, "draft", config_of(**EVEN), torch.device("cuda"))
    assert_finest_level_fades_in(make_trainer(ball, info, scene, torch.device("cuda"), Reporter()))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")
@pytest.mark.parametrize("settings", [{}, {"loss.depth_weight": "0.1"}, {"field.appearance": "2"}], ids=str)
def test_a_graph_learns_what_ordinary_steps_learn(
    ball: Path, settings: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gradients are summed in any order on a GPU, so that trainings drift apart: the first steps are compared closely,
    the last ones by their error."""
    device, errors = torch.device("cuda"), {}
    for mode in ("off", "on"):
        monkeypatch.setenv("FIELDWORK_GRAPHS", mode)
        info, scene = plan_run(ball, "draft", config_of(**settings), device)
        trainer = make_trainer(ball, info, scene, device, Reporter())
        for _ in range(8):
            trainer.step(0.5)
        early = trainer.take_measured()
        for step in range(300):
            trainer.step(0.5 + step / 600)
        trainer.take_measured()
        for _ in range(60):
            trainer.step(1.0)
        errors[mode] = (float(early.mse), trainer.take_measured().psnr)
        assert (trainer.replay.replayed > 100) == (mode == "on")
    assert errors["on"][0] == pytest.approx(errors["off"][0], rel=0.02)
    assert errors["on"][1] == pytest.approx(errors["off"][1], abs=2.0)
