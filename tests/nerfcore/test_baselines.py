"""Other methods of the benchmark: the property each is known by, and that they learn a scene drawn from a formula."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.bench.baselines import mip_nerf, nerf, nerf_w, network
from fieldwork.nerfcore.bench.baselines.hash_grid import HashGrid, hash_levels
from fieldwork.nerfcore.bench.baselines.hierarchical import sample_pdf, stratified, uniforms
from fieldwork.nerfcore.bench.baselines.instant_ngp import LEAST_TRANSMITTANCE, MOST_SAMPLES, STEP, InstantNGP
from fieldwork.nerfcore.bench.baselines.method import (
    CONE,
    Baseline,
    Rays,
    Setup,
    camera_rays,
    ray_limits,
    ray_weights,
)
from fieldwork.nerfcore.bench.baselines.mip_nerf import cone_gaussians, integrated_encoding, widened
from fieldwork.nerfcore.bench.baselines.nerf import COARSE, FINE
from fieldwork.nerfcore.bench.baselines.ngp_occupancy import NGPOccupancy
from fieldwork.nerfcore.bench.baselines.registry import BASELINES, make_baseline
from fieldwork.nerfcore.bench.baselines.semantic_nerf import logits_loss
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import VOID, PixelStore
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.kernels.composite import render_weights, sums_in_front
from fieldwork.nerfcore.kernels.device import using_kernels
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.ball import ball_project

CPU = torch.device("cpu")
SETUP = Setup(classes=2, images=14, contracted=False, background=1.0, rays=64, device=CPU)


def rays_from(origin: list[float], direction: list[float], radius: float = 0.01) -> Rays:
    d = torch.tensor([direction], dtype=torch.float32)
    return Rays(torch.tensor([origin], dtype=torch.float32), d / d.norm(), torch.tensor([radius]))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PixelStore:
    scene = load_scene(ball_project(tmp_path_factory.mktemp("ball") / "p", side=24))
    return PixelStore(scene, scene.train, [1, 2], np.eye(4), 24, CPU, Reporter())


def learned(method: Baseline, store: PixelStore, steps: int) -> tuple[float, float]:
    """Mean squared error of the first tenth of the steps and of the last."""
    generator, errors = torch.Generator().manual_seed(0), []
    for step in range(steps):
        batch = store.batch(store.random_pixels(method.rays, generator))
        rays = camera_rays(store.rays, batch.image, batch.pixel, training=True)
        errors.append(method.train_step(batch, rays, step / steps, generator))
    tenth = max(steps // 10, 1)
    return float(np.mean(errors[:tenth])), float(np.mean(errors[-tenth:]))


@pytest.mark.parametrize(
    ("name", "parameters"),
    [("nerf", 1_191_688), ("mip-nerf", 612_740), ("instant-ngp", 12_196_240 + 32 * 64 + 64 * 16)],
)
def test_methods_have_the_parameters_of_their_publication(name: str, parameters: int) -> None:
    count = make_baseline(name, SETUP, 0).parameter_count()
    assert count == pytest.approx(parameters, rel=0.05 if name == "instant-ngp" else 0)


@pytest.mark.parametrize("seed", range(3))
def test_samples_follow_the_piecewise_constant_density_they_are_drawn_from(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(1, 9, generator=generator).cumsum(1)
    weights = torch.rand(1, 8, generator=generator)
    weights[0, 3] = 0
    drawn = sample_pdf(edges, weights, uniforms(1, 100_000, CPU, generator))[0]
    assert bool((drawn[1:] >= drawn[:-1]).all())
    counted = torch.histogram(drawn, edges[0]).hist / len(drawn)
    assert counted.numpy() == pytest.approx((weights / weights.sum())[0].numpy(), abs=0.01)
    # the inverse of the distribution, by hand
    one = sample_pdf(torch.tensor([[0.0, 1.0, 3.0]]), torch.tensor([[1.0, 3.0]]), torch.tensor([[0.125, 0.25, 0.625]]))
    assert one.numpy() == pytest.approx(np.array([[0.5, 1.0, 2.0]]), abs=1e-4)


def test_stratified_samples_have_one_place_in_each_part() -> None:
    t = stratified(torch.tensor([1.0]), torch.tensor([3.0]), 8, torch.Generator().manual_seed(1))[0]
    assert ((t - 1) / 0.25).floor().tolist() == list(range(8))


def test_weights_are_transmittance_times_opacity() -> None:
    density, deltas = torch.tensor([[0.5, 0.0, 2.0]]), torch.tensor([[1.0, 1.0, 0.5]])
    alpha = [1 - math.exp(-0.5), 0.0, 1 - math.exp(-1.0)]
    expected = [alpha[0], 0.0, math.exp(-0.5) * alpha[2]]
    assert ray_weights(density, deltas)[0].tolist() == pytest.approx(expected)


def test_rays_end_with_the_cube() -> None:
    near, far = ray_limits(rays_from([0, 0, -3], [0, 0, 1]), contracted=False)
    assert (float(near), float(far)) == pytest.approx((2.0, 4.0))
    near, far = ray_limits(rays_from([0, 0, 0], [1, 1, 0]), contracted=False)
    assert (float(near), float(far)) == pytest.approx((0.02, math.sqrt(2)))


def test_a_cones_gaussian_is_that_of_points_drawn_in_it() -> None:
    radius, t0, t1 = 0.2, 1.0, 2.0
    rays = rays_from([0.1, 0.2, 0.3], [1.0, 2.0, -1.0], radius)
    mean, variance = (x[0, 0].double().numpy() for x in cone_gaussians(rays, torch.tensor([[t0, t1]])))
    rng, d = np.random.default_rng(0), rays.directions[0].double().numpy()
    # uniform in the frustum: t with density t², then a disc of radius `radius` t
    t = (t0**3 + (t1**3 - t0**3) * rng.random(400_000)) ** (1 / 3)
    r, angle = radius * t * np.sqrt(rng.random(t.shape)), 2 * np.pi * rng.random(t.shape)
    side = np.cross(d, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    across = r[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(d, side))
    points = rays.origins[0].double().numpy() + t[:, None] * d + across
    assert points.mean(0) == pytest.approx(mean, abs=2e-3)
    # the paper's diagonal takes the cone's cross-section as isotropic around the axis: exact for this one
    assert points.var(0) == pytest.approx(variance, rel=0.02)
    draws = rng.normal(mean, np.sqrt(variance), (400_000, 3))
    encoded = integrated_encoding(torch.tensor(mean)[None], torch.tensor(variance)[None], octaves=3)[0]
    angles = (draws[:, None] * (2.0 ** np.arange(3))[:, None]).reshape(len(draws), -1)
    assert np.sin(angles).mean(0) == pytest.approx(encoded[:9].numpy(), abs=5e-3)
    assert np.cos(angles).mean(0) == pytest.approx(encoded[9:].numpy(), abs=5e-3)


def test_a_wide_cone_loses_its_high_octaves() -> None:
    encoded = [
        integrated_encoding(*(x.reshape(-1, 3) for x in cone_gaussians(rays_from([0, 0, 0], [1, 1, 1], r), edges)))
        for r, edges in ((1e-6, torch.tensor([[1.0, 1.000001]])), (0.2, torch.tensor([[1.0, 1.3]])))
    ]
    assert float(encoded[0].abs().max()) > 0.9
    assert float(encoded[1].view(2, 16, 3)[:, 8:].abs().max()) < 1e-3
    assert float(encoded[1].view(2, 16, 3)[:, 0].abs().max()) > 0.3


def test_pixels_are_as_wide_as_the_distance_to_their_neighbour(store: PixelStore) -> None:
    middle = torch.tensor([12 * 24 + 12])
    rays = camera_rays(store.rays, torch.zeros(1, dtype=torch.long), middle, training=False)
    assert float(rays.radii) == pytest.approx(CONE / (1.375 * 24), rel=0.01)
    assert rays.images is None


def test_the_fine_level_is_drawn_from_widened_weights() -> None:
    weights = torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0]])
    assert widened(weights)[0].tolist() == pytest.approx([0.01, 0.51, 1.01, 0.51, 0.01])


def test_fine_hash_levels_collide_and_coarse_ones_do_not() -> None:
    levels = hash_levels()
    assert [levels[0][0], levels[-1][0], len(levels)] == [17, 2049, 16]
    assert levels[0][2] == 17**3
    assert levels[-1][2] == 2**19
    from fieldwork.nerfcore.kernels.encode_torch import rows_of

    vertices = torch.tensor([[1, 2, 3], [100, 7, 2000], [2048, 2048, 2048]])
    wrapped = [(x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % 2**19 for x, y, z in vertices.tolist()]
    assert (rows_of(vertices, *levels[-1]) - levels[-1][1]).tolist() == wrapped
    axis = torch.arange(0, 17)
    every = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3)
    assert len(rows_of(every, *levels[0]).unique()) == 17**3
    # as many distinct rows as balls in bins
    drawn = torch.randint(0, 2049, (2**19, 3), generator=torch.Generator().manual_seed(0))
    assert len(rows_of(drawn, *levels[-1]).unique()) / 2**19 == pytest.approx(1 - math.exp(-1), abs=0.01)


def test_the_hash_grids_kernels_agree_with_their_twin() -> None:
    torch.manual_seed(0)
    points = torch.rand(500, 3)
    upstream = torch.rand(500, 12)
    found = []
    for kernels in ("warp", "torch"):
        with using_kernels(kernels):  # type: ignore[arg-type]
            torch.manual_seed(1)
            grid = HashGrid(hash_levels(6, 4, 200, 12), CPU)
            out = grid(points)
            out.backward(upstream)
            gradient = grid.gradient.clone()
            grid.step(0.1, (0.9, 0.99), 1e-15)
            found.append((out.detach(), gradient, grid.table.clone()))
    for warp, twin in zip(*found):
        assert torch.allclose(warp, twin, atol=1e-5)
    assert float(found[0][1].abs().sum()) == pytest.approx(float(upstream.sum()), rel=1e-4)


def test_the_march_takes_one_sample_in_every_occupied_step() -> None:
    method = InstantNGP(SETUP)
    method.occupancy.density.fill_(0)
    method.occupancy.density.view(128, 128, 128)[64, 64, 32:96] = 1000
    method.occupancy.rebuild()
    cell = 2 / 128
    rays = rays_from([-3.0, cell / 2, cell / 2], [1.0, 0.0, 0.0])
    samples = method.march(rays, None)
    occupied = float((method.occupancy.cells[:, 0].view(128, 128, 128)[64, 64] > 0).sum()) * cell
    assert len(samples) == pytest.approx(min(occupied / STEP, MOST_SAMPLES), abs=2)
    assert samples.deltas.tolist() == pytest.approx([STEP] * len(samples), rel=1e-3)


def test_samples_behind_what_a_ray_cannot_pass_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    method = InstantNGP(SETUP)
    method.occupancy.density.fill_(1000)
    method.occupancy.rebuild()
    origins = torch.tensor([[-3.0, 0.1, 0.1], [-3.0, 0.1, 0.1], [-3.0, 5.0, 0.1]])
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [1.0, 0.2, 0], [1.0, 0, 0]]), dim=1)
    samples = method.march(Rays(origins, directions, torch.zeros(3)), None)
    density = torch.where(samples.points[:, 0] > 0.6, 500.0, 2.0)
    monkeypatch.setattr(method, "density", lambda points: torch.where(points[:, 0] > 0.6, 500.0, 2.0))
    weights = render_weights(density, samples.deltas, samples.packed_info)
    transmittance = 1 - sums_in_front(weights, samples.packed_info)
    visible = method.visible(samples)
    assert 0 < len(visible) < 0.7 * len(samples)
    assert torch.equal(visible.t, samples.t[transmittance > LEAST_TRANSMITTANCE])
    assert visible.packed_info.counts[2] == 0
    assert int(visible.packed_info.counts.sum()) == len(visible)


def occupied_share(grid: NGPOccupancy) -> float:
    """Share of the cells that are occupied."""
    return float((grid.cells[:, 0] > 0).float().mean())


@pytest.mark.slow
def test_every_cell_fades_and_is_read_again() -> None:
    grid = NGPOccupancy(InstantNGP(SETUP).occupancy.config, False, 1 << 18)
    generator = torch.Generator().manual_seed(0)

    def right_half(points: torch.Tensor) -> torch.Tensor:
        return torch.where(points[:, 0] > 0.5, 100.0, 0.0)

    grid.refresh(0, right_half, generator)
    assert torch.equal(grid.cells[:, 0].view(128, 128, 128)[0, 0] > 0, torch.arange(128) >= 64)
    for update in range(75):  # 100 · 0.95^75 is below the threshold, 100 · 0.95^60 is not
        if update == 60:
            assert occupied_share(grid) > 0.99
        grid.refresh(16, lambda points: 100 - right_half(points), generator)
    assert torch.equal(grid.cells[:, 0].view(128, 128, 128)[0, 0] > 0, torch.arange(128) < 64)


def test_with_few_samples_a_step_few_cells_are_read_and_the_others_stay_occupied() -> None:
    grid = NGPOccupancy(InstantNGP(SETUP).occupancy.config, False, 1 << 14)
    generator = torch.Generator().manual_seed(0)
    reads = []

    def empty(points: torch.Tensor) -> torch.Tensor:
        reads.append(len(points))
        return torch.zeros(len(points))

    grid.refresh(0, empty, generator)
    assert sum(reads) == 128**3 // 16
    assert occupied_share(grid) == pytest.approx(math.exp(-1 / 16), abs=1e-3)
    reads.clear()
    grid.refresh(256, empty, generator)
    assert sum(reads) == 128**3 // 32


def test_composited_logits_are_the_weighted_sum_of_those_of_samples(store: PixelStore) -> None:
    method = make_baseline("semantic-nerf", SETUP, 0)
    seen = []
    for part in (method.coarse, method.fine):  # type: ignore[union-attr]
        part.register_forward_hook(lambda _m, _i, out: seen.append(out))
    batch = store.batch(torch.arange(5) + 24 * 12 + 10)
    rays = camera_rays(store.rays, batch.image, batch.pixel, training=False)
    with torch.no_grad():
        _, fine = method.both(rays, None)  # type: ignore[union-attr, operator]
    assert seen[0][2].shape == (5 * COARSE, 2)
    logits = seen[1][2].view(5, COARSE + FINE, 2)
    assert torch.allclose(fine.logits, (fine.weights[..., None] * logits).sum(1), atol=1e-5)


def test_void_does_not_count_as_a_label() -> None:
    logits = torch.tensor([[2.0, 0.0], [0.0, 5.0]], requires_grad=True)
    loss = logits_loss(logits, torch.tensor([0, VOID]))
    assert loss.item() == pytest.approx(math.log(1 + math.exp(-2)))
    assert logits_loss(logits, torch.tensor([VOID, VOID])).item() == 0


def test_appearance_codes_are_those_of_the_photo_and_their_mean_elsewhere() -> None:
    method = make_baseline("nerf-w codes", SETUP, 0)
    rays = rays_from([0, 0, -3], [0, 0, 1])
    own = Rays(rays.origins, rays.directions, rays.radii, torch.tensor([3]))
    codes = method.codes.weight  # type: ignore[union-attr]
    assert torch.equal(method.views(own)[0, 27:], codes[3])  # type: ignore[operator]
    assert torch.allclose(method.views(rays)[0, 27:], codes.mean(0))  # type: ignore[operator]
    assert method.parameter_count() == 1_191_688 + 2 * 48 * 128 + 14 * 48
    assert any(p is codes for group in method.optimizer.param_groups for p in group["params"])  # type: ignore[union-attr]


@pytest.fixture
def small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """NeRF and its kin with few samples and narrow networks, which learn in seconds."""
    monkeypatch.setattr(network, "WIDTH", 64)
    monkeypatch.setattr(nerf, "COARSE", 24)
    monkeypatch.setattr(nerf, "FINE", 24)
    monkeypatch.setattr(mip_nerf, "SAMPLES", 32)
    for module in (nerf, nerf_w, mip_nerf):
        monkeypatch.setattr(module, "FIRST_RATE", 3e-3)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name == "instant-ngp" else [pytest.mark.slow]) for name in BASELINES],
)
def test_methods_learn_a_small_scene(name: str, store: PixelStore, small_networks: None) -> None:
    method = make_baseline(name, SETUP, 0)
    before, after = learned(method, store, 50 if isinstance(method, InstantNGP) else 160)
    assert after < before * 0.75
    method.eval()
    pixel = torch.arange(24 * 24)
    rendered = method.render(camera_rays(store.rays, torch.zeros_like(pixel), pixel, training=False))
    batch = store.batch(pixel)
    error = ((method.behind(rendered.color, rendered.opacity) - method.target(batch)) ** 2).mean()
    plain = ((method.target(batch) - method.target(batch).mean(0)) ** 2).mean()
    assert float(error) < float(plain) * 0.9  # better than a picture of one colour
    assert method.network_seconds > 0
    if rendered.probabilities is not None:
        assert torch.allclose(rendered.probabilities.sum(1), rendered.opacity, atol=1e-4)


def test_methods_of_classes_need_labels() -> None:
    with pytest.raises(SettingError, match="no labels"):
        make_baseline("semantic-nerf", Setup(0, 3, False, 1.0, 8, CPU), 0)
    with pytest.raises(SettingError, match="no method “vqrf”"):
        make_baseline("vqrf", SETUP, 0)
