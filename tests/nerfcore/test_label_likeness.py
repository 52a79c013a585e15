"""How strange looks are: a group that no way of small steps joins to a mark, against the far end of one that is marked."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.labels.likeness import NEIGHBOURS, likeness, strangeness
from fieldwork.nerfcore.labels.unary import KNOWN_KIND, KNOWN_LOOK, STRANGE, familiarity
from fieldwork.nerfcore.progress import go_on


def line(begin: tuple[float, float], end: tuple[float, float], count: int) -> np.ndarray:
    return np.linspace(begin, end, count).astype(np.float32)


def test_a_group_of_its_own_is_stranger_than_the_far_end_of_what_is_marked() -> None:
    """A chain of looks from the mark at (0, 0) to (3, 0); and a group of looks around (0, 2), nearer to the mark than the
    chain's end, with nothing in between."""
    chain = line((0, 0), (3, 0), 200)
    group = np.random.default_rng(0).normal((0, 2), 0.1, (60, 2)).astype(np.float32)
    features = np.concatenate([chain, group])
    distance = np.linalg.norm(features, axis=1)
    edges, scale = likeness(features, go_on)
    assert abs(edges - edges.T).max() == 0
    found = strangeness(edges, scale, distance, go_on)
    assert found.min() >= 0
    assert found.max() <= 1
    assert found[0] < 0.1
    end, other = found[199], found[200:]
    assert distance[199] > distance[200:].max()
    assert other.min() > 0.95
    assert end < other.min()
    assert (np.diff(found[:200]) > -1e-3).all(), "the farther along the chain, the stranger"


@pytest.mark.parametrize("count", [1, 2, NEIGHBOURS + 1])
def test_few_and_equal_parts(count: int) -> None:
    features = np.zeros((count, 3), np.float32)
    edges, scale = likeness(features, go_on)
    assert edges.shape == (count, count)
    assert strangeness(edges, scale, np.zeros(count), go_on) == pytest.approx(0.1 / 4.1, abs=0.01)


def test_what_is_strange_is_familiar_at_a_shorter_distance_only() -> None:
    for strange, reach in ((0.0, KNOWN_LOOK), (0.2, KNOWN_LOOK), (1.0, KNOWN_KIND / (STRANGE + 1))):
        assert familiarity(np.array([reach]), np.array([strange])) == pytest.approx(0.5)
        assert familiarity(np.array([reach * 0.5]), np.array([strange])) > 0.9
