"""The vertex grid's kernels of every backend, and both kinds of the CPU: features, gradients and the optimiser."""

from __future__ import annotations

import pytest
import torch
from fieldwork.nerfcore.kernels import encode, encode_points
from fieldwork.nerfcore.kernels.device import Kernels, using_kernels
from fieldwork.tests.nerfcore.support import encode_reference

LEVELS = [(5, 0, 125), (17, 128, 4913), (64, 5056, 1 << 12)]  # two dense, one hashed
GAINS = [1.0, 0.5, 1.0]
ROWS = 5056 + (1 << 12)


@pytest.fixture(autouse=True, params=["host", "every device"])
def kernels_of(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU runs its own kernels, and those that GPUs run."""
    if request.param == "every device":
        monkeypatch.setattr(encode, "on_host", lambda device: False)


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).detach().abs().max() / b.detach().abs().max().clamp(min=1e-12))


def test_encode_equals_its_reference_and_so_does_its_gradient(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(1)
    table = torch.randn(ROWS, encode.FEATURES, generator=generator).to(device)
    points = torch.rand(3000, 3, generator=generator).to(device)
    points[:8] = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)], device=device)
    expected_table = table.clone().requires_grad_()
    expected = encode_reference.forward(expected_table, LEVELS, GAINS, points)
    assert relative(encode.forward(table, LEVELS, GAINS, points), expected) <= 1e-5
    upstream = torch.randn(expected.shape, generator=generator).to(device)
    expected.backward(upstream)
    gradient, touched = torch.zeros_like(table), torch.zeros(ROWS // encode.BLOCK, dtype=torch.uint8, device=device)
    encode.scatter(gradient, touched, LEVELS, GAINS, [(points, upstream)])
    assert expected_table.grad is not None
    assert relative(gradient, expected_table.grad) <= 1e-4
    blocks = (expected_table.grad.abs().sum(1) > 0).view(-1, encode.BLOCK).any(1)
    assert torch.equal(touched.bool() & blocks, blocks)


@pytest.mark.parametrize("resolution", [1300, 50000])  # its third, and its second power is beyond 2³¹
def test_a_level_of_more_vertices_than_32_bits_number_is_hashed(device: torch.device, resolution: int) -> None:
    generator = torch.Generator().manual_seed(13)
    levels = [(resolution, 0, 1 << 21)]
    table = torch.randn(1 << 21, encode.FEATURES, generator=generator).to(device)
    points = (torch.rand(200, 3, generator=generator) / resolution).to(device).requires_grad_()
    expected = encode_reference.forward(table, levels, [1.0], points)
    assert relative(encode.forward(table, levels, [1.0], points.detach()), expected) <= 1e-5
    expected.sum().backward()
    ours = encode_points.backward_points(table, levels, [1.0], points.detach(), torch.ones_like(expected))
    assert points.grad is not None
    assert relative(ours, points.grad) <= 1e-4


def test_the_gradient_of_encoded_points_equals_its_reference(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(11)
    table = torch.randn(ROWS, encode.FEATURES, generator=generator).to(device)
    points = torch.rand(3000, 3, generator=generator).to(device).requires_grad_()
    expected = encode_reference.forward(table, LEVELS, GAINS, points)
    upstream = torch.randn(expected.shape, generator=generator).to(device)
    expected.backward(upstream)
    assert points.grad is not None
    ours = encode_points.backward_points(table, LEVELS, GAINS, points.detach(), upstream)
    assert relative(ours, points.grad) <= 1e-4
    coarse = encode_points.backward_points(table, LEVELS, [1.0, 0.0, 0.0], points.detach(), upstream)
    assert relative(coarse, ours) > 0.5


def test_the_gradient_of_encoded_points_agrees_with_finite_differences(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(12)
    table = torch.randn(ROWS, encode.FEATURES, generator=generator).to(device)
    # In the middle of the finest level's cells, so that the steps stay inside one cell of every level.
    cells_ = torch.randint(0, 63, (64, 3), generator=generator)
    points = (cells_ + 0.5) / 63
    step = 2e-4
    for resolution in (5, 17):
        f = points * (resolution - 1)
        points = points[((f - f.round()).abs() > 0.02).all(1)]
    assert len(points) > 20
    points = points.to(device)
    upstream = torch.randn(len(points), len(LEVELS) * encode.FEATURES, generator=generator).to(device)
    ours = encode_points.backward_points(table, LEVELS, GAINS, points, upstream)
    for axis in range(3):
        shift = torch.zeros(3, device=device)
        shift[axis] = step
        ahead = encode.forward(table, LEVELS, GAINS, points + shift)
        behind = encode.forward(table, LEVELS, GAINS, points - shift)
        difference = ((ahead - behind) * upstream).sum(1) / (2 * step)
        assert relative(ours[:, axis], difference) < 5e-3


@pytest.mark.parametrize("kernels", ["warp", "torch"])
def test_the_gradient_scatter_gives_the_same_bits_every_time(kernels: Kernels) -> None:
    generator = torch.Generator().manual_seed(2)
    points = torch.rand(20000, 3, generator=generator)
    upstream = torch.randn(20000, len(LEVELS) * encode.FEATURES, generator=generator)

    def gradient() -> torch.Tensor:
        total = torch.zeros(ROWS, encode.FEATURES)
        touched = torch.zeros(ROWS // encode.BLOCK, dtype=torch.uint8)
        with using_kernels(kernels):
            encode.scatter(total, touched, LEVELS, GAINS, [(points, upstream)])
        return total

    first = gradient()
    assert all(torch.equal(first, gradient()) for _ in range(3))


def test_adam_moves_touched_rows_only(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(3)
    values = [torch.randn(ROWS, encode.FEATURES, generator=generator).to(device) for _ in range(3)]
    table, mean, square = values[0], values[1], values[2].abs()
    gradient = torch.randn(ROWS, encode.FEATURES, generator=generator).to(device)
    gradient[::3] = 0
    expected = [x.clone() for x in (table, gradient, mean, square)]
    encode_reference.adam(*expected, rate=0.01)
    before = table.clone()
    touched = torch.ones(ROWS // encode.BLOCK, dtype=torch.uint8, device=device)
    lost = torch.zeros(1, dtype=torch.int32, device=device)
    encode.adam(table, gradient, mean, square, touched, lost, 0.01)
    assert int(lost) == 0
    for ours, theirs in zip((table, gradient, mean, square), expected):
        assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-7)
    assert torch.equal(table[::3], before[::3])
    assert not touched.any()


def test_a_row_whose_gradient_is_not_finite_is_skipped_counted_and_moves_again(device: torch.device) -> None:
    table, gradient, mean, square = (torch.zeros(2 * encode.BLOCK, encode.FEATURES, device=device) for _ in range(4))
    touched, lost = (torch.zeros(n, dtype=d, device=device) for n, d in ((2, torch.uint8), (1, torch.int32)))
    for bad in (float("nan"), float("inf"), 1e30):  # the last one's square is not finite
        gradient[3, 1] = bad
        gradient[4] = 1.0
        touched[:] = 1
        encode.adam(table, gradient, mean, square, touched, lost, 0.01)
        assert not gradient.any()
    assert int(lost) == 3
    assert not table[3].any()
    assert bool((table[4] < 0).all())
    gradient[3] = 1.0
    touched[:] = 1
    encode.adam(table, gradient, mean, square, touched, lost, 0.01)
    assert bool((table[3] < 0).all())
    assert all(bool(torch.isfinite(x).all()) for x in (table, mean, square))
