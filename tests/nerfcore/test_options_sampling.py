"""Each setting of `sampling` and `render` changes what its description says."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.data.pixels import VOID
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.kernels.march import Samples, sample
from fieldwork.nerfcore.kernels.packed_info import PackedInfo
from fieldwork.nerfcore.render.fused import wants_fused
from fieldwork.nerfcore.render.image import render_view
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.sampling.cache import CoarseCache
from fieldwork.nerfcore.sampling.occupancy import OccupancyGrid, class_importance
from fieldwork.nerfcore.sampling.outlines import DISTANCE, Outlines, outline_mask
from fieldwork.nerfcore.train.composite_loss import composite_loss
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import config_of, trainer_of

N = 32  # cells along a side of the grid, as in SMALL


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("sampling") / "ball", views=8, side=24)


def model(**settings: str) -> Model:
    torch.manual_seed(0)
    return Model(config_of(**settings), classes=3, images=2, contracted=False)


def slab(density: float, importance: float = 0.0, **settings: str) -> tuple[OccupancyGrid, Samples]:
    """64 samples of a ray along x through a block whose cells from N/4 on are open; the third quarter is interesting."""
    grid = OccupancyGrid(config_of(**settings).sampling, contracted=False)
    n = grid.config.resolution
    cells = torch.zeros(n, n, n, 2)
    cells[..., n // 4 :, 0] = density
    cells[..., n // 2 : 3 * n // 4, 1] = importance
    grid.cells.copy_(cells.view(-1, 2))
    origin, direction = torch.tensor([[-3.0, 0.01, 0.01]]), torch.tensor([[1.0, 0.0, 0.0]])
    return grid, sample(origin, direction, grid.cells, grid.skip_distance, grid.march_settings(), 64)


def share(samples: Samples, low: float, high: float) -> float:
    """Share of the samples between two places along x in [0, 1]."""
    x = samples.points[:, 0]
    return float(((x >= low) & (x < high)).float().mean())


@pytest.mark.setting("sampling.resolution", "sampling.bins_per_cell")
def test_cells_and_bins() -> None:
    grid = OccupancyGrid(config_of(**{"sampling.resolution": "16", "sampling.bins_per_cell": "2"}).sampling, False)
    assert len(grid.cells) == 16**3
    assert grid.march_settings().step == pytest.approx(2 / 16 / 2)


@pytest.mark.setting("sampling.samples")
def test_a_ray_has_the_samples_asked_for(ball: Path) -> None:
    for count in (4, 9):
        trainer = trainer_of(ball, **{"sampling.samples": str(count)})
        trainer.step(0.0)
        measured = trainer.take_measured()
        assert measured.samples == measured.rays * count  # at first every ray meets occupied cells


@pytest.mark.setting("sampling.pdf")
def test_samples_gather_at_surfaces_or_spread() -> None:
    near = {pdf: share(slab(20.0, 1.0, **{"sampling.pdf": pdf})[1], 0.25, 0.35) for pdf in ("default", "uniform")}
    assert near["uniform"] == pytest.approx(0.1 / 0.75, abs=0.03)
    assert near["default"] > 3 * near["uniform"]
    # The literal form has no transmittance: it looks at what is interesting behind the surface too.
    assert share(slab(20.0, 1.0, **{"sampling.pdf": "literal"})[1], 0.5, 0.75) > 0.95


@pytest.mark.setting("sampling.importance")
def test_interest_is_priority_boundary_or_nothing() -> None:
    certain, torn = torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 1 / 3)
    priorities = torch.tensor([0.5, 2.0, 1.0])
    assert float(class_importance(certain, "priority", priorities)) == pytest.approx(0.25)
    assert float(class_importance(certain, "boundary", priorities)) == pytest.approx(0.0, abs=1e-5)
    assert float(class_importance(torn, "boundary", priorities)) == pytest.approx(1.0, abs=1e-5)
    assert not model(**{"sampling.importance": "priority"}).wants_importance()  # all priorities alike
    assert model(**{"sampling.importance": "boundary"}).wants_importance()
    assert not model(**{"sampling.importance": "none"}).wants_importance()
    assert model(**{"sampling.pdf": "literal", "sampling.importance": "none"}).wants_importance()
    drawn = {
        kind: share(slab(0.5, 1.0, **{"sampling.importance": kind})[1], 0.5, 0.75) for kind in ("priority", "none")
    }
    assert drawn["priority"] > 1.2 * drawn["none"]


@pytest.mark.setting("sampling.beta", "sampling.epsilon")
def test_interest_draws_as_strongly_as_told_and_every_open_bin_keeps_a_weight() -> None:
    strong, weak = (share(slab(0.5, 1.0, **{"sampling.beta": beta})[1], 0.5, 0.75) for beta in ("6", "0"))
    assert strong > 1.5 * weak
    far = [share(slab(30.0, 0.0, **{"sampling.epsilon": e})[1], 0.35, 1.0) for e in ("0.0001", "0.1")]
    assert far[1] > far[0] + 0.1


@pytest.mark.setting("sampling.update_every", "sampling.cache_every", "sampling.coarse_cache", "sampling.warmup")
def test_the_grid_and_the_cache_are_updated_when_told(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    updates, rebuilds = [], []
    update, rebuild = OccupancyGrid.update, CoarseCache.rebuild

    def counted_update(self: OccupancyGrid, step: int, *rest: object) -> None:
        updates.append(step)
        update(self, step, *rest)  # type: ignore[arg-type]

    def counted_rebuild(self: CoarseCache, model: Model) -> None:
        rebuilds.append(trainer.steps)
        rebuild(self, model)

    monkeypatch.setattr(OccupancyGrid, "update", counted_update)
    monkeypatch.setattr(CoarseCache, "rebuild", counted_rebuild)
    settings = {"sampling.update_every": "5", "sampling.cache_every": "6", "sampling.warmup": "8"}
    trainer = trainer_of(ball, **settings)
    warm = []
    for _ in range(21):
        trainer.step(0.1)
        warm.append(trainer.model.warming_up)
    assert updates == [0, 5, 10, 15, 20]
    assert rebuilds == [8, 14, 20]
    assert warm == [True] * 8 + [False] * 13
    trainer = trainer_of(ball, **settings, **{"sampling.coarse_cache": "false"})
    for _ in range(21):
        trainer.step(0.1)
    assert len(rebuilds) == 3
    assert trainer.cache.hit is None
    trainer = trainer_of(ball, **settings)
    trainer.store.usable = torch.arange(1, len(trainer.store))  # a mask leaves a pixel out
    for _ in range(9):
        trainer.step(0.1)
    assert len(rebuilds) == 3  # rays are drawn from the usable pixels, whatever they meet


@pytest.mark.setting("sampling.decay", "sampling.threshold")
def test_cells_close_below_the_threshold_after_decaying() -> None:
    grid = OccupancyGrid(config_of(**{"sampling.decay": "0.5", "sampling.threshold": "0.004"}).sampling, False)
    grid.density[0], grid.density[1:] = 0.005 / grid.step, 1.0
    grid.rebuild()
    occupied = (grid.cells[:, 0] > 0).view(N, N, N)
    assert bool(occupied.all())
    grid.density[:] = 1.0
    generator = torch.Generator().manual_seed(0)
    grid.update(1000, lambda points: torch.zeros(len(points)), generator=generator)
    assert set(grid.density.tolist()) == {0.5, 1.0}
    for threshold, share_open in (("0.05", 0.0), ("0.03", 1.0)):
        grid = OccupancyGrid(config_of(**{"sampling.threshold": threshold}).sampling, False)
        grid.density.fill_(0.04 / grid.step)
        grid.density[: N**3 // 2] = 10 / grid.step  # the mean is far above
        grid.rebuild()
        assert bool((grid.cells[-N * N * 4 :, 0] > 0).all()) == bool(share_open)


@pytest.mark.setting("sampling.mean_rate", "sampling.optical_depth", "sampling.warmup_decay")
def test_how_fast_cells_follow_and_how_dense_they_may_be() -> None:
    point, density = torch.full((1, 3), 0.01), torch.tensor([13.0])
    for rate in ("0.1", "0.5"):
        grid = OccupancyGrid(config_of(**{"sampling.mean_rate": rate}).sampling, False)
        grid.observe(point, density, False)
        assert float(grid.mean[0]) == pytest.approx(3.0 + 10.0 * float(rate), rel=1e-4)
    for depth in ("1.0", "0.125"):
        grid = OccupancyGrid(config_of(**{"sampling.optical_depth": depth}).sampling, False)
        grid.mean.fill_(1e6)
        grid.rebuild()
        assert float(grid.cells[:, 0].max()) == pytest.approx(float(depth) / grid.step)
    for decay in ("0.25", "0.5"):
        grid = OccupancyGrid(config_of(**{"sampling.warmup_decay": decay}).sampling, False)
        grid.update(grid.config.update_every, lambda points: torch.zeros(len(points)))
        assert grid.density.unique().tolist() == [3.0 * float(decay)]


@pytest.mark.setting("sampling.empty_rays")
def test_a_share_of_the_rays_comes_from_everywhere(ball: Path) -> None:
    trainer = trainer_of(ball)
    cache = trainer.cache
    cache.hit = torch.tensor([0])  # the corner of the first image
    for free in (0.0, 0.4):
        places = cache.draw(5000, free, trainer.generator)
        elsewhere = float((trainer.store.batch(places).image != 0).float().mean())
        assert elsewhere == pytest.approx(free * (1 - 1 / len(trainer.store.views)), abs=0.03)


def test_no_pixel_of_a_hit_tile_is_drawn_more_often_because_the_image_ends(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball", views=4, side=37)  # two tiles and five pixels
    trainer = trainer_of(project)
    trainer.cache.hit = torch.arange(int(trainer.cache.first[-1]))
    drawn = trainer.cache.draw(200 * len(trainer.store), 0.0, trainer.generator)
    counts = torch.bincount(drawn, minlength=len(trainer.store)) / 200
    assert counts.min() > 0.3
    assert counts.max() < 6  # where four tiles lie on each other at a corner


def test_photos_smaller_than_a_tile_are_drawn_evenly(tmp_path: Path) -> None:
    trainer = trainer_of(ball_project(tmp_path / "ball", views=4, side=12))
    trainer.cache.hit = torch.arange(int(trainer.cache.first[-1]))
    drawn = trainer.cache.draw(500 * len(trainer.store), 0.0, trainer.generator)
    counts = torch.bincount(drawn, minlength=len(trainer.store)) / 500
    assert counts.max() < 2.5


def near_another_class(label: torch.Tensor, y: int, x: int) -> bool:
    """The definition of an outline, looked up pixel by pixel."""
    around = label[max(y - DISTANCE, 0) : y + DISTANCE + 1, max(x - DISTANCE, 0) : x + DISTANCE + 1]
    return bool(label[y, x] != VOID) and bool(((around != label[y, x]) & (around != VOID)).any())


@pytest.mark.setting("sampling.outline_rays")
def test_outlines_are_where_classes_meet_and_get_their_share_of_the_rays(ball: Path) -> None:
    trainer = trainer_of(ball, **{"sampling.outline_rays": "0.5"})
    store = trainer.store
    store.label[:40] = VOID
    store.label[5000:5003] = 0
    camera, first = store.cameras[0], int(store.first[1])
    label = store.label[:first].view(camera.height, camera.width)
    expected = [near_another_class(label, y, x) for y in range(camera.height) for x in range(camera.width)]
    found = outline_mask(store)
    assert 0 < sum(expected) < 0.5 * len(expected)
    assert found[:first].tolist() == expected
    store.usable = torch.arange(0, len(store), 2)
    assert torch.equal(outline_mask(store), found & (torch.arange(len(store)) % 2 == 0))
    store.usable = None
    batch = trainer.draw()
    assert len(batch.rgb) == trainer.rays
    trainer = trainer_of(ball, **{"sampling.outline_rays": "0.5"})
    assert trainer.outlines is not None
    inside = torch.isin(store.first[batch.image] + batch.pixel, trainer.outlines.pixel_indices)
    assert trainer.outlines.share - 0.01 <= float(inside.float().mean()) < 0.8
    for settings in ({"sampling.outline_rays": "0"}, {"sampling.outline_rays": "0.5", "loss.semantic_weight": "0"}):
        assert trainer_of(ball, **settings).outlines is None


def test_rare_classes_have_more_than_their_share_of_the_outline_rays(ball: Path) -> None:
    store = trainer_of(ball).store
    store.label[:] = 0
    width = store.cameras[0].width
    store.label[width * 10 + 10] = 1  # one pixel, with 24 of class 0 around it
    outlines = Outlines(store, 0.01)
    assert outlines.pixel_indices.tolist()[-1] == width * 10 + 10
    assert len(outlines.pixel_indices) == 25
    assert outlines.share == pytest.approx((4 + 0.01 * len(store) * 24**0.5 / (1 + 24**0.5)) / len(store), rel=1e-3)
    drawn = outlines.draw(20000, torch.Generator().manual_seed(0))
    assert set(drawn.tolist()) == set(outlines.pixel_indices.tolist())
    assert float((store.label[drawn] == 1).float().mean()) == pytest.approx(
        4 / outlines.share / len(store),
        abs=0.01,  # at most four times as often as any pixel
    )
    assert Outlines(store, 0.5).share == pytest.approx(4 * 25 / len(store), rel=1e-3)


def test_what_is_drawn_more_often_counts_less(ball: Path) -> None:
    """Weighted, a step's rays lie on outlines as often as pixels do."""
    trainer = trainer_of(ball, **{"sampling.outline_rays": "0.5"})
    assert trainer.outlines is not None
    on_outline = trainer.outlines.mask
    batches = [trainer.draw() for _ in range(30)]
    drawn = torch.cat([on_outline[trainer.store.first[b.image] + b.pixel] for b in batches]).float()
    weight = torch.cat([b.weight for b in batches])
    even = float(on_outline.float().mean())
    assert float(drawn.mean()) > even + 0.2
    assert float((drawn * weight).mean()) == pytest.approx(even, abs=0.02)
    assert float(weight.mean()) == pytest.approx(1, abs=0.02)
    trainer.store.label[:] = torch.arange(len(trainer.store)) % 2  # nothing but outlines, and all rays on them
    everything = Outlines(trainer.store, 1.0)
    assert everything.share == pytest.approx(1)
    assert everything.weight(everything.pixel_indices).tolist() == pytest.approx(
        [1.0] * len(everything.pixel_indices), rel=1e-3
    )


