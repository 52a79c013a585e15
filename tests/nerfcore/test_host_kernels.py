"""Kernels written for CPUs against the torch operations and the kernels for every device that they stand for."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from fieldwork.nerfcore.config import FieldConfig
from fieldwork.nerfcore.field import mlp
from fieldwork.nerfcore.field.encoding import encoded_positions, frequency_encoding
from fieldwork.nerfcore.field.hybrid import HybridField
from fieldwork.nerfcore.kernels import cells, march, network_host
from fieldwork.nerfcore.kernels.device import using_kernels
from fieldwork.nerfcore.kernels.field_host import EARLY_STOP
from fieldwork.nerfcore.kernels.inputs_host import blend_weights, encode_frequencies
from fieldwork.nerfcore.kernels.packed_info import PackedInfo
from fieldwork.nerfcore.kernels.traversal import PDF_DEFAULT, PDF_LITERAL, PDF_UNIFORM, MarchSettings, skip_distances

CORNERS = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])


def points_of(count: int, seed: int = 0) -> torch.Tensor:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    points[:8] = CORNERS[:count]
    return points


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    assert a.shape == b.shape
    return float((a - b).abs().max() / b.abs().max().clamp(min=1e-12)) if a.numel() else 0.0


@pytest.mark.parametrize("octaves", [1, 2, 8])
def test_frequencies_are_those_of_the_definition(octaves: int) -> None:
    points = points_of(1000)
    exact = frequency_encoding(points.double(), octaves)
    ours = encode_frequencies(points, octaves, torch.float32)
    # Each octave doubles what rounding did to the one before.
    assert float((ours - exact).abs().max()) < 1e-6 * 2**octaves
    assert torch.equal(encode_frequencies(points, octaves, torch.bfloat16), ours.bfloat16())


def test_positions_that_have_a_gradient_keep_it() -> None:
    points = points_of(20).requires_grad_()
    encoded = encoded_positions(points, 3, torch.float32)
    (gradient,) = torch.autograd.grad(encoded.sum(), points)
    assert float(gradient.abs().min()) > 0


@pytest.mark.parametrize("side", [2, 16])
def test_blend_weights_are_those_of_the_formula(side: int) -> None:
    evidence, points = torch.rand(side**3, generator=torch.Generator().manual_seed(1)), points_of(500)
    with using_kernels("torch"):
        expected = 1 - 0.6 * torch.exp(-8 * cells.trilinear(evidence, side, points))
    assert relative(blend_weights(evidence, side, points, 0.4, 8.0), expected) < 1e-6


@pytest.mark.parametrize("count", [0, 1, 47, 48, 49, 1000])
@pytest.mark.parametrize("sizes", [(51, 64, 32), (32, 64, 64, 3), (5, 9, 3), (7, 128, 2), (4, 3), (80, 64, 40)])
def test_chains_of_layers_and_their_gradients_are_those_of_torch(sizes: tuple[int, ...], count: int) -> None:
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(count, sizes[0], generator=generator, requires_grad=True)
    layers = [torch.randn(b, a, generator=generator).requires_grad_() for a, b in pairwise(sizes)]
    upstream = torch.randn(count, sizes[-1], generator=generator)
    out, kept = network_host.forward([(x.detach(), None)], layers, keep=True)
    grad_input, grads = network_host.backward(upstream, x.detach(), kept, layers, True)
    expected = x
    for layer in layers[:-1]:
        expected = (expected @ layer.t()).relu()
    expected = expected @ layers[-1].t()
    theirs = torch.autograd.grad(expected, [x, *layers], upstream)
    assert relative(out, expected.detach()) < 1e-5
    # What is within rounding of 0 in a hidden layer may be on its other side: single entries only.
    assert grad_input is not None
    for a, b in zip([grad_input, *grads], theirs):
        assert a.shape == b.shape
        off = (a - b).abs() > 1e-4 * b.abs().amax() if b.numel() else b > 0
        assert float(off.float().sum()) <= 2e-3 * off.numel()
    if count:
        assert network_host.backward(upstream, x.detach(), kept, layers, False)[0] is None


@pytest.mark.parametrize("number", [1, 2, 3])
def test_rows_are_put_together_of_rows_of_several_arrays(number: int) -> None:
    generator = torch.Generator().manual_seed(6)
    arrays = [torch.randn(m, width, generator=generator) for m, width in ((40, 5), (7, 16), (100, 3))][:number]
    width = sum(a.shape[1] for a in arrays)
    layers = [torch.randn(32, width, generator=generator), torch.randn(4, 32, generator=generator)]
    for count in (0, 1, 60):
        parts = [(a, torch.randint(0, len(a), (count,), generator=generator)) for a in arrays]
        joined = torch.cat([a[rows] for a, rows in parts], 1)
        expected = (joined @ layers[0].t()).relu() @ layers[1].t()
        assert relative(network_host.forward(parts, layers)[0], expected) < 1e-5


def test_networks_use_them_unless_they_are_too_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    narrow, wide = mlp.MLP(20, 4, 64), mlp.MLP(20, 4, 256)
    x = torch.randn(30, 20)
    expected = [network(x, torch.float32).detach() for network in (narrow, wide)]
    monkeypatch.setattr(network_host, "forward", lambda *_, **__: pytest.fail("called"))
    assert torch.equal(wide(x, torch.float32), expected[1])
    with using_kernels("torch"):
        assert relative(narrow(x, torch.float32).detach(), expected[0]) < 1e-5


@pytest.mark.parametrize("thinning", [False, True])
@pytest.mark.parametrize("levels", [3, 8])
@pytest.mark.parametrize(
    ("branch", "fusion"), [("hybrid", "concat"), ("hybrid", "blend"), ("explicit", "concat"), ("implicit", "concat")]
)
def test_a_field_is_read_as_its_separate_operations_read_it(
    branch: str, fusion: str, levels: int, thinning: bool
) -> None:
    torch.manual_seed(3)
    config = FieldConfig(branch=branch, fusion=fusion, precision="float32", levels=levels, finest=64, octaves=4)  # type: ignore[arg-type]
    field = HybridField(config, 5, 0, thinning)
    field.gains = [1.0] * (levels - 1) + [0.5]
    if field.grid is not None:
        field.grid.table.normal_()
    if field.blend is not None:
        field.blend.evidence.uniform_()
    with torch.no_grad():
        for warming_up in (False, True):
            if field.blend is not None:
                field.blend.warming_up = warming_up
            for count in (0, 1, 48, 1000):
                points = points_of(count)
                ours = field.geometry(points)
                with using_kernels("torch"):
                    theirs = field.geometry(points)
                for a, b in zip(vars(ours).values(), vars(theirs).values()):
                    assert (a is None) == (b is None)
                    assert a is None or relative(a, b) < 1e-4


def test_the_density_along_rays_is_read_until_they_are_opaque() -> None:
    torch.manual_seed(4)
    field = HybridField(FieldConfig(precision="float32", levels=3, finest=64, octaves=4, density_shift=0.0), 0)
    counts = torch.tensor([40, 0, 25, 60], dtype=torch.int32)
    starts = torch.tensor([0, 40, 40, 65], dtype=torch.int32)
    points, deltas = points_of(125), torch.full((125,), 0.5)
    rays = PackedInfo(starts, counts, torch.repeat_interleave(torch.arange(4, dtype=torch.int32), counts.long()))
    found, every = field.density_along(points, deltas, rays), field.density(points).detach()
    for start, count in zip(starts.tolist(), counts.tolist()):
        own = every[start : start + count]
        passed = torch.cumsum(own * deltas[:count], 0)
        seen = torch.cat([torch.ones(1), torch.exp(-passed)])[:count] >= EARLY_STOP
        assert count == 0 or 0 < seen.sum() < count, "the ray becomes opaque on its way"
        torch.testing.assert_close(found[start : start + count], own * seen, rtol=1e-4, atol=1e-6)
    with using_kernels("torch"):
        torch.testing.assert_close(field.density_along(points, deltas, rays), every, rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_the_density_along_rays_is_that_of_single_points_to_the_bit_until_enough_is_known() -> None:
    torch.manual_seed(4)
    field = HybridField(FieldConfig(precision="float32", levels=3, finest=64, octaves=4, density_shift=0.0), 0)
    starts, counts = torch.tensor([0, 50], dtype=torch.int32), torch.tensor([50, 30], dtype=torch.int32)
    points, deltas = points_of(80), torch.full((80,), 0.5)
    rays = PackedInfo(starts, counts, torch.repeat_interleave(torch.arange(2, dtype=torch.int32), counts.long()))
    found, every = field.density_until(0.3, points, deltas, rays), field.density(points)
    for some in (slice(0, 50), slice(50, 80)):
        passed = torch.cumsum(every[some] * 0.5, 0)
        before = torch.cat([torch.ones(1), torch.exp(-passed)])[:-1]
        assert torch.equal(found[some], torch.where(before < 0.3, 0.0, every[some]))
    with using_kernels("torch"):
        torch.testing.assert_close(field.density_until(0.3, points, deltas, rays), every, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("mode", [PDF_DEFAULT, PDF_UNIFORM, PDF_LITERAL])
def test_sixteen_rays_at_a_time_meet_what_one_does(
    mode: int, contracted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = torch.Generator().manual_seed(4)
    n = 32
    density = torch.rand(n, n, n, generator=generator) * 30
    empty_blocks = torch.rand(n // 4, n // 4, n // 4, generator=generator) < 0.7
    density[empty_blocks.repeat_interleave(4, 0).repeat_interleave(4, 1).repeat_interleave(4, 2)] = 0
    grid = torch.stack([density.flatten(), torch.rand(n**3, generator=generator)], 1)
    for count in (1, 16, 17, 900):
        origins = torch.randn(count, 3, generator=generator)
        directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
        directions[0] = torch.tensor([0.0, 0.0, 1.0])
        jitter = torch.rand(count, generator=generator)
        for empty in (0.0, 0.5):
            s = MarchSettings(n, 0.05, far=20.0, contracted=contracted, mode=mode, empty_distance=empty)
            given = origins, directions, grid, skip_distances(density > 0), s, jitter
            ours = march.coarse_march(*given)
            with monkeypatch.context() as patch:
                patch.setattr(march, "on_host", lambda device: False)
                theirs = march.coarse_march(*given)
            assert relative(ours[0], theirs[0]) < 1e-5
            # A bin whose edge is within rounding of a cell's may fall on its other side: single rays only.
            same = (ours[3] == theirs[3]) & ((ours[1] - theirs[1]).abs() < 1e-4) & ((ours[2] - theirs[2]).abs() < 1e-4)
            assert float((~same).float().sum()) <= 2e-3 * count
            assert count < 900 or float((ours[3] > 0).float().mean()) > 0.3


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize(
    ("mode", "per_bin"), [(PDF_DEFAULT, 0.0), (PDF_DEFAULT, 1.25), (PDF_UNIFORM, 0.0), (PDF_LITERAL, 0.0)]
)
def test_sixteen_rays_at_a_time_get_the_samples_that_one_gets(
    mode: int, per_bin: float, contracted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = torch.Generator().manual_seed(5)
    n = 32
    density = torch.rand(n, n, n, generator=generator) * 30
    density[torch.rand(n, n, n, generator=generator) < 0.8] = 0
    grid = torch.stack([density.flatten(), torch.rand(n**3, generator=generator)], 1)
    for count in (1, 700):
        origins = torch.randn(count, 3, generator=generator)
        directions = torch.nn.functional.normalize(-origins + 0.3 * torch.randn(count, 3, generator=generator), dim=1)
        jitter, shift = torch.rand(count, generator=generator), torch.rand(8 * count, generator=generator)
        s = MarchSettings(n, 0.05, far=20.0, contracted=contracted, mode=mode, per_bin=per_bin)
        given = origins, directions, grid, skip_distances(density > 0), s, 8, jitter, shift
        ours = march.sample(*given)
        with monkeypatch.context() as patch:
            patch.setattr(march, "on_host", lambda device: False)
            theirs = march.sample(*given)
        assert torch.equal(ours.packed_info.ray_indices, theirs.packed_info.ray_indices)
        assert count == 1 or len(ours) > 500
        for name in ("points", "t", "deltas"):
            off = (getattr(ours, name) - getattr(theirs, name)).abs() > 1e-4
            # A sample at the edge of a bin of no weight may fall on its other side: single ones only.
            assert float(off.float().sum()) <= 2e-3 * off.numel(), name
