"""The random walker beside a dense solution, its properties, and which pixels a mark covers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.labels.calibration import CERTAINTY, calibrated
from fieldwork.nerfcore.labels.drawing import covered
from fieldwork.nerfcore.labels.surfels import cell_of, nearest_neighbours, shape_at
from fieldwork.nerfcore.labels.unary import (
    BANDWIDTH,
    LANDMARKS,
    SAMPLES,
    Kernel,
    balanced,
    class_probabilities,
    distance_to_samples,
    logistic_regression,
    sampled,
)
from fieldwork.nerfcore.labels.walker import edge_matrix, random_walk
from hypothesis import given, settings
from hypothesis import strategies as st


def some_graph(seed: int, count: int, classes: int):
    random = np.random.default_rng(seed)
    position = random.random((count, 3))
    neighbours = nearest_neighbours(position, 5)
    edges = edge_matrix(neighbours, random.uniform(0.1, 1, neighbours.shape))
    prior = random.dirichlet(np.ones(classes), count).astype(np.float32)
    strength = random.uniform(0, 0.2, count).astype(np.float32)
    sink = random.uniform(0.001, 0.1, count).astype(np.float32)
    seeds = random.choice(count, 4, replace=False)
    values = np.eye(classes, dtype=np.float32)[random.integers(classes, size=4)]
    return edges, prior, strength, sink, seeds, values


def dense(edges, prior, strength, sink, seeds, values) -> np.ndarray:
    """The same linear system, with rows of known nodes replaced, solved directly."""
    weights = edges.toarray().astype(np.float64)
    matrix = np.diag(weights.sum(1) + strength + sink) - weights
    right = strength[:, None] * prior.astype(np.float64)
    matrix[seeds] = np.eye(len(prior))[seeds]
    right[seeds] = values
    return np.linalg.solve(matrix, right)


@given(st.integers(0, 10_000), st.integers(20, 80), st.integers(1, 4))
@settings(max_examples=25)
def test_it_solves_what_a_dense_solver_solves(seed: int, count: int, classes: int) -> None:
    problem = some_graph(seed, count, classes)
    found = random_walk(*problem, tolerance=1e-6)
    np.testing.assert_allclose(found, dense(*problem), atol=2e-4)
    assert (found.sum(1) <= 1 + 1e-4).all()
    np.testing.assert_array_equal(found[problem[4]], problem[5])
    warm = random_walk(*problem, start=found, tolerance=1e-3, most_steps=1)
    np.testing.assert_allclose(warm, found, atol=2e-3)


def test_what_nothing_explains_is_void() -> None:
    """A chain: seeds at both ends, no prior; a sink takes walkers in the middle, and without one none are lost."""
    neighbours = np.array([*range(1, 41), 39])[:, None]
    edges = edge_matrix(neighbours, np.ones(neighbours.shape))
    none = np.zeros((41, 2), np.float32), np.zeros(41, np.float32)
    ends = np.array([0, 40]), np.eye(2, dtype=np.float32)
    kept = random_walk(edges, *none, 0.0, *ends, tolerance=1e-6)
    np.testing.assert_allclose(kept[:, 0], np.linspace(1, 0, 41), atol=1e-3)
    lost = random_walk(edges, *none, 0.1, *ends, tolerance=1e-6)
    assert lost[20].sum() < 0.1
    assert lost[1, 0] > 0.6


def test_it_can_be_stopped() -> None:
    def stop() -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        random_walk(*some_graph(0, 30, 2), check=stop)


def test_classes_count_the_same_however_often_they_are_marked() -> None:
    """One dimension, 300 marks at 0 and 3 at 1: the border lies in the middle."""
    features = torch.cat([torch.zeros(300, 1), torch.ones(3, 1)])
    target = torch.tensor([0] * 300 + [1] * 3)
    matrix, bias = logistic_regression(features, target, balanced(target, target), 2, decay=1e-3)
    margin = (matrix[:, 1] - matrix[:, 0], bias[1] - bias[0])
    assert float(-margin[1] / margin[0]) == pytest.approx(0.5, abs=0.02)


def test_the_classifier_knows_what_is_marked_and_how_far_all_else_is() -> None:
    random = np.random.default_rng(0)
    middle = np.array([[0, 0, 0, 0], [4, 0, 0, 0], [0, 4, 0, 0]])
    label = random.integers(3, size=900)
    features = torch.from_numpy(middle[label] + random.normal(size=(900, 4)) * 0.3).float()
    marked = torch.arange(60)
    target = torch.from_numpy(label[:60])
    found = class_probabilities(features, marked, target, target, 4, lambda: None)
    assert (found.argmax(1) == label).mean() > 0.99
    assert (found[:, 3] == 0).all()
    distance = distance_to_samples(features, marked, target, lambda: None)
    truth = np.linalg.norm(features.numpy()[:, None] - features.numpy()[None, :60], axis=2).min(1)
    np.testing.assert_allclose(distance, truth, atol=1e-2)


def test_features_of_the_kernel_have_its_values_as_products() -> None:
    """Also where landmarks are the same, and in as many columns as surfels have."""
    random = np.random.default_rng(0)
    rows = torch.from_numpy(random.normal(size=(40, 60)).astype(np.float32))
    kernel = Kernel(torch.cat([rows, rows[:5]]))
    features = kernel.features(rows)
    distance = np.linalg.norm(rows.numpy()[:, None] - rows.numpy()[None], axis=2)
    np.testing.assert_allclose(features @ features.T, np.exp(-0.5 * (BANDWIDTH * distance) ** 2), atol=2e-4)
    matrix = torch.from_numpy(random.normal(size=(45, 3)).astype(np.float32))
    np.testing.assert_allclose(kernel(rows) @ kernel.weights(matrix), features @ matrix, atol=1e-2)


def test_many_marks_have_fewer_landmarks_each_and_few_have_enough() -> None:
    few, many = (torch.arange(count).repeat_interleave(100) for count in (3, 200))
    assert len(sampled(few, LANDMARKS)) == 3 * SAMPLES
    chosen = sampled(many, LANDMARKS)
    assert len(chosen) <= LANDMARKS
    assert set(many[chosen].tolist()) == set(range(200))


def test_what_looks_like_nothing_that_is_marked_is_of_no_class_more_than_another() -> None:
    features = torch.tensor([[0.0, 0], [4, 0], [400, 300]])
    found = class_probabilities(features, torch.arange(2), torch.tensor([0, 1]), torch.tensor([0, 1]), 2, lambda: None)
    np.testing.assert_allclose(found[2], 0.5, atol=0.02)
    assert found[0, 0] > 0.9


def test_a_short_mark_counts_as_much_as_a_long_one_of_its_class() -> None:
    share = balanced(torch.tensor([0] * 10 + [1] * 40 + [1] * 2), torch.tensor([1] * 10 + [2] * 40 + [3] * 2))
    assert float(share[:10].sum()) == pytest.approx(0.5)
    assert float(share[10:50].sum()) == pytest.approx(0.25)
    assert float(share[50:].sum()) == pytest.approx(0.25)


@given(st.integers(0, 1000))
@settings(max_examples=20)
def test_calibration_keeps_the_winner_and_can_be_taken_back(seed: int) -> None:
    p = np.random.default_rng(seed).dirichlet(np.ones(4), 50)[:, :3].astype(np.float32)
    sharp = calibrated(p, CERTAINTY)
    np.testing.assert_array_equal(sharp.argmax(1), p.argmax(1))
    np.testing.assert_array_equal(sharp.sum(1) > 0.5, p.sum(1) > 0.5)
    assert (sharp.sum(1) <= 1 + 1e-5).all()
    np.testing.assert_allclose(calibrated(calibrated(p, 2), 0.5), p, atol=1e-3)


@pytest.mark.parametrize("width", [1.0, 3.0, 8.0])
def test_a_line_covers_what_is_near_it(width: float) -> None:
    points = np.array([[3.5, 4.5], [20.5, 9.5], [20.5, 20.5]])
    found = covered("line", points, width, 30, 24)
    y, x = np.mgrid[:24, :30] + 0.5
    place = np.stack([x, y], -1).reshape(-1, 1, 2)
    dots = np.concatenate([a + (b - a) * np.linspace(0, 1, 2000)[:, None] for a, b in zip(points, points[1:])])
    distance = np.linalg.norm(place - dots[None, ::4], axis=2).min(1).reshape(24, 30)
    sure = np.abs(distance - max(width, 1.42) / 2) > 0.02
    np.testing.assert_array_equal(found[sure], (distance <= max(width, 1.42) / 2)[sure])


def test_outlines_and_clicks() -> None:
    square = covered("outline", np.array([[2.0, 3.0], [8.0, 3.0], [8.0, 7.0], [2.0, 7.0]]), 1.0, 12, 10)
    expected = np.zeros((10, 12), bool)
    expected[3:7, 2:8] = True
    assert (square != expected).sum() <= 24  # the border itself may fall to either side
    assert square[4:6, 3:7].all()
    thin = covered("outline", np.array([[2.0, 3.6], [8.0, 3.6], [8.0, 3.9], [2.0, 3.9]]), 1.0, 12, 10)
    assert thin[3, [1, 2, 7, 8]].all(), "it lies between the centres of pixels: its corners count"
    assert thin.sum() <= 8
    assert not covered("outline", np.array([[-9.0, 3], [-5.0, 3], [-5.0, 7]]), 1.0, 12, 10).any()
    clicks = covered("click", np.array([[2.5, 2.5], [9.5, 7.5]]), 3.0, 12, 10)
    assert (clicks[2, 2], clicks[7, 9], clicks[5, 6]) == (True, True, False)
    assert not covered("click", np.array([[-9.0, 2.0]]), 3.0, 12, 10).any()


@given(st.integers(1, 500), st.integers(0, 1000))
@settings(max_examples=25)
def test_cells_are_no_more_than_wanted_and_hold_what_is_near(wanted: int, seed: int) -> None:
    points = np.random.default_rng(seed).random((1000, 3))
    number, count = cell_of(points, wanted)
    assert count <= max(wanted, 1)
    assert set(number.tolist()) == set(range(count))


def test_normals_and_planarity_of_a_plane_and_of_noise() -> None:
    random = np.random.default_rng(0)
    plane = np.concatenate([random.random((600, 2)), np.zeros((600, 1))], 1)
    near = nearest_neighbours(plane)
    normal, planarity = shape_at(plane, near, np.tile([0.0, 0, 1], (600, 1)))
    np.testing.assert_allclose(normal, np.tile([0, 0, 1], (600, 1)), atol=1e-5)
    cloud = random.random((600, 3))
    _, rough = shape_at(cloud, nearest_neighbours(cloud), cloud)
    assert np.median(planarity[:, 0]) > 1.5 * np.median(rough[:, 0])
