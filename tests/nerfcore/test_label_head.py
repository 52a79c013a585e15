"""Training of the semantic head alone: on a busy machine too it takes the steps that it needs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.evaluate.documentation import sections
from fieldwork.nerfcore.evaluate.verb import evaluate
from fieldwork.nerfcore.field.hybrid import Geometry
from fieldwork.nerfcore.labels.accept import accept
from fieldwork.nerfcore.labels.head import (
    BATCH,
    JITTER,
    LEAST_STEPS,
    MARGIN,
    MOST_STEPS,
    PASSES,
    batches,
    lost_lead,
    share_done,
)
from fieldwork.nerfcore.params import EvaluateParams, LabelAcceptParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.test_labels import ball, spread, two_strokes  # noqa: F401


@pytest.mark.parametrize("seconds", [0.001, 1e6])
def test_a_training_ends_by_time_after_the_least_and_before_the_most_steps(seconds: float) -> None:
    steps = next(n for n in range(2 * MOST_STEPS) if share_done(n * 0.01 / seconds, n) >= 1)
    assert steps == (LEAST_STEPS if seconds < 1 else MOST_STEPS)
    assert share_done(0.0, 0) == 0


def test_the_class_that_is_shown_is_to_lead_by_what_it_leads_in_the_labels() -> None:
    soft = torch.tensor([[0.6, 0.3, 0.1], [0.35, 0.45, 0.2], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])
    each = [lost_lead(logits, row[None]).item() for row in soft for logits in (row.clamp(min=1e-6).log()[None],)]
    assert each == pytest.approx([0, 0, 0, 0], abs=1e-6), "what the labels say is right"
    nothing = [lost_lead(torch.zeros(1, 3), row[None]).item() for row in soft]
    assert nothing == pytest.approx([MARGIN, np.log(0.45 / 0.35), 0, MARGIN], abs=1e-6)
    wrong = lost_lead(torch.tensor([[0.0, 0.7, 3.0]]), soft[1:2]).item()
    assert wrong == pytest.approx(2.3 + np.log(0.45 / 0.35), abs=1e-6), "the class that leads instead is what counts"
    assert lost_lead(torch.zeros(2, 1), torch.ones(2, 1)).item() == 0, "one class leads always"


def test_each_surfel_is_learned_from_as_often_as_the_others_and_the_field_read_once() -> None:
    class Field:
        reads = 0

        def geometry(self, points: torch.Tensor) -> Geometry:
            self.reads += 1
            return Geometry(points[:, 0], points, None, None)

    field, count = Field(), BATCH + 1000
    place = torch.rand(count, 3, generator=torch.Generator().manual_seed(3))
    found = batches(field, place, torch.arange(count)[:, None])  # type: ignore[arg-type]
    seen = [next(found) for _ in range(2 * PASSES)]
    assert field.reads == 1
    number = torch.cat([labels[:, 0] for _, labels in seen])
    assert torch.bincount(number).tolist() == [PASSES] * count
    beside = torch.cat([known.features for known, _ in seen]) - place[number]
    assert beside.abs().max() < 6 * JITTER
    assert beside.std().item() == pytest.approx(JITTER, rel=0.1)
    next(found)
    assert field.reads == 2


def test_without_time_the_field_learns_all_the_same(ball: Path) -> None:  # noqa: F811
    two_strokes(ball)
    spread(ball)
    told = accept(LabelAcceptParams(project=ball, seconds=0.01), Reporter())
    assert told["steps"] == LEAST_STEPS
    assert told["agreement"] > 0.75
    (settings,) = (section for section in sections(ball, "main", {}) if section.title == "Settings of the run")
    (row,) = (row for row in settings.rows if row[0] == "labels")
    assert row[1].startswith("revision 2 of the marks, accepted 20"), "the report names the revision of its labels"
    found = evaluate(EvaluateParams(project=ball), Reporter())
    assert found["label_revision"] == 2
