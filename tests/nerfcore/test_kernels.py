"""Every kernel of every backend against a reference, gradients against autograd and finite differences, and their
invariants."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from fieldwork.nerfcore.kernels import cells, composite, march, traversal
from fieldwork.nerfcore.kernels.device import Kernels, backend_of, using_kernels
from fieldwork.nerfcore.kernels.packed_info import PackedInfo
from fieldwork.nerfcore.kernels.traversal import PDF_DEFAULT, PDF_LITERAL, PDF_UNIFORM, MarchSettings
from fieldwork.tests.nerfcore.support import (
    cells_reference,
    composite_reference,
    march_reference,
)
from hypothesis import given, settings
from hypothesis import strategies as st

LEVELS = [(5, 0, 125), (17, 128, 4913), (64, 5056, 1 << 12)]  # two dense, one hashed
GAINS = [1.0, 0.5, 1.0]
ROWS = 5056 + (1 << 12)


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).detach().abs().max() / b.detach().abs().max().clamp(min=1e-12))


def random_packed_info(rays: int, generator: torch.Generator, device: torch.device) -> PackedInfo:
    count = torch.randint(0, 9, (rays,), generator=generator, dtype=torch.int32)
    count[0] = 0
    start = torch.cumsum(count, 0, dtype=torch.int32) - count
    ray = torch.repeat_interleave(torch.arange(rays, dtype=torch.int32), count.long())
    return PackedInfo(start.to(device), count.to(device), ray.to(device))


def test_weights_and_sums_equal_their_references_and_so_do_their_gradients(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(4)
    packed_info = random_packed_info(60, generator, device)
    n = len(packed_info.ray_indices)
    density = (torch.rand(n, generator=generator) * 5).to(device).requires_grad_()
    deltas = torch.rand(n, generator=generator).to(device)
    values = torch.randn(n, 7, generator=generator).to(device).requires_grad_()
    upstream = torch.randn(60, 7, generator=generator).to(device)
    results = []
    for module in (composite, composite_reference):
        weights = module.render_weights(density, deltas, packed_info)
        total = module.weighted_sum(values, weights, packed_info)
        results.append((weights, total, *torch.autograd.grad((total * upstream).sum(), (density, values))))
    for ours, theirs in zip(*results):
        assert relative(ours, theirs) <= 1e-5 if ours.shape != density.shape else relative(ours, theirs) <= 1e-4


def test_sums_in_front_equal_their_reference_and_unused_entries_have_none(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(6)
    packed = random_packed_info(60, generator, device)
    n, unused = len(packed.ray_indices), 5
    packed_info = PackedInfo(
        packed.starts, packed.counts, torch.nn.functional.pad(packed.ray_indices, (0, unused), value=-1)
    )
    values = torch.randn(n + unused, generator=generator).to(device).requires_grad_()
    upstream = torch.randn(n + unused, generator=generator).to(device)
    results = []
    for module in (composite, composite_reference):
        sums = module.sums_in_front(values, packed_info)
        results.append((sums, *torch.autograd.grad((sums * upstream).sum(), values)))
        assert bool((sums[n:] == 0).all())
    for ours, theirs in zip(*results):
        assert relative(ours, theirs) <= 1e-5


def test_weight_gradient_agrees_with_finite_differences(device: torch.device) -> None:
    start, count, ray = (torch.tensor(x, dtype=torch.int32, device=device) for x in ([0], [6], [0] * 6))
    packed_info = PackedInfo(start, count, ray)
    density = torch.tensor([0.1, 2.0, 0.5, 3.0, 0.0, 1.0], device=device, requires_grad=True)
    deltas = torch.tensor([0.3, 0.1, 0.4, 0.2, 0.5, 0.2], device=device)
    upstream = torch.tensor([1.0, -2.0, 0.5, 3.0, 1.0, -1.0], device=device)

    def value(d: torch.Tensor) -> torch.Tensor:
        return (composite.render_weights(d, deltas, packed_info) * upstream).sum()

    (gradient,) = torch.autograd.grad(value(density), density)
    for k in range(6):
        step = torch.zeros(6, device=device)
        step[k] = 1e-2
        difference = (value(density.detach() + step) - value(density.detach() - step)) / 2e-2
        assert abs(float(gradient[k] - difference)) < 2e-3


@pytest.mark.parametrize("kernels", ["warp", "torch"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=25)
def test_weights_never_exceed_one_and_transmittance_falls(kernels: Kernels, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    packed_info = random_packed_info(20, generator, torch.device("cpu"))
    density = torch.rand(len(packed_info.ray_indices), generator=generator) * 10 ** float(
        torch.randint(-3, 4, (1,), generator=generator)
    )
    with using_kernels(kernels):
        weights = composite.render_weights(density, torch.rand(len(density), generator=generator), packed_info)
        total = composite.weighted_sum(torch.ones(len(weights), 1), weights, packed_info)
    assert bool((weights >= 0).all())
    assert bool((total <= 1 + 1e-5).all())


def test_cell_reading_and_maxima_equal_their_references(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(5)
    grid = torch.rand(16**3, generator=generator).to(device)
    points = torch.rand(4000, 3, generator=generator).to(device)
    values = torch.rand(4000, generator=generator).to(device)
    assert relative(cells.trilinear(grid, 16, points), cells_reference.trilinear(grid, 16, points)) <= 1e-5
    assert torch.equal(cells.scatter_max(16, points, values), cells_reference.scatter_max(16, points, values))


def random_cells(n: int, share: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    occupied = torch.rand(n, n, n, generator=generator) < share
    occupied[: n // 2] = False  # whole blocks to skip
    density = torch.where(occupied, torch.rand(n, n, n, generator=generator) * 20, 0.0)
    grid = torch.stack([density.reshape(-1), torch.rand(n**3, generator=generator)], 1).contiguous()
    return grid, traversal.skip_distances(occupied)


def random_rays(count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    origin = torch.randn(count, 3, generator=generator)
    origin = origin / origin.norm(dim=1, keepdim=True) * 3
    direction = torch.rand(count, 3, generator=generator) * 1.2 - 0.6 - origin
    return origin, direction / direction.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("mode", [PDF_DEFAULT, PDF_UNIFORM, PDF_LITERAL])
@pytest.mark.parametrize("contracted", [False, True])
def test_marching_equals_its_reference(device: torch.device, mode: int, contracted: bool) -> None:
    generator = torch.Generator().manual_seed(6)
    n, count, rays = 16, 8, 40
    grid, skip_distance = random_cells(n, 0.3, generator)
    origin, direction = random_rays(rays, generator)
    jitter, shift = torch.rand(rays, generator=generator), torch.rand(rays * count, generator=generator)
    s = MarchSettings(n, 0.06, far=50.0, contracted=contracted, mode=mode)
    on = [x.to(device) for x in (origin, direction, grid, skip_distance)]
    samples = march.sample(*on, s, count, jitter.to(device), shift.to(device))
    t, deltas = samples.t.cpu(), samples.deltas.cpu()
    agreeing = hits = 0
    for r in range(rays):
        bins = march_reference.traverse(origin[r], direction[r], float(jitter[r]), grid, s)
        assert (int(samples.packed_info.counts[r]) > 0) == bool(bins)
        if not bins:
            continue
        hits += 1
        base = int(samples.packed_info.starts[r])
        expected = march_reference.sample_ray(bins, count, shift[base : base + count].tolist())
        ours = t[base : base + count], deltas[base : base + count]
        agreeing += all(torch.allclose(o, torch.tensor(e), atol=2e-4, rtol=1e-3) for o, e in zip(ours, expected))
    # A ray that passes within rounding of a cell's edge may see one bin more or less.
    assert hits > 20
    assert agreeing >= 0.9 * hits


@pytest.mark.parametrize("kernels", ["warp", "torch"])
@given(seed=st.integers(0, 10**6), mode=st.sampled_from([PDF_DEFAULT, PDF_UNIFORM]), count=st.integers(1, 24))
@settings(max_examples=25)
def test_samples_are_sorted_inside_the_open_interval_and_their_lengths_add_up(
    kernels: Kernels, seed: int, mode: int, count: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    grid, skip_distance = random_cells(16, 0.2, generator)
    origin, direction = random_rays(50, generator)
    s = MarchSettings(16, 0.0625, mode=mode)
    with using_kernels(kernels):
        samples = march.sample(origin, direction, grid, skip_distance, s, count, torch.rand(50), torch.rand(50 * count))
    hit = samples.packed_info.counts > 0
    t, deltas = samples.t.view(-1, count), samples.deltas.view(-1, count)
    assert bool((t.diff(dim=1) >= -1e-5).all())
    assert bool((t >= samples.t_first[hit, None] - s.step).all())
    assert bool((t <= samples.t_last[hit, None] + s.step).all())
    assert bool((deltas >= -1e-6).all())
    bins = (deltas.sum(1) / s.step).round()
    assert torch.allclose(deltas.sum(1), bins * s.step, atol=1e-4)
    assert bool(((samples.points >= 0) & (samples.points <= 1)).all())


@pytest.mark.parametrize("kernels", ["warp", "torch"])
@pytest.mark.parametrize("contracted", [False, True])
def test_a_ray_that_ends_early_gets_all_of_its_samples_before_its_end(kernels: Kernels, contracted: bool) -> None:
    """As if the march ended there for all rays."""
    generator = torch.Generator().manual_seed(8)
    grid, skip_distance = random_cells(16, 0.3, generator)
    origin, direction = random_rays(60, generator)
    s = MarchSettings(16, 0.06, far=50.0, contracted=contracted)
    on = origin, direction, grid, skip_distance
    jitter = torch.rand(60, generator=generator)
    with using_kernels(kernels):
        whole = march.sample(*on, s, 8, jitter)
        for end in (0.5, 2.5, 3.1):
            expected = march.sample(*on, replace(s, far=end), 8, jitter)
            every_other = torch.where(torch.arange(60) % 2 == 0, end, 1000.0)
            found = march.sample(*on, s, 8, jitter, ends=every_other)
            for rays, other in ((slice(0, None, 2), expected), (slice(1, None, 2), whole)):
                assert torch.equal(found.packed_info.counts[rays], other.packed_info.counts[rays])
                assert torch.equal(found.t_last[rays], other.t_last[rays])
            of_cut = found.packed_info.ray_indices % 2 == 0
            theirs = expected.packed_info.ray_indices % 2 == 0
            for name in ("t", "deltas"):
                assert torch.allclose(getattr(found, name)[of_cut], getattr(expected, name)[theirs], atol=1e-5)
    assert len(whole) > 200


def test_an_empty_grid_gives_no_samples(device: torch.device) -> None:
    origin, direction = (x.to(device) for x in random_rays(10, torch.Generator().manual_seed(7)))
    closed = torch.full((4**3,), 8, dtype=torch.uint8, device=device)
    empty = torch.zeros(16**3, 2, device=device)
    samples = march.sample(origin, direction, empty, closed, MarchSettings(16, 0.06), 8)
    assert len(samples) == 0
    assert bool((samples.packed_info.counts == 0).all())


def test_importance_and_density_draw_samples(device: torch.device) -> None:
    n = 16
    grid = torch.zeros(n, n, n, 2)
    grid[:, :, 4:12, 0] = 0.5
    grid[:, :, 8:10, 1] = 1.0  # an important slab
    skip_distance = torch.zeros((n // 4) ** 3, dtype=torch.uint8)
    grid, skip_distance = grid.view(-1, 2).contiguous().to(device), skip_distance.to(device)
    origin, direction = (torch.tensor([x], device=device) for x in ([-3.0, 0.01, 0.01], [1.0, 0.0, 0.0]))

    def share(beta: float) -> float:
        s = MarchSettings(n, 0.125, beta=beta, epsilon=1e-4)
        samples = march.sample(origin, direction, grid, skip_distance, s, 64)
        x = samples.points[:, 0] * n
        return float(((x >= 8) & (x < 10)).float().mean())

    assert share(4.0) > 1.5 * share(0.0)


def test_rays_from_outside_start_where_nothing_was_seen_to_be(device: torch.device) -> None:
    """A cell in front of a far camera is passed over, the cube never is; reference and kernel agree."""
    n = 32
    grid = torch.full((n**3, 2), 1.0)
    skip_distance = torch.zeros((n // 4) ** 3, dtype=torch.uint8)
    origins = torch.tensor([[0.1, -5.0, 0.2], [0.1, -1.5, 0.2], [0.0, 0.5, 0.0]])
    directions = torch.tensor([[0.0, 1.0, 0.0]]).expand(3, 3).contiguous()
    s = MarchSettings(n, 0.125, far=50.0, contracted=True, empty_distance=2.0)
    on = [x.to(device) for x in (origins, directions, grid, skip_distance)]
    found = march.sample(*on, s, 4, torch.zeros(3, device=device))
    assert torch.allclose(found.t_first.cpu(), torch.tensor([2.0, 0.4, 0.02]), atol=1e-5)
    for i in range(3):
        bins = march_reference.traverse(origins[i], directions[i], 0.0, grid, s)
        assert bins[0][0] == pytest.approx(float(found.t_first[i]), abs=1e-5)


def test_cells_follow_the_mean_of_the_points_in_them(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(18)
    points, values = torch.rand(3000, 3, generator=generator), torch.rand(3000, generator=generator)
    values[::7] = -1.0
    grids = [torch.zeros(4**3) for _ in range(2)]
    grids[0] = grids[0].to(device)
    scratch = cells.MeanScratch(4**3, device)
    cells.average(grids[0], scratch, 4, points.to(device), values.to(device), 0.1)
    cells_reference.average(grids[1], 4, points, values, 0.1)
    assert relative(grids[0].cpu(), grids[1]) <= 1e-5
    assert float((grids[0] - 0.5).abs().max()) < 0.35
    assert not scratch.sums.any()


def test_the_order_of_points_does_not_change_their_mean(device: torch.device) -> None:
    """One after the other the last points would count most, and side by side updates would be lost."""
    generator = torch.Generator().manual_seed(19)
    points = torch.rand(5000, 3, generator=generator)
    values = torch.rand(5000, generator=generator) * 100
    grids = []
    for order in (torch.arange(5000), torch.arange(5000).flip(0), torch.randperm(5000, generator=generator)):
        grids.append(torch.full((4**3,), 3.0, device=device))
        scratch = cells.MeanScratch(4**3, device)
        cells.average(grids[-1], scratch, 4, points[order].to(device), values[order].to(device), 0.1)
    exact = backend_of(device).has_float64
    for grid in grids[1:]:
        assert torch.equal(grid, grids[0]) if exact else torch.allclose(grid, grids[0], rtol=1e-5)


def test_sums_without_64_bit_integers_come_close() -> None:
    generator = torch.Generator().manual_seed(20)
    points, values = torch.rand(3000, 3, generator=generator), torch.rand(3000, generator=generator) * 50
    exact, close = (torch.full((4**3,), 3.0) for _ in range(2))
    scratch = cells.MeanScratch(4**3, torch.device("cpu"))
    cells.average(exact, scratch, 4, points, values, 0.1)
    scratch.sums = scratch.sums.float()
    with using_kernels("torch"):
        cells.average(close, scratch, 4, points, values, 0.1)
    assert torch.allclose(exact, close, rtol=1e-5)


def test_observing_samples_equals_its_reference(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(8)
    # Several points a cell: each cell must decay once, whichever thread comes first.
    points, values = torch.rand(5000, 3, generator=generator), torch.rand(5000, generator=generator)
    grids = [torch.rand(8**3, generator=torch.Generator().manual_seed(9)) * 2 for _ in range(2)]
    grids[0] = grids[0].to(device)
    scratch = torch.full((8**3,), -1.0, device=device)
    cells.observe(grids[0], scratch, 8, points.to(device), values.to(device), 0.9)
    cells_reference.observe(grids[1], torch.full((8**3,), -1.0), 8, points, values, 0.9)
    assert torch.equal(grids[0].cpu(), grids[1])
    assert bool((scratch == -1).all())