def two_samples() -> tuple[torch.Tensor, torch.Tensor, PackedInfo]:
    """A faint sample with huge logits for class 0 in front of a surface of class 1."""
    packed_info = PackedInfo(torch.tensor([0]).int(), torch.tensor([2]).int(), torch.tensor([0, 0]).int())
    return torch.tensor([[60.0, 0.0, 0.0], [0.0, 4.0, 0.0]]), torch.tensor([0.1, 0.8], requires_grad=True), packed_info


@pytest.mark.setting("render.accumulate")
def test_a_faint_sample_outvotes_a_surface_only_where_logits_are_summed() -> None:
    logits, weights, packed_info = two_samples()
    kept, summed = (
        model(**{"render.accumulate": how})._probabilities(values, weights, packed_info)[0]
        for how, values in (("probabilities", torch.softmax(logits, 1)), ("logits", logits))
    )
    assert kept.argmax() == 1
    assert summed.argmax() == 0
    assert float(kept.detach().sum()) == pytest.approx(0.9, abs=1e-5)
    assert float(summed.detach().sum()) == pytest.approx(0.9, abs=1e-5)


@pytest.mark.setting("loss.detach_weights")
def test_labels_move_the_geometry_unless_told_not_to() -> None:
    logits, weights, packed_info = two_samples()
    held = model(**{"loss.detach_weights": "true"})._probabilities(logits, weights, packed_info)
    moving = model()._probabilities(logits, weights, packed_info)
    assert torch.equal(held, moving)
    assert not held.requires_grad
    assert bool((torch.autograd.grad(moving[0, 1], weights)[0] != 0).any())


