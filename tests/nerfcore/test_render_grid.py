"""The grid that finished fields are rendered with, and how many samples its rays get."""

from __future__ import annotations

import threading

import pytest
import torch
from fieldwork.nerfcore.config import SamplingConfig
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.kernels.cells import MOST_CELLS_A_SIDE
from fieldwork.nerfcore.kernels.march import FEWEST_SAMPLES, sample, sample_counts
from fieldwork.nerfcore.kernels.runtime import worker_count
from fieldwork.nerfcore.kernels.traversal import skip_distances
from fieldwork.nerfcore.sampling import render_grid
from fieldwork.nerfcore.sampling.occupancy import OccupancyGrid
from fieldwork.nerfcore.sampling.render_grid import (
    PROBES,
    SAVED,
    RenderGrid,
    largest_factor,
    met_cells,
    present_grid,
    read_fine,
    refined_grid,
    worth_reading,
)

N = 32
THICK = 0.02


def shell(points: torch.Tensor) -> torch.Tensor:
    """Density of a thin sphere around the middle of the grid."""
    away = (points * 2 - 1).norm(dim=1) - 0.5
    return torch.where(away.abs() < THICK, 200.0, 0.0)


def shell_grid() -> OccupancyGrid:
    grid = OccupancyGrid(SamplingConfig(resolution=N), contracted=False)
    cell = torch.arange(N**3)
    middle = (torch.stack([cell % N, cell // N % N, cell // N**2], 1) + 0.5) / N
    near = ((middle * 2 - 1).norm(dim=1) - 0.5).abs() < 2 / N
    grid.density.copy_(torch.where(near, 200.0, 0.0))
    grid.mean.copy_(grid.density)
    grid.rebuild()
    return grid


def occupied(grid: OccupancyGrid, among: torch.Tensor | None = None) -> torch.Tensor:
    cells = grid.cells[:, 0] > 0
    return (cells if among is None else cells & among).nonzero()[:, 0]


def finer(factor: int, among: torch.Tensor | None = None) -> RenderGrid:
    coarse = shell_grid()
    return refined_grid(coarse, read_fine(coarse, shell, factor, occupied(coarse, among)), 1.0)


def parallel_rays() -> tuple[torch.Tensor, torch.Tensor]:
    side = torch.linspace(-0.6, 0.6, 25)
    x, y = torch.meshgrid(side, side, indexing="ij")
    origins = torch.stack([x, y, torch.full_like(x, -2)], -1).view(-1, 3)
    return origins, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(origins), 3).contiguous()


def test_the_refined_grid_closes_what_is_empty_and_keeps_every_surface() -> None:
    coarse = shell_grid()
    fine = finer(2)
    assert fine.settings.resolution == 2 * N
    assert fine.settings.step == pytest.approx(coarse.step / 2)
    inside_of = fine.cells[:, 0] > 0
    assert float(inside_of.float().mean()) < 0.6 * float((coarse.cells[:, 0] > 0).float().mean())
    points = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(1)), dim=1) / 4
    x, y, z = ((points + 0.5) * 2 * N).long().unbind(1)
    assert float(inside_of[(z * 2 * N + y) * 2 * N + x].float().mean()) > 0.9
    origins, directions = parallel_rays()
    found = sample(origins, directions, fine.cells, fine.skip_distance, fine.settings, 16)
    met = found.packed_info.counts > 0
    inside = origins[:, :2].norm(dim=1)
    assert bool(met[inside < 0.5].all())
    assert not bool(met[inside > 0.5 + 3 / N].any())
    # The first surface is at −√(¼ − r²), where half of the samples of the middle ray lie.
    middle = len(origins) // 2
    begin, count = int(found.packed_info.starts[middle]), int(found.packed_info.counts[middle])
    assert float((found.t[begin : begin + count] - 1.5).abs().min()) < THICK


def test_cells_are_not_refined_where_it_does_not_pay() -> None:
    pays = 1000 * 2**3 * PROBES / SAVED
    assert not worth_reading(1000, 2, 0.9 * pays)
    assert worth_reading(1000, 2, 1.1 * pays)


