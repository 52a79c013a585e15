"""When the environment may be behind the sky alone: only where it takes what is near."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fieldwork.nerfcore.data.pixels import Batch
from fieldwork.nerfcore.render.run import read_checkpoint
from fieldwork.nerfcore.train.checkpoint import restore, save_checkpoint
from fieldwork.nerfcore.train.sky_stage import PART, STEPS, TAKEN, SkyStage
from fieldwork.tests.nerfcore.support.bowl import bowl_project, stone
from fieldwork.tests.nerfcore.support.sky import environment_trainer

UNTIL = 0.3


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
        assert watched.limited(batch, step, 0.01) is batch
        watched.observe(batch, weight, step, 0.01)
    assert watched.masked(STEPS, 0.01) == (taken > TAKEN)
    watched.observe(batch, 1 - weight, STEPS, 0.02)
    assert watched.masked(STEPS + 1, 0.02) == (taken > TAKEN)
    limited = watched.limited(batch, STEPS, 0.02)
    assert (limited.sky is not None) == (taken > TAKEN)
    if limited.sky is not None:
        assert torch.equal(limited.sky, ~near)
    assert not watched.masked(STEPS, UNTIL)


def test_with_too_few_steps_to_tell_masks_are_needed(stage: tuple[SkyStage, Batch, torch.Tensor]) -> None:
    watched, batch, _ = stage
    for step in range(10):
        progress = step / 10 * PART * UNTIL
        assert not watched.masked(step, progress)
        watched.observe(batch, torch.zeros(len(batch.rgb)), step, progress)
    assert watched.masked(10, PART * UNTIL)


def test_rays_of_nothing_near_tell_nothing(stage: tuple[SkyStage, Batch, torch.Tensor]) -> None:
    watched, batch, near = stage
    first = int((~near).nonzero()[0])
    watched.observe(batch.part(slice(first, first + 1)), torch.ones(1), 0, 0.0)
    assert float(watched.share) == 1.0


@pytest.mark.setting("train.environment_start")
def test_training_is_masked_until_the_stage_ends(court: Path) -> None:
    trainer = environment_trainer(court, train__environment_start="0.5")
    assert trainer.sky is not None
    trainer.steps = STEPS
    early, late = (trainer._learn(progress).batch for progress in (0.49, 0.5))
    assert early.sky is not None
    assert torch.equal(early.sky, trainer.sky.masks.at(early.image, early.pixel))
    assert late.sky is None
    assert environment_trainer(court, scene__background="random").sky is None
    assert environment_trainer(court, train__environment_start="0").sky is None


def test_what_was_seen_is_kept_with_the_training(court: Path, tmp_path: Path) -> None:
    trainer = environment_trainer(court)
    assert trainer.sky is not None
    for _ in range(3):
        trainer.step(0.001)
    assert 0 < float(trainer.sky.share) < 1
    save_checkpoint(tmp_path / "c", trainer, {})
    tensors, state = read_checkpoint(tmp_path / "c", torch.device("cpu"))
    again = environment_trainer(court)
    restore(again, tensors, state)
    assert again.sky is not None
    assert torch.equal(again.sky.share, trainer.sky.share)
    del tensors["sky_share"]  # as in older files, whose training was masked
    older = environment_trainer(court)
    restore(older, tensors, state)
    assert older.sky is not None
    assert older.sky.masked(STEPS, 0.1)
