"""Training steps that read nothing back from the device: the same numbers, and nothing the host would wait for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from fieldwork.nerfcore.kernels.device import Kernels, using_kernels
from fieldwork.nerfcore.kernels.packed_info import PackedInfo
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.model import Model, Rendered
from fieldwork.nerfcore.train.checkpoint import restore, trainer_numbers, trainer_tensors
from fieldwork.nerfcore.train.composite_loss import composite_loss
from fieldwork.nerfcore.train.losses import distortion_loss
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.train.schedule import sample_budget
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.settings import config_of, trainer_of
from fieldwork.tests.nerfcore.support.sky import under_the_sky
from torch.utils._python_dispatch import TorchDispatchMode

UPDATE = 16  # steps between updates of the occupancy grid, which may read back
WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "unique2", "_unique2", "repeat_interleave"}


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("fixed") / "ball", views=9, side=24, depth=True)


def warm(project: Path, steps: int = 40, **settings: str) -> Trainer:
    trainer = trainer_of(project, **settings)
    for _ in range(steps):
        trainer.step(0.1)
    return trainer


class Waits(TorchDispatchMode):
    """Lists the operations whose result the host needs before it can go on."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        masks = args[1] if name in ("index", "index_put", "index_put_") else ()
        by_mask = any(isinstance(m, torch.Tensor) and m.dtype in (torch.bool, torch.uint8) for m in masks)
        if name in WAITS or by_mask:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Threads of the kernel pool would escape the listener."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_indices_are_those_of_the_kept_samples_and_the_rest_is_marked() -> None:
    generator = torch.Generator().manual_seed(0)
    count = torch.randint(0, 6, (40,), generator=generator, dtype=torch.int32)
    start = torch.cumsum(count, 0, dtype=torch.int32) - count
    packed_info = PackedInfo(start, count, torch.repeat_interleave(torch.arange(40).int(), count.long()))
    kept = torch.rand(len(packed_info.ray_indices), generator=generator) < 0.4
    indices, exact = packed_info.subset(kept)
    with Waits() as waits:
        fixed, padded = packed_info.subset(kept, len(indices) + 7)
    assert waits.found == []
    assert torch.equal(fixed[: len(indices)], indices)
    assert torch.equal(padded.ray_indices[: len(indices)], exact.ray_indices)
    assert bool((padded.ray_indices[len(indices) :] == -1).all())
    assert torch.equal(padded.counts, exact.counts)
    assert torch.equal(padded.starts[exact.counts > 0], exact.starts[exact.counts > 0])
    few, cut = packed_info.subset(kept, 9)
    assert torch.equal(few, indices[:9])
    assert int(cut.counts.sum()) == 9
    assert bool((cut.starts + cut.counts <= 9).all())
    for capacity in range(len(indices)):  # also where it ends within a ray, which is then dropped as a whole
        few, cut = packed_info.subset(kept, capacity)
        taken = int(cut.counts.sum())
        assert taken <= capacity
        assert bool(((cut.counts == 0) | (cut.counts == exact.counts)).all())
        assert torch.equal(few[:taken], indices[:taken])
        assert bool((cut.ray_indices[taken:] == -1).all())
        assert cut.dropped is not None
        assert int(cut.dropped) == int(((cut.counts == 0) & (exact.counts > 0)).sum()) > 0