@pytest.mark.parametrize("detached", ["true", "false"])
def test_labels_alone_never_change_how_opaque_a_ray_is(ball: Path, detached: str) -> None:
    settings = {"loss.detach_weights": detached, "loss.rgb_weight": "0", "loss.regularization": "0"}
    trainer = trainer_of(ball, **settings)
    batch = trainer.store.batch(torch.arange(0, len(trainer.store), 7))
    shown = trainer._render(batch, torch.full((len(batch.rgb),), 0.5), torch.full((len(batch.rgb) * 12,), 0.5))
    total, _ = composite_loss(batch, shown, torch.ones_like(batch.rgb), 0.0, trainer.config.loss, trainer.model)
    (moved,) = torch.autograd.grad(total, shown.weights, allow_unused=True)
    moved = torch.zeros_like(shown.weights) if moved is None else moved
    assert bool((moved != 0).any()) == (detached == "false")
    push = torch.zeros(len(batch.rgb)).index_add(
        0, shown.samples.packed_info.ray_indices.long(), moved * shown.weights.detach()
    )
    assert float(push.abs().max()) < 1e-6


def test_few_labels_pull_at_the_geometry_as_much_each_as_many_do(ball: Path) -> None:
    whole, part = trainer_of(ball), trainer_of(ball, **{"train.labelled_share": "0.25"})
    assert whole.model.label_pull > 0.9
    views = len(part.store.cameras)
    labelled = sum(bool((part.store.label[a:b] != VOID).any()) for a, b in zip(part.store.first, part.store.first[1:]))
    assert part.model.label_pull == pytest.approx(whole.model.label_pull * labelled / views, rel=0.2)
    logits, weights, packed_info = two_samples()
    pulled = []
    for trainer in (whole, part):
        moving = trainer.model._probabilities(logits, weights, packed_info)
        pulled.append(torch.autograd.grad(moving[0, 1], weights)[0] / trainer.model.label_pull)
    assert torch.allclose(*pulled)


