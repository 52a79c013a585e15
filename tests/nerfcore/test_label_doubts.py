"""Marks that look like those of another class are told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.labels.doubts import doubtful
from fieldwork.nerfcore.labels.seeds import VOID, Seeds

EACH = 20


def strokes(labels: list[int], looks: list[int], spread: float = 0.3) -> tuple[Any, Seeds]:
    """One stroke for each label; those of one look are alike."""
    random = np.random.default_rng(0)
    middle = random.normal(0, 3, (max(looks) + 1, 6))
    columns = np.concatenate([middle[look] + random.normal(0, spread, (EACH, 6)) for look in looks]).astype(np.float32)
    mark = np.repeat(np.arange(1, len(labels) + 1), EACH).astype(np.int32)
    surfel = np.arange(len(mark))
    ready = SimpleNamespace(columns=lambda some: torch.from_numpy(columns[some]))
    return ready, Seeds(surfel, np.repeat(labels, EACH).astype(np.int32), mark, [], [], None, np.zeros_like(mark))


def test_what_looks_as_its_class_is_not_doubted() -> None:
    assert doubtful(*strokes([0, 0, 1, 1, 2, 2], [0, 0, 1, 1, 2, 2]), 3) == []


def test_a_mark_of_the_wrong_class_is_named_with_the_class_it_looks_like() -> None:
    found = doubtful(*strokes([0, 0, 0, 1, 1, 1, 2, 2, 0], [0, 0, 0, 1, 1, 1, 2, 2, 1]), 3)
    assert found == [(9, 1)]


@pytest.mark.parametrize("labels", [[0, 1], [0, VOID, 1], [VOID, VOID], []])
def test_a_mark_that_is_the_only_one_of_its_class_is_not_doubted(labels: list[int]) -> None:
    if labels:
        assert doubtful(*strokes(labels, [0] * len(labels)), 2) == []
    else:
        nothing = Seeds(*(np.zeros(0, np.int32) for _ in range(3)), [], [])
        assert doubtful(strokes([0], [0])[0], nothing, 0) == []


def test_where_looks_tell_nothing_of_classes_nothing_is_doubted() -> None:
    assert doubtful(*strokes([0, 0, 1, 1, 2, 2], [0, 1, 1, 2, 2, 0]), 3) == []