@pytest.mark.parametrize("share", [0.66, 1.0], ids=["two passes", "one pass"])
def test_a_fixed_capacity_gives_the_same_picture_gradients_and_grid(ball: Path, share: float) -> None:
    trainer = warm(ball, **{"field.appearance": "2"})
    model = trainer.model
    batch = trainer.store.batch(torch.arange(0, len(trainer.store), 3))
    rays = len(batch.rgb)
    jitter, shift = torch.rand(rays), torch.rand(rays * 12)
    origins, directions = (x.clone().requires_grad_() for x in (batch.origins, batch.directions))
    grid = model.field.grid
    assert grid is not None
    assert model.field.appearance is not None

    def result(fixed: bool) -> tuple[Rendered, list[torch.Tensor]]:
        model.fixed_capacity = fixed
        model.visible_share.fill_(share)
        model.refresh()
        grid.clear()
        codes = model.field.appearance[batch.image]
        out = model.render(origins, directions, 12, jitter, shift, codes)
        assert out.probabilities is not None
        loss = (out.color.square().sum(1) + out.depth + out.opacity).sum() + out.probabilities.square().sum()
        found = torch.autograd.grad(loss, [*model.parameters(), origins, directions])
        before = {name: value.clone() for name, value in model.occupancy.state_dict().items()}
        model.observe([out])
        after = [model.occupancy.density.clone(), model.occupancy.mean.clone(), model.visible_share.clone()]
        model.occupancy.load_state_dict(before)
        return out, [*found, grid.gradient.clone(), *after]

    exact, padded = result(False), result(True)
    live = exact[0].samples.packed_info.counts.sum()
    assert len(exact[0].evaluated_density) < len(padded[0].evaluated_density)  # some rays meet nothing
    assert len(exact[0].weights) == live < len(padded[0].weights)
    for name in ("color", "opacity", "depth", "probabilities"):
        assert torch.allclose(getattr(exact[0], name), getattr(padded[0], name), atol=1e-6), name
    assert torch.allclose(exact[0].weights, padded[0].weights[:live], atol=1e-6)
    assert bool((padded[0].weights[live:] == 0).all())
    for a, b in zip(exact[1], padded[1]):
        assert torch.allclose(a, b, atol=1e-5 * float(a.abs().max().clamp(min=1e-6)))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        pytest.param(
            {"train.refine_poses": "true", "train.pose_start": "0", "loss.depth_weight": "0.1"}, marks=pytest.mark.slow
        ),
        {"loss.distortion_weight": "0.01", "loss.opacity_weight": "0.01", "field.fusion": "concat"},
        {"field.branch": "implicit", "render.accumulate": "logits", "field.appearance": "4"},
        {"field.branch": "explicit", "sampling.pdf": "uniform", "field.blend_by": "density"},
        pytest.param(
            {"scene.background": "environment", "scene.contraction": "on", "train.refine_poses": "true"},
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda s: " ".join(s) or "default",
)
def test_an_ordinary_step_asks_the_device_for_nothing(
    ball: Path,
    settings: dict[str, str],
    one_thread: None,
    tmp_path: Path,
) -> None:
    project = under_the_sky(tmp_path / "p") if "scene.background" in settings else ball
    trainer = trainer_of(project, **settings)
    trainer.model.fixed_capacity = True
    waited: dict[int, list[str]] = {}
    for step in range(2 * UPDATE + 20):
        with Waits() as waits:
            trainer.step(0.5)
        if waits.found:
            waited[step] = waits.found
    # The grid's updates may, and the step at which the coarse cache is made.
    assert {step for step in waited if step % UPDATE and step != trainer.config.sampling.warmup} == set()
    assert waited  # the listener works
    assert all(bool(torch.isfinite(p).all()) for p in trainer.model.parameters())


@pytest.mark.slow
def test_training_with_a_fixed_capacity_learns_as_well(ball: Path) -> None:
    errors = {}
    for fixed in (False, True):
        trainer = trainer_of(ball)
        trainer.model.fixed_capacity = fixed
        for step in range(150):
            trainer.step(step / 150)
        trainer.take_measured()
        for _ in range(10):
            trainer.step(1.0)
        errors[fixed] = trainer.take_measured().psnr
    assert errors[True] == pytest.approx(errors[False], abs=1.0)


def test_rays_beyond_the_capacity_are_counted_and_leave_the_others_alone(ball: Path) -> None:
    model = warm(ball).model
    model.fixed_capacity = True
    rays = 200
    origins = torch.tensor([[-1.5, 0.0, 0.0]]).repeat(rays, 1)
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 1e-3 * k] for k in range(rays)]), dim=1)
    shift = torch.rand(rays * 12)
    whole = model.render(origins, directions, 12, shift=shift)
    cut = model.render(origins, directions, 12, shift=shift, capacity=50)
    assert int(whole.samples.packed_info.dropped) == 0
    met = (whole.samples.t_first >= 0).nonzero()[:, 0]
    assert len(met) > 60
    assert int(cut.samples.packed_info.dropped) == len(met) - 50
    assert torch.allclose(cut.color[met[:50]], whole.color[met[:50]], atol=1e-6)
    assert not cut.color[met[50:]].any()
    # Rays that met nothing have starts too, which later steps look up.
    assert int((cut.samples.packed_info.starts + cut.samples.packed_info.counts).max()) <= len(cut.weights)
    assert distortion(cut).isfinite()


def test_rays_that_were_dropped_in_training_are_told(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Model, "has_fixed_capacity", lambda model: True)
    monkeypatch.setattr(Trainer, "_capacity", lambda trainer, progress, shards: 4)
    report = Reporter()
    train(TrainParams(project=ball, preset="draft", run="dropping", steps=UPDATE + 2, set=SMALL), report)
    assert any("of the rays were left out for want of capacity" in warning for warning in report.warnings)
    events = (ball / "runs" / "dropping" / "events.jsonl").read_text("utf-8").splitlines()
    assert sum(json.loads(line).get("dropped", 0) for line in events) > 0


def distortion(rendered: Rendered) -> torch.Tensor:
    s = rendered.samples
    return distortion_loss(rendered.weights, s.t, s.deltas, s.packed_info)


