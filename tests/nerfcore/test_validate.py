"""Which pairs of photos contradict their poses."""

from __future__ import annotations

from fieldwork.nerfcore.poses.validate import STRONG, contradicting_pairs

# A walk along both sides of a thing: neighbours match well.
WALK = [(i, i + 1, 0.95, 200) for i in range(1, 10)]


def test_neighbours_that_agree_contradict_nothing() -> None:
    assert contradicting_pairs(WALK) == []
    assert contradicting_pairs([]) == []


def test_a_pair_that_matches_like_neighbours_and_does_not_fit() -> None:
    assert contradicting_pairs([*WALK, (2, 8, 0.1, 150)]) == [(2, 8)]
    assert contradicting_pairs([*WALK, (2, 8, 0.6, 150)]) == []


def test_a_few_matches_of_what_looks_alike_say_nothing() -> None:
    few = int(STRONG * 200) - 1
    assert contradicting_pairs([*WALK, (2, 8, 0.0, few)]) == []
    assert contradicting_pairs([*WALK, (2, 8, 0.0, few + 1)]) == [(2, 8)]


def test_few_matches_are_many_for_a_photo_that_has_no_more() -> None:
    """Beside what its own best pair has, not beside the capture's."""
    assert contradicting_pairs([*WALK, (10, 11, 0.9, 40), (2, 11, 0.0, 30)]) == [(2, 11)]


def test_a_photo_with_few_matches_does_not_make_alike_parts_of_another_one_count() -> None:
    assert contradicting_pairs([*WALK, (10, 11, 0.9, 70), (2, 11, 0.0, 33)]) == []


def test_all_pairs_of_a_photo_that_agrees_with_none_contradict_it() -> None:
    wrong = [(99, 2, 0.1, 150), (99, 3, 0.2, 30), (99, 8, 0.0, 15)]
    assert contradicting_pairs([*WALK, *wrong]) == [(99, 2), (99, 3), (99, 8)]
