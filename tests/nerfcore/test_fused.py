"""The fused render kernel against the separate kernels, on fields of random values."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import warp as wp
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.kernels.fused import render_coarse
from fieldwork.nerfcore.render import fused as fused_render
from fieldwork.nerfcore.render.fused import FusedRenderer, UnfusedRenderer, _log_once, ray_renderer, unsupported
from fieldwork.nerfcore.render.model import Model

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")]
    ),
]
COUNT = 16


@pytest.fixture(autouse=True)
def _no_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


# Largest and mean difference between half and single precision networks, in units of the values.
LARGEST, MEAN = 5e-3, 5e-4


def random_model(
    classes: int,
    contracted: bool = False,
    preset: str = "standard",
    settings: dict[str, str] | None = None,
    device: str = "cpu",
) -> Model:
    """A field of random values in a ball of occupied cells; large ones, so that errors would show."""
    torch.manual_seed(3)
    values = {"field.precision": "float32", "field.table_log2": "12", "sampling.resolution": "64"}
    model = Model(make_config(preset, values | (settings or {})), classes, 5, contracted).eval().requires_grad_(False)
    assert model.field.grid is not None
    model.field.grid.table.normal_(0, 0.3)
    if model.field.blend is not None:
        model.field.blend.evidence.uniform_(0, 0.6)
    if model.field.appearance is not None:
        model.field.appearance.normal_()
    if model.environment is not None:
        model.environment.labelled.fill_(1.0)
    occupancy = model.occupancy
    n = occupancy.config.resolution
    cell = torch.arange(n**3)
    center = (torch.stack([cell % n, cell // n % n, cell // n**2], 1) + 0.5) / n * 2 - 1
    occupancy.density.copy_(torch.where(center.norm(dim=1) < 0.7, 6.0, 0.0))
    occupancy.mean.copy_(occupancy.density)
    occupancy.importance.uniform_()
    occupancy.rebuild()
    return model.to(device)


def rays(count: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    origin = torch.randn(count, 3, generator=generator)
    origin = origin / origin.norm(dim=1, keepdim=True) * 3
    direction = torch.rand(count, 3, generator=generator) * 1.6 - 0.8 - origin
    return origin.to(device), (direction / direction.norm(dim=1, keepdim=True)).to(device)


def assert_same(fused, unfused) -> None:
    for name in ("color", "opacity", "depth", "probabilities"):
        ours, theirs = getattr(fused, name), getattr(unfused, name)
        assert (ours is None) == (theirs is None), name
        if theirs is not None:
            difference = (ours - theirs).abs()
            scale = float(theirs.abs().max())
            assert scale > 0.02, f"{name} of the oracle is nearly zero: nothing is compared"
            assert float(difference.max()) < LARGEST * scale, name
            assert float(difference.mean()) < MEAN * scale, name


def assert_same_environment(fused, unfused) -> None:
    """Of rays that the field leaves something of; the rest may fall on either side of the limit."""
    shown = unfused.weight > 0.01
    assert bool(shown.any())
    assert float((fused.color - unfused.color)[shown].abs().max()) < LARGEST
    assert float((fused.probabilities - unfused.probabilities)[shown].abs().max()) < LARGEST


CASES = {
    "standard, 7 classes": (7, False, "standard", {}),
    "contracted, logits, 20 classes": (20, True, "standard", {"render.accumulate": "logits"}),
    "grid alone, appearance, no classes": (
        0,
        False,
        "standard",
        {"field.branch": "explicit", "field.appearance": "4", "field.color_layers": "2"},
    ),
    "environment": (5, True, "standard", {"scene.background": "environment"}),
    "side by side": (5, False, "standard", {"field.fusion": "concat", "field.levels": "6"}),
    "blended": (5, False, "standard", {"field.fusion": "blend"}),
    "draft, narrow": (3, False, "draft", {"field.width": "32", "sampling.pdf": "uniform"}),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("case", CASES)
def test_the_fused_kernel_renders_what_the_separate_kernels_do(case: str, device: str) -> None:
    model = random_model(*CASES[case], device)
    origins, directions = rays(200, device)
    fused = FusedRenderer(model)(origins, directions, COUNT)
    unfused = UnfusedRenderer(model)(origins, directions, COUNT)
    assert_same(fused, unfused)
    if model.environment is not None:
        assert_same_environment(fused.environment, unfused.environment)
    missed = unfused.opacity == 0
    assert bool(missed.any()) or model.contracted
    assert bool((fused.color[missed] == 0).all())
    assert 0 < int(fused.evaluated) <= unfused.evaluated


@pytest.mark.parametrize("device", DEVICES)
def test_both_renderers_walk_the_refined_grid(device: str) -> None:
    model = random_model(3, settings={"field.density_shift": "4"}, device=device)
    model.refine()
    assert model.render_grid().settings.resolution == 2 * model.occupancy.config.resolution
    origins, directions = rays(100, device)
    assert_same(FusedRenderer(model)(origins, directions, COUNT), UnfusedRenderer(model)(origins, directions, COUNT))


def test_a_few_pixels_first_do_not_keep_many_from_the_refined_grid() -> None:
    model = random_model(3, settings={"field.density_shift": "4"})
    model.refine(pixels=1)
    assert model.render_grid().settings.resolution == model.occupancy.config.resolution
    model.refine()
    assert model.render_grid().settings.resolution == 2 * model.occupancy.config.resolution


def test_threads_of_a_block_share_their_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of several samples, as on a GPU: two of them take rays from one queue."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    model = random_model(7)
    origins, directions = rays(100, "cpu")
    renderer, grid = FusedRenderer(model), model.render_grid()
    out = render_coarse(
        renderer.field,
        renderer.coarse(origins, directions),
        grid.cells,
        grid.skip_distance,
        grid.settings,
        COUNT,
        model.config.render.cull,
        lanes=16,
    )
    assert_same(out, UnfusedRenderer(model)(origins, directions, COUNT))


def test_rays_come_in_parts_where_there_is_little_room() -> None:
    model = random_model(7)
    origins, directions = rays(100, "cpu")
    renderer, grid = FusedRenderer(model), model.render_grid()
    coarse, cull = renderer.coarse(origins, directions), model.config.render.cull
    march = (grid.cells, grid.skip_distance, grid.settings, COUNT, cull)
    whole = render_coarse(renderer.field, coarse, *march)
    parts = render_coarse(renderer.field, coarse, *march, capacity=30 * COUNT)
    assert int(parts.evaluated) == int(whole.evaluated) > 0
    assert whole.probabilities is not None
    for name in ("color", "opacity", "depth", "probabilities"):
        assert torch.allclose(getattr(parts, name), getattr(whole, name), atol=1e-6), name


def test_a_block_that_is_certain_of_its_grid_gets_the_same_picture() -> None:
    """With w near 1 everywhere the implicit branch is skipped for density and colour, but read for classes."""
    model = random_model(4)
    assert model.field.blend is not None
    model.field.blend.evidence.fill_(2.0)
    origins, directions = rays(60, "cpu")
    assert_same(FusedRenderer(model)(origins, directions, COUNT), UnfusedRenderer(model)(origins, directions, COUNT))


def test_an_opaque_ray_ends_early() -> None:
    model = random_model(0, settings={"field.density_shift": "6"})
    origins, directions = rays(60, "cpu")
    fused = FusedRenderer(model)(origins, directions, COUNT)
    unfused = UnfusedRenderer(model)(origins, directions, COUNT)
    assert int(fused.evaluated) < 0.7 * unfused.evaluated
    assert_same(fused, unfused)


def test_the_setting_chooses_the_kernel_and_says_why_not(caplog: pytest.LogCaptureFixture) -> None:
    def chosen(**settings: str) -> type:
        values = {name.replace("__", "."): value for name, value in settings.items()}
        return type(ray_renderer(random_model(2, settings=values), 1 << 20))

    assert chosen(render__fused="on") is FusedRenderer
    assert chosen(render__fused="auto") is UnfusedRenderer  # no GPU
    assert chosen(render__fused="off") is UnfusedRenderer
    _log_once.cache_clear()  # another test may have heard it
    with caplog.at_level(logging.WARNING, "fieldwork"):
        assert chosen(render__fused="on", field__implicit_layers="3") is UnfusedRenderer
    assert "field.implicit_layers is 3" in caplog.text


def test_an_old_gpu_renders_with_the_separate_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    model = random_model(2)
    monkeypatch.setattr(fused_render, "_capability", lambda device: (7, 5))
    assert unsupported(model) is None
    monkeypatch.setattr(fused_render, "_capability", lambda device: (6, 1))
    assert unsupported(model) == "the GPU is of compute capability 6.1, below 7.5"


def test_every_preset_is_supported() -> None:
    from fieldwork.nerfcore.config import preset_names

    for preset in preset_names():
        config = make_config(preset, {"field.table_log2": "10", "sampling.resolution": "16"})
        assert unsupported(Model(config, 64, 0, False)) is None, preset


def test_resources_of_a_compiled_kernel_are_read_without_a_gpu(tmp_path: Path) -> None:
    """The report of `make gpu-compile`, on a module that compiles in a second."""
    from fieldwork.nerfcore.kernels import composite
    from fieldwork.nerfcore.kernels.resources import disassembler, markdown, read_resources
    from fieldwork.nerfcore.kernels.runtime import init

    init()
    wp.compile_aot_module(composite.sum_forward.module, device=None, arch=90, module_dir=str(tmp_path), use_ptx=False)
    rows = read_resources(next(tmp_path.glob("*.cubin")), next(tmp_path.glob("*.meta")), 90)
    assert {r.kernel for r in rows} == {
        "sum_forward",
        "sum_backward",
        "in_front",
        "behind",
        "weights_forward",
        "weights_backward",
    }
    for row in rows:
        assert 8 <= row.registers <= 255
        assert row.stack == 0
        assert row.local_loads == (0 if disassembler() else None)
    assert "| composite | sum_forward | " in markdown([("composite", r) for r in rows])