def test_what_is_found_in_a_cell_does_not_depend_on_which_others_are_read() -> None:
    coarse = shell_grid()
    cells = occupied(coarse)
    whole = read_fine(coarse, shell, 2, cells)
    chosen = torch.rand(len(cells), generator=torch.Generator().manual_seed(3)) < 0.3
    one, other = (read_fine(coarse, shell, 2, cells[which]) for which in (chosen, ~chosen))
    assert 0 < len(one.coarse) < len(whole.coarse)
    together = one.with_more(other)
    assert torch.equal(together.coarse, whole.coarse)
    assert torch.equal(together.density, whole.density)


def test_rays_ask_for_the_cells_they_meet_and_those_beside_them() -> None:
    coarse = shell_grid()
    origins = torch.tensor([[0.01, 0.01, -2.0], [0.9, 0.9, -2.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3).contiguous()
    met = met_cells(coarse, [(origins, directions)]).view(N, N, N)
    _, y, x = met.nonzero().unbind(1)
    assert set(x.tolist()) | set(y.tolist()) == {15, 16, 17}  # the second ray meets nothing
    front = round((0.5 - 0.25) * N)
    assert bool(met[front - 1 : front + 1, 16, 16].any())
    assert not bool(met[: front - 3].any())

    none = met_cells(coarse, [(origins[1:], directions[1:])])
    assert not bool(none.any())


def test_cells_that_are_not_read_keep_their_density() -> None:
    coarse = shell_grid()
    shown = (torch.arange(N**3) % N) < N // 2  # the half of small x
    half = finer(2, shown)
    side = 2 * N
    x = torch.arange(side**3) % side
    parts = len(occupied(coarse, shown)) * 2**3
    assert 0 < int((half.cells[x < N, 0] > 0).sum()) < 0.6 * parts
    kept = half.cells[x >= N].view(side, side, N, 2)
    given = coarse.cells.view(N, N, N, 2)[:, :, N // 2 :]
    expected = given.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert torch.equal(kept, expected)


def test_rays_through_more_open_cells_get_more_samples() -> None:
    bins = torch.tensor([0, 1, 3, 10, 100])
    assert sample_counts(bins, 32, 1.5).tolist() == [0, FEWEST_SAMPLES, 5, 15, 32]
    assert sample_counts(bins, 2, 1.5).tolist() == [0, 2, 2, 2, 2]
    assert sample_counts(bins, 32, 0.0).tolist() == [0, 32, 32, 32, 32]
    grid = shell_grid()
    origins, directions = parallel_rays()
    few, all_of_them = (
        sample(origins, directions, g.cells, g.skip_distance, g.settings, 32)
        for g in (present_grid(grid, 0.5), present_grid(grid, 0.0))
    )
    assert len(few) < len(all_of_them)
    assert bool(((few.packed_info.counts > 0) == (all_of_them.packed_info.counts > 0)).all())
    # However few they are, a ray's samples stand for all of its occupied length.
    lengths = [
        torch.zeros(len(origins)).index_add_(0, s.packed_info.ray_indices.long(), s.deltas) for s in (few, all_of_them)
    ]
    assert torch.allclose(*lengths, atol=1e-4)


def test_skip_distances_count_empty_blocks_in_all_directions() -> None:
    occupied = torch.zeros(64, 64, 64, dtype=torch.bool)
    occupied[0, 0, 0] = True
    skip_distance = skip_distances(occupied).view(16, 16, 16)
    for z, y, x in ((0, 0, 0), (0, 0, 1), (3, 2, 1), (7, 7, 0), (15, 15, 15)):
        assert int(skip_distance[z, y, x]) == min(max(z, y, x), 8)


def test_reading_the_finer_cells_stops_as_soon_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_grid, "CHUNK", 64)
    asked, read = threading.Event(), []

    def density(points: torch.Tensor) -> torch.Tensor:
        read.append(len(points))
        asked.set()
        return shell(points)

    def check() -> None:
        if asked.is_set():
            raise Cancelled

    with pytest.raises(Cancelled):
        read_fine(shell_grid(), density, 2, occupied(shell_grid()), check)
    assert len(read) <= worker_count()  # what was under way already


def test_grids_are_not_made_finer_than_kernels_can_number_their_cells() -> None:
    assert MOST_CELLS_A_SIDE**3 < 2**31 <= (MOST_CELLS_A_SIDE + 1) ** 3
    assert largest_factor(128, 4) == 4
    assert largest_factor(512, 4) == 2
    assert largest_factor(512, 2) == 2
    for resolution in range(8, 513, 4):
        for factor in (1, 2, 4):
            assert resolution * largest_factor(resolution, factor) <= MOST_CELLS_A_SIDE
