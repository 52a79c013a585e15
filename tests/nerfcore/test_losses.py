"""The loss terms: values, gradients where they matter, and the batches that once gave NaN."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import LossConfig
from fieldwork.nerfcore.data.pixels import VOID, Batch
from fieldwork.nerfcore.kernels.packed_info import PackedInfo
from fieldwork.nerfcore.train import losses
from fieldwork.nerfcore.train.schedule import bias_correction, rate_factor


def test_color_losses() -> None:
    a, b = torch.tensor([[0.5, 0.5, 0.5]]), torch.tensor([[0.5, 0.55, 0.9]])
    assert float(losses.color_loss(a, b, LossConfig(rgb="mse"))) == pytest.approx((0.05**2 + 0.4**2) / 3)
    huber = (0.5 * 0.05**2 / 0.1 + (0.4 - 0.05)) / 3
    assert float(losses.color_loss(a, b, LossConfig())) == pytest.approx(huber, rel=1e-5)


@pytest.mark.parametrize(("squared", "best"), [(True, 0.24), (False, 0.043)])
def test_one_guess_for_mostly_black_pixels_is_their_mean_where_errors_are_squared(squared: bool, best: float) -> None:
    """70 % black, 30 % at 0.8: the mean is 0.24; Huber's price is least where 70·x = 30·δ, near the median."""
    target = torch.zeros(1000, 3)
    target[:300] = 0.8
    guesses = torch.linspace(0, 1, 401)
    config = LossConfig()
    prices = [float(losses.color_loss(g.expand(1000, 3), target, config, squared)) for g in guesses]
    assert float(guesses[int(np.argmin(prices))]) == pytest.approx(best, abs=0.004)
    # Small errors cost the same in both.
    small = torch.full((1000, 3), 0.02)
    zero = torch.zeros(1000, 3)
    assert float(losses.color_loss(small, zero, config, squared)) == pytest.approx(0.002, rel=1e-4)


def test_a_batch_without_labels_costs_nothing_and_is_not_nan() -> None:
    probabilities = torch.full((4, 3), 0.2, requires_grad=True)
    none = torch.zeros(4, dtype=torch.bool)
    loss = losses.semantic_loss(probabilities, torch.full((4,), 255), none) + losses.entropy_loss(probabilities, none)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert bool((probabilities.grad == 0).all())


def test_cross_entropy_counts_labelled_rays_only() -> None:
    probabilities = torch.tensor([[0.5, 0.25], [0.1, 0.8], [0.9, 0.1]])
    labels, valid = torch.tensor([0, 1, 255]), torch.tensor([True, True, False])
    expected = -(math.log(0.5) + math.log(0.8)) / 2
    assert float(losses.semantic_loss(probabilities, labels, valid)) == pytest.approx(expected, rel=1e-5)
    soft = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])
    assert float(losses.semantic_loss(probabilities, soft, valid)) == pytest.approx(expected, rel=1e-5)


def test_rays_count_by_their_weight() -> None:
    label, weight = torch.tensor([0, 1, VOID, 0]), torch.tensor([1.0, 0.25, 1.0, 1.0])
    alpha, none = torch.tensor([1.0, 1.0, 1.0, 0.0]), torch.zeros(4, dtype=torch.int64)
    nowhere = torch.zeros(4, 3)
    batch = Batch(nowhere, nowhere, nowhere, alpha, label, none, none, torch.ones(4), weight)
    counted = losses.label_weights(batch)
    assert counted.tolist() == [1.0, 0.5, 0.0, 0.0]  # half of the correction
    probabilities = torch.tensor([[0.5, 0.25], [0.1, 0.8], [0.9, 0.1], [0.9, 0.1]])
    expected = -(math.log(0.5) + math.log(0.8) / 2) / 1.5
    assert float(losses.semantic_loss(probabilities, label, counted)) == pytest.approx(expected, rel=1e-5)
    entropy = [-sum(p * math.log(p) for p in row) for row in probabilities.tolist()]
    expected = -(entropy[0] + entropy[1] / 2) / 1.5
    assert float(losses.entropy_loss(probabilities, counted)) == pytest.approx(expected, rel=1e-5)


def test_labels_move_weight_along_a_ray_but_not_its_opacity() -> None:
    weights = torch.tensor([0.3, 0.2], requires_grad=True)
    classes = torch.tensor([[0.9, 0.1], [0.2, 0.8]])
    kept = losses.at_given_opacity((weights[:, None] * classes).sum(0)[None], weights.sum()[None])
    assert kept[0].tolist() == pytest.approx([0.31, 0.19])
    (gradient,) = torch.autograd.grad(losses.semantic_loss(kept, torch.tensor([0]), torch.ones(1)), weights)
    assert gradient[0] < 0 < gradient[1]  # to the sample that has the class
    assert float(gradient @ weights.detach()) == pytest.approx(0, abs=1e-6)  # the opacity has no say


def test_the_entropy_term_pulls_towards_uncertainty() -> None:
    sure, unsure = torch.tensor([[0.98, 0.01]]), torch.tensor([[0.5, 0.5]])
    everywhere = torch.tensor([True])
    assert losses.entropy_loss(unsure, everywhere) < losses.entropy_loss(sure, everywhere)


@pytest.mark.parametrize("kind", ["exponential", "cauchy", "l1"])
def test_sparsity_is_zero_for_nothing_and_grows_with_density(kind: str) -> None:
    config = LossConfig(sparsity=kind)
    values = [float(losses.sparsity_loss(torch.full((8,), d), config)) for d in (0.0, 1.0, 10.0)]
    assert values[0] == 0.0
    assert values[0] < values[1] < values[2]


def test_distortion_equals_its_double_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    count, rays = 5, 3
    w = torch.rand(rays * count, generator=generator) / count
    s = torch.rand(rays, count, generator=generator).sort(1).values.reshape(-1)
    d = torch.rand(rays * count, generator=generator) * 0.1
    start = torch.arange(rays, dtype=torch.int32) * count
    packed_info = PackedInfo(
        start, torch.full((rays,), count, dtype=torch.int32), torch.repeat_interleave(torch.arange(rays), count).int()
    )
    W, S, D = (x.view(rays, count) for x in (w, s, d))
    pairs = (W[:, :, None] * W[:, None] * (S[:, :, None] - S[:, None]).abs()).sum((1, 2))
    expected = (pairs + (W * W * D).sum(1) / 3).mean()
    assert float(losses.distortion_loss(w, s, d, packed_info)) == pytest.approx(float(expected), rel=1e-5)


def test_schedule() -> None:
    assert rate_factor(0.0, 0.33) == 1.0
    assert rate_factor(0.95, 0.33) == pytest.approx(0.33**3)
    assert bias_correction(1) == pytest.approx(1.0)
    assert bias_correction(100000) == pytest.approx(1.0)
