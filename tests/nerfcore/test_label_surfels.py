"""Surfels end where colours do, and looks are believed as far as marks on other photos bear them out."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.labels.calibration import CERTAINTY, MOST, STRENGTH, certainty
from fieldwork.nerfcore.labels.likeness import likeness
from fieldwork.nerfcore.labels.part_labels import STRENGTHS, best_strength, simplest
from fieldwork.nerfcore.labels.photo_features import uplifted
from fieldwork.nerfcore.labels.seeds import Seeds
from fieldwork.nerfcore.labels.surfels import by_colour, cell_of, means, most_alike, nearest_neighbours
from fieldwork.nerfcore.labels.walker import edge_matrix

EDGE = 0.53  # where the colour changes along x: within cells


def sheet(count: int = 20_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a flat sheet, which of them are on its dark side, and their colours."""
    random = np.random.default_rng(0)
    points = np.concatenate([random.random((count, 2)), np.full((count, 1), 0.5)], 1)
    dark = points[:, 0] < EDGE
    lab = np.where(dark[:, None], [20.0, 0, 0], [80.0, 0, 0]) + random.normal(0, 2, (count, 3))
    return points, dark, lab


def mixed(number: np.ndarray, dark: np.ndarray) -> float:
    """Share of the points that are not of the colour that most of their surfel has."""
    share = means(number, int(number.max()) + 1, dark[:, None].astype(float))[:, 0]
    return float(((share[number] > 0.5) != dark).mean())


def test_surfels_end_where_colours_do() -> None:
    points, dark, lab = sheet()
    number, count = cell_of(points, 400)
    around = nearest_neighbours(means(number, count, points), 8)
    found, left = by_colour(number, points, lab, around)
    assert mixed(number, dark) > 0.005
    assert mixed(found, dark) < 0.0005
    assert 0.9 * count <= left <= count
    assert sorted(set(found.tolist())) == list(range(left))
    spread = np.linalg.norm(points - means(found, left, points)[found], axis=1)
    before = np.linalg.norm(points - means(number, count, points)[number], axis=1)
    assert np.quantile(spread, 0.99) < 2 * np.quantile(before, 0.99), "they stay as small as they were"


def test_on_one_colour_surfels_stay_where_they_are() -> None:
    points, _, _ = sheet(4000)
    number, count = cell_of(points, 100)
    around = nearest_neighbours(means(number, count, points), 8)
    found, left = by_colour(number, points, np.full((4000, 3), 50.0), around)
    assert left == count
    middle = means(found, left, points)
    nearest = np.linalg.norm(points[:, None] - middle[None], axis=2).min(1)
    own = np.linalg.norm(points - middle[found], axis=1)
    assert np.median(own - nearest) == pytest.approx(0, abs=1e-3)


def test_a_pixel_at_a_depth_edge_takes_the_surfel_of_its_colour() -> None:
    position = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], float) / 10
    lab = np.array([[20.0, 0, 0], [80, 0, 0], [80, 0, 0]])
    neighbours = nearest_neighbours(position, 2)
    found = most_alike(
        np.array([0, 0]), position[[0, 0]], np.array([[21.0, 0, 0], [79, 0, 0]]), position, lab, neighbours
    )
    np.testing.assert_array_equal(found, [0, 1])


def test_it_can_be_stopped() -> None:
    points, _, lab = sheet(2000)
    number, count = cell_of(points, 100)
    around = nearest_neighbours(means(number, count, points), 8)

    def stop() -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        by_colour(number, points, lab, around, stop)


def test_values_of_photos_are_the_means_of_the_pixels_that_show_a_surfel() -> None:
    random = np.random.default_rng(0)
    pictures = [(random.integers(-1, 5, (6, 8)), random.random((6, 8, 3))) for _ in range(3)]
    found = uplifted(7, pictures)
    surfel = np.concatenate([shown.reshape(-1) for shown, _ in pictures])
    values = np.concatenate([value.reshape(-1, 3) for _, value in pictures])
    for number in range(5):
        np.testing.assert_allclose(found[number], values[surfel == number].mean(0), atol=1e-6)
    np.testing.assert_array_equal(found[5:], 0)


