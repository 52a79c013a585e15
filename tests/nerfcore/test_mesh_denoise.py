"""Noise taken off a surface: flat places become flat, edges stay, borders and seams keep their vertices."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.mesh.denoise import denoised, neighbours
from fieldwork.nerfcore.mesh.triangles import border_edges, cross, unit
from fieldwork.nerfcore.progress import Reporter
from hypothesis import given
from hypothesis import strategies as st

CPU = torch.device("cpu")
SIDE = 40


def sheet(fold: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of SIDE by SIDE unit squares, in two triangles each, folded along its middle by `fold` radians."""
    x, y = np.meshgrid(np.arange(SIDE + 1.0), np.arange(SIDE + 1.0), indexing="ij")
    along = np.maximum(x - SIDE / 2, 0)
    places = np.stack([np.minimum(x, SIDE / 2) + along * np.cos(fold), y, along * np.sin(fold)], -1).reshape(-1, 3)
    number = np.arange((SIDE + 1) ** 2).reshape(SIDE + 1, SIDE + 1)
    a, b, c, d = (n.reshape(-1) for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    return places, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def noisy(places: np.ndarray, amount: float, seed: int = 0) -> np.ndarray:
    return places + amount * np.random.default_rng(seed).standard_normal(places.shape)


@pytest.mark.parametrize("fold", [0.0, np.pi / 2])
def test_noise_goes_and_the_edge_stays(fold: float) -> None:
    true, faces = sheet(fold)
    before = noisy(true, 0.15)
    after = denoised(before, faces, CPU, Reporter())
    inside = np.setdiff1d(np.arange(len(true)), np.unique(border_edges(faces)))

    def turned(places: np.ndarray) -> float:
        normals, truth = unit(cross(places, faces)), unit(cross(true, faces))
        return float(np.degrees(np.arccos(np.clip((normals * truth).sum(1), -1, 1))).mean())

    assert turned(after) < 0.45 * turned(before)
    error = [np.linalg.norm(places[inside] - true[inside], axis=1) for places in (before, after)]
    assert error[1].mean() < error[0].mean()
    crest = inside[np.abs(true[inside, 0] - SIDE / 2) < 0.5]
    assert np.abs(after[crest, 0] - SIDE / 2).mean() < 0.2, "the edge is not rounded off"


def test_a_flat_sheet_stays_to_the_last_digit_that_counts() -> None:
    true, faces = sheet()
    np.testing.assert_allclose(denoised(true, faces, CPU, Reporter()), true, atol=1e-5)


def test_borders_stay_and_vertices_move_by_the_share_they_may() -> None:
    true, faces = sheet()
    before = noisy(true, 0.15)
    whole = denoised(before, faces, CPU, Reporter())
    border = np.unique(border_edges(faces))
    np.testing.assert_array_equal(whole[border].astype(np.float32), before[border].astype(np.float32))
    held = (true[:, 0] < SIDE / 2).astype(float)
    part = denoised(before, faces, CPU, Reporter(), held)
    np.testing.assert_array_equal(part[held == 0].astype(np.float32), before[held == 0].astype(np.float32))
    assert np.abs(part - before)[held == 1].mean() > 0.01


def expected(faces: np.ndarray) -> list[list[int]]:
    """Neighbours, edge by edge."""
    edges = [[tuple(sorted((f[k], f[(k + 1) % 3]))) for k in range(3)] for f in faces.tolist()]
    count = Counter(edge for of in edges for edge in of)
    holders: dict[tuple[int, int], list[int]] = {}
    for number, of in enumerate(edges):
        for edge in of:
            holders.setdefault(edge, []).append(number)
    return [
        [next(h for h in holders[edge] if h != number) if count[edge] == 2 else number for edge in of]
        for number, of in enumerate(edges)
    ]


@given(st.lists(st.permutations(range(7)).map(lambda order: order[:3]), min_size=1, max_size=30))
def test_neighbours_are_those_beyond_each_edge(triangles: list[list[int]]) -> None:
    faces = np.unique(
        np.sort(np.array(triangles), axis=1), axis=0
    )  # no triangle twice: an edge of both would be one of two
    assert neighbours(torch.from_numpy(faces)).tolist() == expected(faces)


def test_it_can_be_stopped_and_nothing_is_no_fault() -> None:
    true, faces = sheet()

    class Stopped(Reporter):
        def check(self) -> None:
            raise Cancelled

    with pytest.raises(Cancelled):
        denoised(true, faces, CPU, Stopped())
    assert denoised(np.zeros((0, 3)), np.zeros((0, 3), int), CPU, Reporter()).shape == (0, 3)
