"""Each setting of `field` changes what its description says."""

from __future__ import annotations

import math

import pytest
import torch
from fieldwork.nerfcore.config import MOST_VERTICES
from fieldwork.nerfcore.field.encoding import spherical_harmonics
from fieldwork.nerfcore.field.hybrid import HybridField
from fieldwork.tests.nerfcore.support.settings import config_of

POINTS = torch.rand(200, 3, generator=torch.Generator().manual_seed(1))
DIRECTIONS = spherical_harmonics(torch.nn.functional.normalize(POINTS - 0.5, dim=1))


def field(**settings: str) -> HybridField:
    torch.manual_seed(0)
    config = config_of(**{f"field.{name}": value for name, value in settings.items()})
    return HybridField(config.field, classes=3, images=2)


@pytest.mark.setting("field.branch")
def test_a_branch_alone_has_no_other() -> None:
    both, explicit, implicit = field(), field(branch="explicit"), field(branch="implicit")
    assert both.grid is not None
    assert both.implicit is not None
    assert explicit.implicit is None
    assert explicit.blend is None
    assert implicit.grid is None
    assert implicit.blend is None
    alone = explicit.geometry(POINTS)
    assert alone.implicit is None
    assert alone.explicit is not None
    assert torch.equal(implicit.geometry(POINTS).features, implicit.geometry(POINTS).features)


@pytest.mark.setting("field.fusion")
def test_branches_are_blended_or_stand_side_by_side() -> None:
    blend, concat = field(fusion="blend"), field(fusion="concat")
    assert blend.density_head.weights[0].shape[1] == blend.features
    assert concat.density_head.weights[0].shape[1] == 2 * concat.features
    assert concat.grid is not None
    with torch.no_grad():  # where the decoder ignores the second half, the implicit branch has no say
        concat.density_head.weights[0][:, concat.features :] = 0
        before = concat.density(POINTS)
        assert concat.implicit is not None
        concat.implicit.weights[-1].zero_()
        assert torch.equal(concat.density(POINTS), before)


@pytest.mark.setting("field.levels", "field.coarsest", "field.finest")
def test_the_grid_has_the_levels_asked_for() -> None:
    grid = field(levels="5", coarsest="8", finest="40").grid
    assert grid is not None
    assert [grid.levels[0][0], grid.levels[-1][0]] == [8, 40]
    assert len(grid.levels) == 5
    assert grid.width == 20
    open_ended = field(finest="null").grid
    assert open_ended is not None
    assert open_ended.levels[-1][0] == MOST_VERTICES


@pytest.mark.setting("field.table_log2")
def test_levels_larger_than_the_table_are_hashed() -> None:
    small, large = field(table_log2="12").grid, field(table_log2="20").grid
    assert small is not None
    assert large is not None
    assert max(rows for _, _, rows in small.levels) == 1 << 12
    assert [rows for _, _, rows in large.levels] == [n**3 for n, _, _ in large.levels]


@pytest.mark.setting(
    "field.octaves",
    "field.width",
    "field.implicit_layers",
    "field.color_layers",
    "field.semantic_layers",
    "field.geometry_features",
)
def test_networks_have_the_shapes_asked_for() -> None:
    f = field(
        octaves="5", width="24", implicit_layers="4", color_layers="2", semantic_layers="3", geometry_features="7"
    )
    assert f.implicit is not None
    assert f.semantic_head is not None
    assert f.implicit.weights[0].shape == (24, 3 + 6 * 5)
    assert [len(m.weights) for m in (f.implicit, f.color_head, f.semantic_head)] == [4, 2, 3]
    assert f.density_head.weights[-1].shape[0] == 1 + 7
    assert {len(m.weights[0]) for m in (f.density_head, f.color_head, f.semantic_head)} == {24}
    known = f.geometry(POINTS)
    assert f.color(known, DIRECTIONS).shape == (200, 3)
    assert f.logits(known).shape == (200, 3)


@pytest.mark.setting("field.blend_by", "field.blend_floor", "field.blend_rate")
def test_the_share_of_the_grid_follows_evidence_or_density() -> None:
    weights, density = torch.full((200,), 0.5), torch.full((200,), 30.0)
    evidence = field(blend_floor="0.3", blend_rate="4").blend
    literal = field(blend_by="density", blend_floor="0.3", blend_rate="4").blend
    assert evidence is not None
    assert literal is not None
    assert torch.allclose(evidence(POINTS), torch.tensor(0.3))
    assert torch.allclose(literal(POINTS), torch.tensor(0.0))
    everywhere = torch.ones_like(evidence.evidence)
    evidence.evidence.copy_(everywhere * 0.25)
    literal.evidence.copy_(everywhere * 25)
    assert torch.allclose(evidence(POINTS), torch.tensor(1 - 0.7 * math.exp(-4 * 0.25)))
    assert torch.allclose(literal(POINTS), torch.tensor(1 - math.exp(-0.04 * 25)))
    for blend, value in ((evidence, 0.5), (literal, 30.0)):
        blend.evidence.zero_()
        blend.update(POINTS, weights, density)
        assert float(blend.evidence.max()) == pytest.approx(0.1 * value)


@pytest.mark.setting("field.blend_warmup")
def test_the_grid_is_alone_while_the_blend_warms_up() -> None:
    f = field(blend_warmup="10")
    assert f.blend is not None
    f.set_progress(0.0, 0.0, step=9)
    assert bool((f.blend(POINTS) == 1).all())
    f.set_progress(0.0, 0.0, step=10)
    assert bool((f.blend(POINTS) < 1).all())


@pytest.mark.setting("field.appearance")
def test_each_image_may_have_a_code_of_its_own() -> None:
    f = field(appearance="4")
    assert field().appearance is None
    assert f.appearance is not None
    assert f.appearance.shape == (2, 4)
    known = f.geometry(POINTS)
    with torch.no_grad():
        f.appearance.copy_(torch.tensor([[1.0, 0.0, -1.0, 2.0], [-1.0, 2.0, 1.0, 0.0]]))
        first, second = (f.color(known, DIRECTIONS, code.expand(200, 4)) for code in f.appearance)
        mean = f.color(known, DIRECTIONS, f.appearance.mean(0).expand(200, 4))
    assert float((first - second).abs().max()) > 1e-3
    assert torch.allclose(f.color(known, DIRECTIONS), mean, atol=1e-6)


@pytest.mark.setting("field.density_shift")
def test_the_shift_scales_the_density_of_an_untrained_field() -> None:
    ratio = field(density_shift="0.5").density(POINTS) / field(density_shift="-0.5").density(POINTS)
    assert torch.allclose(ratio, torch.tensor(math.e), rtol=1e-4)


@pytest.mark.setting("field.precision")
@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_half_precision_stays_close_to_single(precision: str) -> None:
    exact, half = field(precision="float32"), field(precision=precision)
    assert half.dtype == getattr(torch, precision)
    found = []
    for f in (exact, half):
        known = f.geometry(POINTS)
        loss = f.color(known, DIRECTIONS).sum() + f.logits(known).square().sum() + known.density.sum()
        gradient = torch.autograd.grad(loss, f.color_head.weights[0])[0]
        found.append((known.density, f.color(known, DIRECTIONS), f.logits(known), gradient))
    assert found[1][0].dtype == found[1][3].dtype == torch.float32
    for single, reduced in zip(*found):
        assert not torch.equal(single, reduced)
        assert float((single - reduced).detach().abs().max()) < 0.03 * float(single.detach().abs().max())
