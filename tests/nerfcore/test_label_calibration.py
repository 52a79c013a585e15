"""How sure labels are said to be follows from how marks on one photo do on another."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.labels.calibration import CERTAINTY, HELD, LEAST, MOST, STRENGTH, certainty, likeliest_power
from fieldwork.nerfcore.labels.seeds import VOID, Seeds


def scene(shift: float, photos: int = 2, each: int = 40) -> tuple[torch.Tensor, Seeds]:
    """Two classes marked on each photo, that differ along the first axis; by `shift` from photo to photo along it too."""
    random = np.random.default_rng(0)
    features, label, mark, photo = [], [], [], []
    for number in range(photos):
        for kind in (0, 1):
            middle = np.zeros(4)
            middle[0] = (3 if kind else -3) + shift * number
            features.append(middle + random.normal(0, 0.7, (each, 4)))
            label += [kind] * each
            mark += [1 + 2 * number + kind] * each
            photo += [number] * each
    count = len(label)
    arrays = [np.array(values, np.int32) for values in (label, mark, photo)]
    seeds = Seeds(np.arange(count), arrays[0], arrays[1], [], [], None, arrays[2])
    return torch.from_numpy(np.concatenate(features)).float(), seeds


def found(features: torch.Tensor, seeds: Seeds) -> float:
    return certainty(features, seeds, 2, lambda: None).exponent


def test_labels_are_less_sure_where_marks_mislead_on_other_photos() -> None:
    same, other = found(*scene(0.0)), found(*scene(5.0))
    assert LEAST <= other < same <= MOST
    assert other < 1


def test_the_self_check_is_the_share_that_other_photos_guess() -> None:
    alike, misled = (certainty(*scene(shift), 2, lambda: None).right for shift in (0.0, 6.0))
    assert alike is not None
    assert alike > 0.95
    assert misled is not None
    assert misled < 0.6, "on the other photo one class is taken for the other"
    assert certainty(*scene(0.0, photos=1), 2, lambda: None).right is None


def test_where_marks_cannot_tell_the_usual_holds() -> None:
    assert found(*scene(0.0, photos=1)) == CERTAINTY
    features, seeds = scene(0.0)
    alone = Seeds(seeds.surfel, (seeds.mark - 1).astype(np.int32), seeds.mark, [], [], None, seeds.photo)
    assert certainty(features, alone, 4, lambda: None).exponent == CERTAINTY, "no class is on two photos"
    void = Seeds(seeds.surfel, np.full_like(seeds.label, VOID), seeds.mark, [], [], None, seeds.photo)
    assert found(features, void) == CERTAINTY
    nothing = Seeds(*(np.zeros(0, np.int32) for _ in range(3)), [], [])
    assert found(features[:0], nothing) == CERTAINTY


def test_a_walker_that_looks_hold_is_less_sure() -> None:
    clear = scene(0.0)
    usual, held = (certainty(*clear, 2, lambda: None, strength=s).exponent for s in (STRENGTH, 3 * STRENGTH))
    assert held == HELD < usual
    misled = certainty(*scene(5.0), 2, lambda: None, strength=3 * STRENGTH).exponent
    assert misled < 1, "marks that mislead count more"


def test_the_likeliest_power_makes_shares_right() -> None:
    """What is said with 0.9 and is right in six of ten cases is to be said with 0.6."""
    probability = np.tile([0.9, 0.1], (1000, 1))
    label = (np.arange(1000) % 10 >= 6).astype(int)
    tau = likeliest_power(probability, label, np.ones(1000))
    said = 0.9**tau / (0.9**tau + 0.1**tau)
    assert said == pytest.approx(0.6, abs=0.03)
