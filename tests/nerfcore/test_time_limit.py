"""A training of limited time: as many steps as it takes to learn, on slow machines too."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.config import TrainConfig
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import CHECKPOINT, checkpoint_state, run_folder
from fieldwork.nerfcore.train import schedule, verb
from fieldwork.nerfcore.train.schedule import ENOUGH_STEPS, largest_batch, sample_budget
from fieldwork.tests.nerfcore.support.ball import SMALL
from fieldwork.tests.nerfcore.test_training import tiny_project  # noqa: F401
from hypothesis import given
from hypothesis import strategies as st

TRAIN = TrainConfig()


@given(st.floats(1, 1e5), st.floats(1e-3, 10))
def test_the_largest_batch_leaves_enough_steps_or_is_the_smallest(seconds: float, step: float) -> None:
    size = largest_batch(TRAIN, seconds, step)
    assert 2 * TRAIN.batch_start <= size <= TRAIN.batch_samples
    assert largest_batch(TRAIN, 2 * seconds, step) >= size
    assert largest_batch(TRAIN, seconds, 2 * step) <= size
    mean = schedule._mean_cost(size / TRAIN.batch_start)
    if size > 2 * TRAIN.batch_start:
        assert seconds / (step * mean) >= ENOUGH_STEPS


def test_fast_machines_keep_their_batches() -> None:
    assert largest_batch(TRAIN, 120, 0.01) == TRAIN.batch_samples
    assert largest_batch(TRAIN, 120, 0.1) < TRAIN.batch_samples
    constant = TrainConfig(batch_start=4096, batch_samples=4096)
    assert largest_batch(constant, 1, 10) == 4096


def test_the_budget_grows_to_the_largest_batch() -> None:
    assert sample_budget(TRAIN, 0.0, 32768) == sample_budget(TRAIN, 0.0) == TRAIN.batch_start
    assert sample_budget(TRAIN, 1.0, 32768) == 32768
    assert sample_budget(TRAIN, 1.0) == TRAIN.batch_samples


def test_a_short_training_measures_its_steps_and_goes_on_with_what_it_found(
    tiny_project: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(verb, "MEASURED_STEPS", (2, 4))
    asked: list[float] = []

    def largest(train: TrainConfig, seconds: float, step_seconds: float) -> int:
        asked.append(step_seconds)
        assert seconds == 1.0
        return 700

    monkeypatch.setattr(verb, "largest_batch", largest)
    settings = {**SMALL, "train.batch_samples": "2048", "train.batch_start": "512"}
    params = TrainParams(project=tiny_project, preset="draft", run="short", time_limit=1.0, set=settings)
    verb.train(params, Reporter())
    assert len(asked) == 1
    assert 0 < asked[0] < 1
    checkpoint = run_folder(tiny_project, "short") / CHECKPOINT
    state = checkpoint_state(checkpoint)
    assert state is not None
    assert state["largest_batch"] == 700
    # Without a limit of time nothing is measured, and what was found stays.
    verb.train(params.model_copy(update={"time_limit": None, "steps": state["steps"] + 8, "resume": True}), Reporter())
    state = checkpoint_state(checkpoint)
    assert state is not None
    assert state["largest_batch"] == 700
    assert len(asked) == 1
    verb.train(params.model_copy(update={"time_limit": None, "steps": 8, "run": "long"}), Reporter())
    state = checkpoint_state(run_folder(tiny_project, "long") / CHECKPOINT)
    assert state is not None
    assert state["largest_batch"] is None