@pytest.mark.parametrize("kernels", ["warp", "torch"])
def test_nothing_visible_gives_numbers(ball: Path, kernels: Kernels) -> None:
    trainer = warm(ball, steps=4, **{"loss.opacity_weight": "0.01"})
    model = trainer.model
    model.fixed_capacity = True
    model.occupancy.cells.zero_()
    batch = trainer.store.batch(torch.arange(64))
    with using_kernels(kernels):
        rendered = model.render(batch.origins, batch.directions, 12)
        assert len(rendered.weights) > 0
        assert not rendered.samples.packed_info.counts.any()
        loss, error = composite_loss(batch, rendered, torch.zeros(64, 3), 0.9, trainer.config.loss, model)
        assert float(distortion(rendered).detach()) == 0
        assert bool(torch.isfinite(loss))
        assert bool(torch.isfinite(error))
        gradients = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
        model.observe([rendered])
    assert all(bool(torch.isfinite(g).all()) for g in gradients if g is not None)
    assert 0 <= float(model.visible_share) <= 1


@pytest.mark.slow
def test_what_becomes_visible_after_a_while_of_nothing_is_seen(ball: Path) -> None:
    """A capacity that followed the share of visible samples down to nothing would hide all that comes later."""
    trainer = warm(ball, steps=200)
    model = trainer.model
    model.fixed_capacity = True
    model.visible_share.fill_(0)
    trainer._ask_device(0.5)
    batch = trainer.store.batch((trainer.store.rgba[:, 3] > 0).nonzero()[:256, 0])
    rendered = model.render(batch.origins, batch.directions, 12)
    assert int(rendered.visible) > len(rendered.weights) > 0  # more than there is room for now
    for _ in range(60):
        model.observe([rendered])
    trainer._ask_device(0.5)
    assert int(model.render(batch.origins, batch.directions, 12).samples.packed_info.dropped) == 0


@pytest.mark.slow
def test_the_number_of_rays_follows_the_samples_that_are_used(ball: Path) -> None:
    trainer = trainer_of(ball, **{"sampling.coarse_cache": "false", "train.batch_start": "4096"})
    trainer.model.fixed_capacity = True
    grid = trainer.model.occupancy
    for values in (grid.seen, grid.density, grid.mean):  # half of the cube is known to be empty
        values[: len(values) // 2] = 0
    for step in range(112):
        trainer.step(0.5 + step / 1000)
    trainer.take_measured()
    for _ in range(48):
        trainer.step(0.8)
    measured = trainer.take_measured()
    budget = sample_budget(trainer.config.train, 0.8)
    # Many rays meet nothing: there must be more of them than the budget divided by the samples of a ray.
    assert trainer.rays > 1.2 * budget / trainer.config.sampling.samples
    assert measured.samples / measured.steps == pytest.approx(budget, rel=0.2)
    assert measured.dropped < 0.02 * measured.rays


def test_a_resumed_training_has_the_capacity_and_rays_it_would_have_had(ball: Path) -> None:
    whole, parts = (trainer_of(ball) for _ in range(2))
    for trainer in (whole, parts):
        trainer.model.fixed_capacity = True
        for step in range(52):
            if step == 40:
                trainer.model.visible_share.fill_(0.3)
            trainer.step(step / 100)
    kept = {name: value.clone() for name, value in trainer_tensors(parts).items()}
    resumed = trainer_of(ball)
    resumed.model.fixed_capacity = True
    restore(resumed, kept, trainer_numbers(parts))
    assert resumed.model.fixed_shares() == whole.model.fixed_shares()
    assert whole.model.fixed_shares()[0], "two passes"
    for step in range(52, 70):  # beyond the next reading of what the device counted
        for trainer in (whole, resumed):
            trainer.step(step / 100)
    assert resumed.rays == whole.rays
    expected, found = trainer_tensors(whole), trainer_tensors(resumed)
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_rays_are_shuffled_where_some_may_be_dropped(ball: Path) -> None:
    trainer = trainer_of(ball, **{"sampling.outline_rays": "0.5"})
    assert trainer.outlines is not None
    outlines = trainer.outlines.mask
    share = {}
    for fixed in (False, True):
        trainer.model.fixed_capacity = fixed
        batches = [trainer.draw() for _ in range(20)]
        flat = [trainer.store.first[b.image] + b.pixel for b in batches]
        share[fixed] = torch.stack([outlines[f[: len(f) // 2]].float().mean() for f in flat]).mean()
        whole = torch.stack([outlines[f].float().mean() for f in flat]).mean()
        if fixed:
            assert abs(float(share[True] - whole)) < 0.05
    assert float(share[False]) < float(share[True]) - 0.1


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")
def test_ordinary_steps_on_a_gpu_never_make_the_host_wait(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDWORK_GRAPHS", "off")  # recording a step waits before it begins
    device = torch.device("cuda")
    info, scene = plan_run(ball, "draft", config_of(), device)
    trainer = make_trainer(ball, info, scene, device, Reporter())
    for _ in range(3 * UPDATE):  # kernels are compiled, the cache is made
        trainer.step(0.5)
    try:
        for step in range(3 * UPDATE, 5 * UPDATE):
            torch.cuda.set_sync_debug_mode("default" if step % UPDATE == 0 else "error")
            trainer.step(0.5)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert trainer.take_measured().psnr > 5