def rendered(trainer: Trainer, count: int = 8):
    places = torch.arange(200) * 5
    batch = trainer.store.batch(places)
    return trainer.model.render(batch.origins, batch.directions, count)


@pytest.mark.setting("render.cull")
def test_samples_of_little_weight_are_left_out(ball: Path) -> None:
    shown = {}
    for cull in ("0", "0.02", "0.9"):
        trainer = trainer_of(ball, **{"render.cull": cull})
        out = rendered(trainer)
        shown[cull] = len(out.samples)
        if len(out.weights):
            assert float(out.weights.detach().min()) > float(cull)
    assert shown["0"] > shown["0.02"] > shown["0.9"]


@pytest.mark.setting("render.samples")
def test_pictures_have_samples_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, pose = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2), look_at(np.array([2.0, 0, 0]), np.zeros(3))
    for value, expected in (("7", 7), ("null", 5)):
        m, counts = model(**{"render.samples": value, "sampling.samples": "5"}), []
        original = m.render

        def render(origins, directions, count, *rest, _to=original, _counts=counts, **more):
            _counts.append(count)
            return _to(origins, directions, count, *rest, **more)

        monkeypatch.setattr(m, "render", render)
        render_view(m, camera, pose, 0.0)
        assert set(counts) == {expected}


