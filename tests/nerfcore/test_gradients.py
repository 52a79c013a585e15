"""Gradients that are not finite or would vanish in half precision."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from fieldwork.nerfcore.errors import TrainingError
from fieldwork.nerfcore.kernels.device import Kernels, using_kernels
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import read_events
from fieldwork.nerfcore.train.checkpoint import restore, trainer_tensors
from fieldwork.nerfcore.train.composite_loss import composite_loss
from fieldwork.nerfcore.train.gradients import FIRST_SCALE, GROWTH_STEPS, GradientGuard
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.settings import trainer_of

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("gradients") / "ball", views=6, side=24)


def test_the_scale_halves_after_an_overflow_and_grows_again() -> None:
    guard = GradientGuard(torch.float16, CPU)
    for _ in range(3):
        guard.finite = guard.inspected([torch.ones(3), torch.tensor([1.0, math.inf])])
        guard.update()
    assert float(guard.scale) == FIRST_SCALE / 8
    assert int(guard.skipped) == 3
    for _ in range(GROWTH_STEPS):
        guard.finite = guard.inspected([torch.ones(3)])
        guard.update()
    assert float(guard.scale) == FIRST_SCALE / 4
    other = GradientGuard(torch.bfloat16, CPU)
    other.finite = other.inspected([torch.tensor([math.nan])])
    other.update()
    assert float(other.scale) == 1.0


def test_the_scale_of_a_resumed_training_grows_when_it_would_have(ball: Path) -> None:
    trainer, resumed = (trainer_of(ball, **{"field.precision": "float16"}) for _ in range(2))
    for _ in range(GROWTH_STEPS - 1):
        trainer.guard.update()
    kept = {name: value.clone() for name, value in trainer_tensors(trainer).items()}
    restore(resumed, kept, {"steps": GROWTH_STEPS - 1, "rays": trainer.rays})
    for each in (trainer, resumed):
        each.guard.update()
        assert float(each.guard.scale) == 2 * FIRST_SCALE


@pytest.mark.parametrize("kernels", ["warp", "torch"])
def test_a_step_without_finite_gradients_changes_nothing(kernels: Kernels) -> None:
    parameter = torch.nn.Parameter(torch.ones(4))
    with using_kernels(kernels):
        guard = GradientGuard(torch.float32, CPU)
    optimizer = torch.optim.Adam([parameter], 0.1, fused=True)
    for value, moved in ((1.0, True), (math.nan, False), (math.inf, False), (1.0, True)):
        before = parameter.detach().clone()
        parameter.grad = torch.full((4,), value)
        guard.finite = guard.inspected([parameter.grad])
        guard.step(optimizer)
        assert bool((parameter != before).all()) == moved
        assert bool(torch.isfinite(parameter).all())


def many_steps(trainer: Trainer) -> None:
    for _ in range(200):
        trainer.step(0.3)


def parameters(trainer: Trainer) -> torch.Tensor:
    return torch.cat([p.detach().flatten().clone() for p in trainer.model.parameters()])


def test_small_gradients_survive_half_precision(ball: Path) -> None:
    """Losses so small that their gradients are below the smallest float16."""
    weights = {"loss.rgb_weight": "1e-6", "loss.semantic_weight": "0", "loss.regularization": "0"}
    found, of_grid = {}, {}
    for precision in ("float32", "float16"):
        trainer = trainer_of(ball, **weights, **{"field.precision": precision})
        for step in range(3):
            trainer.step(step / 3)
        trainer._take(trainer._learn(0.5))
        found[precision] = trainer.model.field.color_head.weights[0].grad.abs()
        of_grid[precision] = float(trainer.model.field.grid.gradient.abs().mean())
    assert int((found["float16"] > 0).sum()) > 0.9 * int((found["float32"] > 0).sum())
    assert float(found["float16"].mean()) == pytest.approx(float(found["float32"].mean()), rel=0.3)
    assert of_grid["float16"] == pytest.approx(of_grid["float32"], rel=0.3)


def test_gradients_of_cameras_are_those_of_the_loss_itself(ball: Path) -> None:
    sizes = {}
    for precision in ("float32", "float16"):
        trainer = trainer_of(ball, **{"field.precision": precision, "train.refine_poses": "true"})
        for step in range(3):
            trainer.step(step / 300)
        assert trainer.poses is not None
        parts = trainer._learn(0.5, trainer.poses).shards
        sizes[precision] = [float(torch.cat(rays).abs().mean()) for rays in zip(*(p.rays for p in parts if p.rays))]
    assert len(sizes["float32"]) == 2  # of origins and directions
    assert sizes["float16"] == pytest.approx(sizes["float32"], rel=0.3)


@pytest.mark.slow
def test_training_in_half_precision_learns_as_well(ball: Path) -> None:
    errors = {}
    for precision in ("float32", "float16"):
        trainer = trainer_of(ball, **{"field.precision": precision})
        for step in range(120):
            trainer.step(step / 120)
        trainer.take_measured()
        for _ in range(10):
            trainer.step(1.0)
        errors[precision] = trainer.take_measured().psnr
    assert errors["float16"] == pytest.approx(errors["float32"], abs=1.0)


def test_training_survives_a_gradient_that_is_not_finite_and_gives_up_when_they_stay(ball: Path) -> None:
    trainer = trainer_of(ball)
    grid = trainer.model.field.grid
    assert grid is not None
    real = trainer._take

    def broken(learned):
        real(learned)
        next(trainer.model.parameters()).grad[0, 0] = math.nan
        trainer.guard.finite = trainer.guard.inspected(
            [p.grad for p in trainer.model.parameters() if p.grad is not None]
        )
        grid.gradient[:5, 1] = math.nan
        grid.touched[0] = 1

    trainer.step(0.1)
    trainer._take = broken
    before = parameters(trainer)
    trainer.step(0.1)
    assert torch.equal(parameters(trainer), before)
    assert int(grid.lost) == 5
    trainer._take = real
    for _ in range(20):
        trainer.step(0.2)
    measured = trainer.take_measured()
    assert (measured.skipped, measured.lost_rows) == (1, 5)
    assert bool(torch.isfinite(parameters(trainer)).all())
    assert bool(torch.isfinite(grid.table).all())
    trainer._take = broken
    with pytest.raises(TrainingError, match="not been finite"):
        many_steps(trainer)


def loses_numbers(monkeypatch: pytest.MonkeyPatch, lost: Callable[[int], bool]) -> None:
    """The losses of the steps for which `lost` says so are not numbers."""
    real, steps = Trainer.step, []

    def step(trainer: Trainer, progress: float) -> None:
        steps.append(progress)
        real(trainer, progress)

    def loss(*args: Any, **named: Any) -> tuple[torch.Tensor, torch.Tensor]:
        total, error = composite_loss(*args, **named)
        return (total * math.nan, error * math.nan) if lost(len(steps)) else (total, error)

    monkeypatch.setattr(Trainer, "step", step)
    monkeypatch.setattr("fieldwork.nerfcore.train.trainer.composite_loss", loss)


def train(project: Path, run: str, steps: int) -> dict[str, Any]:
    return run_verb("train", TrainParams(project=project, preset="draft", run=run, steps=steps, set=SMALL), Reporter())


def test_a_loss_that_is_not_a_number_costs_a_step_and_not_the_training(
    ball: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loses_numbers(monkeypatch, lambda step: step == 12)
    result = train(ball, "once", 60)
    assert result["steps"] == 60
    assert math.isfinite(result["psnr_train"])
    events = read_events(ball / "runs" / "once")
    assert sum(event.get("skipped", 0) for event in events) == 1
    assert all(math.isfinite(event["loss"]) for event in events)


def test_training_whose_losses_stay_no_numbers_ends_with_a_sentence(
    ball: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loses_numbers(monkeypatch, lambda step: step > 5)
    with pytest.raises(TrainingError, match="not been finite"):
        train(ball, "ever", 2000)
    monkeypatch.undo()
    loses_numbers(monkeypatch, lambda step: True)
    with pytest.raises(TrainingError, match="no longer a number"):
        train(ball, "never", 5)


def test_a_field_that_is_no_longer_a_number_does_not_replace_what_was_saved(
    ball: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(ball, "kept", 5)
    path = ball / "runs" / "kept" / "field.safetensors"
    before, real = path.read_bytes(), Trainer.step

    def step(trainer: Trainer, progress: float) -> None:
        real(trainer, progress)
        with torch.no_grad():
            next(trainer.model.parameters()).fill_(math.inf)

    monkeypatch.setattr(Trainer, "step", step)
    with pytest.raises(TrainingError, match="no longer a number"):
        train(ball, "kept", 5)
    assert path.read_bytes() == before