@dataclass
class Strip:
    """What `best_strength` needs of a preparation: parts in a row, each one surfel, that look as their class does, or as the
    class beside it."""

    look: np.ndarray
    edges: Any
    surfels: Any = field(default_factory=lambda: SimpleNamespace())

    def __post_init__(self) -> None:
        count = len(self.look)
        self.features, self.photo_features = self.look, np.zeros((count, 0), np.float32)
        self.part_features, self.parts = self.look, np.arange(count)[:, None]
        self.part_edges, self.conductance = self.edges, 2.0
        self.likeness = likeness(self.look, lambda: None)

    def columns(self, some: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(self.look[some])


def strip(patches: bool) -> tuple[Strip, Seeds]:
    """Two classes on a strip of 60 parts, marked on two photos: as its two halves, which look nearly alike; or as patches of
    five, which look different while nothing ends between them."""
    random = np.random.default_rng(0)
    place = np.arange(60)
    kind = (place // 5) % 2 if patches else place // 30
    apart = 3.0 if patches else 0.1
    look = (np.stack([np.where(kind, apart, -apart), np.zeros(60)], 1) + random.normal(0, 0.4, (60, 2))).astype(
        np.float32
    )
    weights = np.ones((60, 2), np.float32)
    if not patches:
        weights[29, 1] = weights[30, 0] = 1e-4
    neighbours = np.stack([np.maximum(place - 1, 0), np.minimum(place + 1, 59)], 1)
    neighbours[0, 0], neighbours[59, 1] = 1, 58
    surfel = np.sort(random.choice(60, 24, replace=False))
    photo = random.integers(0, 2, 24)
    label = kind[surfel].astype(np.int32)
    seeds = Seeds(surfel, label, (1 + label + 2 * photo).astype(np.int32), [], [], None, photo.astype(np.int32))
    return Strip(look, edge_matrix(neighbours, weights)), seeds


def test_looks_are_believed_more_where_classes_do_not_end_with_the_surface() -> None:
    whole, patches = (best_strength(*strip(kind), 2) for kind in (False, True))  # type: ignore[arg-type]
    assert whole == STRENGTH == min(STRENGTHS)
    assert patches > whole


def test_a_way_that_is_hardly_better_is_not_taken() -> None:
    one_more = np.array([[1, 1, 1], [1, 1, 1], [0, 0, 1], [1, 1, 1]], float)
    assert simplest(one_more) == 0, "one example proves nothing"
    assert simplest(np.repeat([[0.0, 1, 1]], 12, 0)) == 1
    assert simplest(np.array([[0.2, 0.9, 0.91], [0.3, 0.8, 0.82], [0.4, 0.9, 0.88]])) == 1


def test_without_a_second_photo_the_usual_strength_holds() -> None:
    ready, seeds = strip(True)
    one = Seeds(seeds.surfel, seeds.label, seeds.mark, [], [], None, np.zeros_like(seeds.photo))
    assert best_strength(ready, one, 2) == STRENGTH  # type: ignore[arg-type]


def test_the_more_looks_count_the_less_probabilities_are_sharpened() -> None:
    """A walker that goes by looks does not stray, so it is as sure as it is right sooner."""
    random = np.random.default_rng(0)
    label = np.tile([0, 1], 80).astype(np.int32)
    features = torch.from_numpy(np.where(label, 3.0, -3.0)[:, None] + random.normal(0, 0.5, (160, 3))).float()
    photo = np.repeat([0, 1], 80).astype(np.int32)
    seeds = Seeds(np.arange(160), label, (1 + label + 2 * photo).astype(np.int32), [], [], None, photo)
    found = [certainty(features, seeds, 2, lambda: None, strength) for strength in STRENGTHS]
    exponents = [one.exponent for one in found]
    assert exponents == sorted(exponents, reverse=True)
    assert exponents[0] == MOST
    assert exponents[-1] < 0.5 * MOST
    assert [one.strength for one in found] == list(STRENGTHS)
    nothing = certainty(features[:0], Seeds(*(np.zeros(0, np.int32) for _ in range(3)), [], []), 2, lambda: None)
    assert nothing.exponent == CERTAINTY