@pytest.mark.setting("render.refine", "render.per_bin")
def test_pictures_have_a_grid_and_a_number_of_samples_of_their_own() -> None:
    for factor in (1, 2):
        m = model(**{"render.refine": str(factor), "render.per_bin": "0.5"})
        m.occupancy.cells[: N**3 // 2, 0] = 0  # an untrained grid is open everywhere
        m.refine()
        settings = m.render_grid().settings
        assert settings.resolution == factor * N
        assert settings.per_bin == 0.5
    assert m.occupancy.march_settings().per_bin == 0.0  # training has its own


@pytest.mark.setting("render.fused")
def test_the_fused_kernel_is_used_when_told_and_possible() -> None:
    rays = 1 << 20
    assert not wants_fused(model(), rays)  # auto, on a CPU
    assert wants_fused(model(**{"render.fused": "on"}), 10)
    assert not wants_fused(model(**{"render.fused": "off"}), rays)
    assert not wants_fused(model(**{"render.fused": "on", "field.implicit_layers": "3"}), rays)


@pytest.mark.setting("train.fade")
def test_finer_levels_fade_in() -> None:
    field = model(**{"field.levels": "4", "train.fade": "0.5"}).field
    gains = []
    for progress in (0.0, 0.125, 0.5):
        field.set_progress(progress, 0.5, 0)
        gains.append(field.gains)
    assert gains == [[1, 1, 0, 0], [1, 1, 0.5, 0], [1, 1, 1, 1]]
    field.set_progress(0.0, 0.0, 0)
    assert math.prod(field.gains) == 1
