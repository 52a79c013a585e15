"""What no surface is made of: places that label maps leave out, and backdrops."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.data.pixels import VOID
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh.sky import backdrop, confirmed_share, labels_tell, named_things, nothing

SHAPE = (96, 128)


def half(columns: int) -> np.ndarray:
    """The columns from this one on."""
    out = np.zeros(SHAPE, bool)
    out[:, columns:] = True
    return out


@pytest.mark.parametrize(("named", "tell"), [(100, True), (40, False)])
def test_label_maps_tell_where_they_name_what_is_surely_there(named: int, tell: bool) -> None:
    everywhere = np.ones(SHAPE, bool)
    assert labels_tell([everywhere], [half(named)]) is tell
    # A photo without a label map says nothing of those that have one.
    assert labels_tell([everywhere] * 4, [half(named), None, None, None]) is tell
    assert labels_tell([everywhere], [None]) is False


def test_a_depth_that_spreads_over_an_outline_into_the_sky_is_left_out() -> None:
    left_out = half(64)
    spread = ~half(68)  # the thing, and four pixels beside it
    empty = nothing(left_out, spread, usual=0.7)
    assert empty[:, 64:].all()
    assert not empty[:, :64].any()


def test_a_thing_without_a_name_is_kept_where_photos_confirm_it() -> None:
    left_out, sure = half(64), np.ones(SHAPE, bool)
    assert not nothing(left_out, sure, usual=1.0).any()
    line = np.zeros(SHAPE, bool)
    line[:, 64:67] = True  # what an annotator leaves between two classes
    assert not nothing(line, sure, usual=1.0).any()


@pytest.mark.parametrize(("every", "kept"), [(3, True), (13, False)])
def test_a_plain_thing_without_a_name_is_kept_where_photos_confirm_as_much_of_it_as_of_others(
    every: int, kept: bool
) -> None:
    left_out, sure = half(64), np.zeros(SHAPE, bool)
    sure[::every, ::4] = True  # of a picture on the wall, or of clouds
    usual = float(sure[:, :64].mean()) if kept else 0.5
    empty = nothing(left_out, sure, usual)
    assert not empty[:, :64].any()
    assert not empty[sure & half(70)].any()  # a place that photos confirm is there in any case
    assert empty[~sure & left_out].all() != kept
    assert empty.any() != kept


def test_a_backdrop_is_far_and_nothing_near_it_is_confirmed() -> None:
    depth = np.where(half(64), 8.0, 2.0).astype(np.float32)
    depth[:8] = FREE
    sure = ~half(64)
    found = backdrop(depth, sure)
    assert found[8:, 64:].all()
    assert not found[:, :64].any()
    assert not found[:8].any()
    # A far hill with something to compare on it stays, and so does a wall no farther than the rest.
    hill = sure.copy()
    hill[8::3, 64::3] = True
    assert not backdrop(depth, hill).any()
    assert not backdrop(np.where(half(64), 2.2, depth).astype(np.float32), sure).any()
    # Where nothing is confirmed at all, nothing is known of what is far.
    assert not backdrop(depth, np.zeros(SHAPE, bool)).any()


def test_a_class_that_photos_confirm_is_a_thing_and_a_sky_is_none() -> None:
    label = np.where(half(64), 5, 2).astype(np.uint8)  # a sky beside a wall
    label[:8] = VOID
    hit, sure = np.ones(SHAPE, bool), ~half(64)
    sure[::4, 64::4] = True  # a sixteenth of the sky looks confirmed
    confirmed, usual = confirmed_share([hit, hit], [sure, sure], [label, None])
    assert confirmed[2] == 1
    assert confirmed[5] == 1 / 16
    assert usual == pytest.approx((1 + 1 / 16) / 2)
    found, other = named_things([label, None], confirmed, usual)
    assert other is None
    assert found is not None
    assert (found[8:, :64] == 2).all()
    assert (found[:, 64:] == VOID).all()
    # White walls are confirmed as little, where all of a room is white.
    (room,) = named_things([label], confirmed, 0.2)
    assert room is not None
    assert (room[8:, 64:] == 5).all()
    # Of an untrained field photos confirm a little by chance, which makes nothing a thing.
    chance = np.zeros(SHAPE, bool)
    chance[::5, ::5] = True
    (scraps,) = named_things([label], *confirmed_share([hit], [chance], [label]))
    assert scraps is not None
    assert (scraps == VOID).all()
    # What nothing is known of is no thing either.
    (unknown,) = named_things([label], *confirmed_share([~hit], [sure], [label]))
    assert unknown is not None
    assert (unknown == VOID).all()
