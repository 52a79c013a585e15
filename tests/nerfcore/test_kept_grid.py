"""The finer grid that is kept with a run: read once, never of another field, never in the way of a picture."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fieldwork.nerfcore.config import RunConfig
from fieldwork.nerfcore.render.kept_grid import KeptGrid
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.sampling import render_grid
from fieldwork.nerfcore.sampling.render_grid import FineDensity

CPU = torch.device("cpu")


@pytest.fixture
def model(monkeypatch: pytest.MonkeyPatch) -> Model:
    """An untrained model with a small grid, and how often its field was read."""
    config = RunConfig()
    config.sampling.resolution = 16
    config.field.levels, config.field.table_log2, config.field.finest = 4, 12, 64
    torch.manual_seed(0)
    found = Model(config, 0, 1, False).eval().requires_grad_(False)
    reads: list[int] = []
    density = found.field.density

    def counting(points: torch.Tensor) -> torch.Tensor:
        reads.append(len(points))
        return density(points)

    monkeypatch.setattr(found.field, "density", counting)
    found.reads = reads  # type: ignore[assignment]
    return found


def refined(model: Model, kept: KeptGrid, pixels: float = 1e9) -> tuple[torch.Tensor | None, int]:
    """Cells of the finer grid and how often the field was read for it."""
    model.reads.clear()  # type: ignore[operator]
    model._fine = model._refined = None
    model.kept_grid = kept
    model.refine(pixels)
    return (None if model._refined is None else model._refined.cells), len(model.reads)  # type: ignore[arg-type]


def test_a_field_is_read_once_for_all_its_pictures(model: Model, tmp_path: Path) -> None:
    kept = KeptGrid(tmp_path / "grid.safetensors", "one")
    first, reads = refined(model, kept)
    assert reads > 0
    assert first is not None
    second, reads = refined(model, kept)
    assert reads == 0
    assert torch.equal(first, second)
    assert refined(model, kept, pixels=1.0)[0] is not None  # kept, it pays for any picture


def beam(x: float) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """A ray through the cube, along z."""
    return [(torch.tensor([[x, 0.03, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]))]


def test_only_what_rays_meet_is_read_and_what_was_read_is_kept(model: Model, tmp_path: Path) -> None:
    model.field.blend = None  # an untrained field has evidence nowhere
    model.kept_grid = KeptGrid(tmp_path / "grid.safetensors", "one")
    model.refine(rays=beam(-0.5))
    assert model._fine is not None
    first, few = model._fine, sum(model.reads)  # type: ignore[arg-type]
    assert 3 * 3 * 8 < len(first.coarse) <= 3 * 3 * 16  # the cells of the ray and those beside them
    x = first.coarse % 16
    assert (int(x.min()), int(x.max())) == (3, 5)
    model.refine(rays=beam(-0.5))
    assert sum(model.reads) == few  # type: ignore[arg-type]
    model.refine(rays=beam(0.5))
    second = model._fine.coarse
    assert sum(model.reads) == len(second) * 2**3 * 4  # type: ignore[arg-type]
    assert set((second % 16).tolist()) == {3, 4, 5, 11, 12, 13}
    kept = model.kept_grid.load(2, CPU)
    assert kept is not None
    assert torch.equal(kept.coarse, model._fine.coarse)
    _, reads = refined(model, model.kept_grid)
    assert sum(model.reads) == (16**3 - len(second)) * 2**3 * 4  # type: ignore[arg-type]
    assert reads > 0


def test_a_few_more_cells_are_not_worth_another_grid(model: Model) -> None:
    model.field.blend = None
    model.refine()
    model._fine = FineDensity(model._fine.coarse[100:], model._fine.density[100:])  # type: ignore[union-attr]
    model.reads.clear()  # type: ignore[operator]
    model.refine()
    assert model.reads == []
    model._fine = FineDensity(model._fine.coarse[200:], model._fine.density[200:])
    model.refine()
    assert sum(model.reads) == 300 * 2**3 * 4  # type: ignore[arg-type]


def test_a_grid_is_refined_as_far_as_its_cells_can_be_numbered(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_grid, "MOST_CELLS_A_SIDE", 3 * 16)
    model.config.render.refine = 4
    model.refine()
    assert model.render_grid().settings.resolution == 2 * 16


def test_whoever_asks_what_hides_what_reads_it_everywhere(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "grid.safetensors"
    _, few = refined(model, KeptGrid(path, "one"))
    points = sum(model.reads)  # type: ignore[arg-type]
    model._fine = model._refined = None
    model.reads.clear()  # type: ignore[operator]
    model.refine(everywhere=True)
    assert few > 0
    # An untrained field has evidence nowhere.
    assert sum(model.reads) > 100 * points  # type: ignore[arg-type]
    fine = KeptGrid(path, "one").load(2, CPU)
    assert fine is not None
    assert fine.density.numel() * 4 == points


def test_another_training_reads_its_own(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "grid.safetensors"
    refined(model, KeptGrid(path, "one"))
    assert KeptGrid(path, "two").load(2, CPU) is None
    assert KeptGrid(path, "one").load(4, CPU) is None
    assert refined(model, KeptGrid(path, "two"))[1] > 0
    assert KeptGrid(path, "one").load(2, CPU) is None
    assert KeptGrid(path, "two").load(2, CPU) is not None


@pytest.mark.parametrize("damage", [b"", b"garbage", None])
def test_a_damaged_grid_is_read_anew(model: Model, tmp_path: Path, damage: bytes | None) -> None:
    path = tmp_path / "grid.safetensors"
    first, _ = refined(model, KeptGrid(path, "one"))
    path.write_bytes(path.read_bytes()[:-100] if damage is None else damage)
    again, reads = refined(model, KeptGrid(path, "one"))
    assert reads > 0
    assert first is not None
    assert torch.equal(first, again)


def test_pictures_are_rendered_where_nothing_can_be_kept(model: Model, tmp_path: Path) -> None:
    blocked = tmp_path / "a file"
    blocked.write_text("")
    cells, reads = refined(model, KeptGrid(blocked / "grid.safetensors", "one"))
    assert cells is not None
    assert reads > 0


def test_settings_without_a_finer_grid_have_none(model: Model, tmp_path: Path) -> None:
    model.config.render.refine = 1
    cells, reads = refined(model, KeptGrid(tmp_path / "grid.safetensors", "one"))
    assert cells is None
    assert reads == 0
