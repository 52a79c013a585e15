"""When the environment may be behind the sky alone: only where it takes what is near."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import pytest
import torch
from fieldwork.nerfcore.data.pixels import Batch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import read_events
from fieldwork.nerfcore.render.run import read_checkpoint
from fieldwork.nerfcore.train.checkpoint import restore, save_checkpoint, trainer_tensors
from fieldwork.nerfcore.train.initial_state import InitialState
from fieldwork.nerfcore.train.sky_stage import PART, STEPS, TAKEN, SkyStage
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL
from fieldwork.tests.nerfcore.support.bowl import bowl_project, stone
from fieldwork.tests.nerfcore.support.sky import environment_trainer

UNTIL = 0.3


class Notes(Reporter):
    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)


@pytest.fixture(scope="module")
def court(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bowl_project(tmp_path_factory.mktemp("court") / "p", side=96, colors=stone)


@pytest.fixture
def stage(court: Path) -> tuple[SkyStage, Batch, torch.Tensor]:
    """A stage, a batch that shows the court and its sky, and which of its rays are near."""
    trainer = environment_trainer(court)
    assert trainer.sky is not None
    batch = trainer.store.batch(torch.arange(0, len(trainer.store), 7))
    near = ~trainer.sky.masks.at(batch.image, batch.pixel)
    assert 0.2 < float(near.float().mean()) < 0.9
    return SkyStage(trainer.sky.masks, UNTIL), batch, near


@pytest.mark.parametrize("taken", [0.0, TAKEN - 0.01, TAKEN + 0.01, 1.0])
def test_what_the_environment_has_of_what_is_near_decides(
    stage: tuple[SkyStage, Batch, torch.Tensor], taken: float
) -> None:
    watched, batch, near = stage
    weight = torch.where(near, taken, 1.0)  # the sky does not count
    for step in range(STEPS):
        watched.decide(step, 0.01)
        assert watched.needed is None
        assert watched.limited(batch, 0.01) is batch
        watched.observe(batch, weight)
    watched.decide(STEPS, 0.01)
    assert watched.needed == (taken > TAKEN)
    watched.observe(batch, 1 - weight)
    watched.decide(STEPS + 1, 0.02)
    assert watched.needed == (taken > TAKEN)
    limited = watched.limited(batch, 0.02)
    assert (limited.sky is not None) == (taken > TAKEN)
    if limited.sky is not None:
        assert torch.equal(limited.sky, ~near)
    assert not watched.masked(UNTIL)


def test_with_too_few_steps_to_tell_masks_are_needed(stage: tuple[SkyStage, Batch, torch.Tensor]) -> None:
    watched, batch, _ = stage
    for step in range(10):
        watched.decide(step, step / 10 * PART * UNTIL)
        assert watched.needed is None
        watched.observe(batch, torch.zeros(len(batch.rgb)))
    watched.decide(10, PART * UNTIL)
    assert watched.needed


def test_rays_of_nothing_near_tell_nothing(stage: tuple[SkyStage, Batch, torch.Tensor]) -> None:
    watched, batch, near = stage
    first = int((~near).nonzero()[0])
    watched.observe(batch.part(slice(first, first + 1)), torch.ones(1))
    assert float(watched.share) == 1.0


def test_a_step_whose_weights_are_not_numbers_tells_nothing(stage: tuple[SkyStage, Batch, torch.Tensor]) -> None:
    watched, batch, _ = stage
    watched.observe(batch, torch.full((len(batch.rgb),), torch.nan))
    assert float(watched.share) == 1.0


@pytest.mark.setting("train.environment_start")
def test_training_is_masked_until_the_stage_ends(court: Path) -> None:
    trainer = environment_trainer(court, train__environment_start="0.5")
    assert trainer.sky is not None
    trainer.sky.needed = True
    early, late = (trainer._learn(progress).batch for progress in (0.49, 0.5))
    assert early.sky is not None
    assert torch.equal(early.sky, trainer.sky.masks.at(early.image, early.pixel))
    assert late.sky is None
    assert environment_trainer(court, scene__background="random").sky is None
    assert environment_trainer(court, train__environment_start="0").sky is None


def test_what_was_seen_and_decided_is_kept_with_the_training(court: Path, tmp_path: Path) -> None:
    trainer = environment_trainer(court)
    assert trainer.sky is not None
    for _ in range(3):
        trainer.step(0.001)
    assert 0 < float(trainer.sky.share) < 1
    for needed in (None, False, True):
        trainer.sky.needed = needed
        save_checkpoint(tmp_path / "c", trainer, {})
        tensors, state = read_checkpoint(tmp_path / "c", torch.device("cpu"))
        again = environment_trainer(court)
        restore(again, tensors, state)
        assert again.sky is not None
        assert torch.equal(again.sky.share, trainer.sky.share)
        assert again.sky.needed is needed
    del tensors["sky_share"], state["sky_masks"]  # as in older files, whose training was masked
    older = environment_trainer(court)
    restore(older, tensors, state)
    assert older.sky is not None
    assert older.sky.needed


@pytest.mark.slow
def test_training_that_begins_anew_is_as_if_it_had_never_begun(court: Path) -> None:
    """To the last bit, although the grids, optimisers and random numbers went on for some steps."""
    fresh, used = (environment_trainer(court, train__refine_poses="true", train__pose_start="0") for _ in range(2))
    initial = InitialState(used)
    for step in range(20):
        used.step(step / 200)
    again = initial.restarted(used)
    for trainer in (fresh, again):
        assert trainer.sky is not None
        trainer.sky.needed = True
    assert fresh.sky is not None
    fresh.sky.share.copy_(used.sky.share)  # type: ignore[union-attr]
    for step in range(40):
        for trainer in (fresh, again):
            trainer.step(step / 200)
    expected, tensors = trainer_tensors(fresh), trainer_tensors(again)
    assert expected.keys() == tensors.keys()
    for name, value in expected.items():
        torch.testing.assert_close(tensors[name], value, rtol=0, atol=0, msg=name)
    assert (again.steps, again.rays) == (fresh.steps, fresh.rays)


@pytest.mark.parametrize("taken", [0.0, 1.0])
def test_train_begins_anew_where_masks_are_needed(court: Path, taken: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then it has as many steps with masks as were asked for, and its curve is theirs."""
    masked: list[bool] = []
    learn = Trainer._learn

    def watched(trainer: Trainer, *arguments: Any) -> Any:
        learned = learn(trainer, *arguments)
        masked.append(learned.batch.sky is not None)
        return learned

    def told(sky: SkyStage, batch: Batch, weight: torch.Tensor) -> None:
        sky.share.fill_(taken)

    trainers: list[weakref.ref[Trainer]] = []
    begin = Trainer.__init__

    def begun(trainer: Trainer, *arguments: Any) -> None:
        begin(trainer, *arguments)
        trainers.append(weakref.ref(trainer))

    alive: list[int] = []

    def counted(trainer: Trainer, progress: float) -> None:
        step(trainer, progress)
        alive.append(sum(each() is not None for each in trainers))

    step = Trainer.step
    monkeypatch.setattr(Trainer, "__init__", begun)
    monkeypatch.setattr(Trainer, "step", counted)
    monkeypatch.setattr(Trainer, "_learn", watched)
    monkeypatch.setattr(SkyStage, "observe", told)
    settings = {**SMALL, "scene.background": "environment"}
    report = Notes()
    result = train(TrainParams(project=court, preset="draft", steps=30, set=settings, run=f"t{taken:.0f}"), report)
    assert result["steps"] == 30
    curve = read_events(court / "runs" / f"t{taken:.0f}")
    steps = [row["step"] for row in curve]
    assert steps == sorted(steps)
    assert steps[-1] == 30
    first = 4  # steps until a third of the first 0.3
    assert masked == [False] * first + [True] * 9 + [False] * 21 if taken else [False] * 30
    assert len(report.notes) == (1 if taken else 0)
    assert len(trainers) == (2 if taken else 1)
    assert set(alive) == {1}, "the trainer that began first is let go of"


@pytest.mark.slow
def test_training_stopped_before_it_was_decided_begins_anew_where_it_goes_on(
    court: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report, masked = Notes(), []

    def told(sky: SkyStage, batch: Batch, weight: torch.Tensor) -> None:
        sky.share.fill_(1.0)
        masked.append(batch.sky is not None)
        if len(masked) == 2:
            report.cancel()

    monkeypatch.setattr(SkyStage, "observe", told)
    params = TrainParams(
        project=court, preset="draft", steps=30, set={**SMALL, "scene.background": "environment"}, run="stopped"
    )
    with pytest.raises(Cancelled):
        train(params, report)
    report = Notes()
    result = train(params.model_copy(update={"resume": True}), report)
    assert masked == [False] * 4 + [True] * 9 + [False] * 21
    assert len(report.notes) == 1
    assert result["steps"] == 30
    again = Notes()
    train(params.model_copy(update={"resume": True, "steps": 40}), again)
    assert len(masked) == 34 + 10
    assert not again.notes
