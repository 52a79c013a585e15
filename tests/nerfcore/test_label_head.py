"""Training of the semantic head alone: on a busy machine too it takes the steps that it needs."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.evaluate.documentation import sections
from fieldwork.nerfcore.evaluate.verb import evaluate
from fieldwork.nerfcore.labels.accept import accept
from fieldwork.nerfcore.labels.head import LEAST_STEPS, MOST_STEPS, share_done
from fieldwork.nerfcore.params import EvaluateParams, LabelAcceptParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.test_labels import ball, spread, trained, two_strokes  # noqa: F401


@pytest.mark.parametrize("seconds", [0.001, 1e6])
def test_a_training_ends_by_time_after_the_least_and_before_the_most_steps(seconds: float) -> None:
    steps = next(n for n in range(2 * MOST_STEPS) if share_done(n * 0.01 / seconds, n) >= 1)
    assert steps == (LEAST_STEPS if seconds < 1 else MOST_STEPS)
    assert share_done(0.0, 0) == 0


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
