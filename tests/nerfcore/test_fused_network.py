"""The networks of the fused renderer as a GPU computes them, on an emulated warp, against plain matrix products."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.kernels.fused_network import (
    GAP,
    network,
    network_to_pixels,
    network_to_row,
    packed_size,
    row_length,
)

from .support.emulated_warp import COMPILER, run_warp

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")
TWO, THREE = (80, 64, 48), (32, 64, 64, 16)


def random_network(sizes: tuple[int, ...]) -> tuple[list[np.ndarray], np.ndarray]:
    """Matrices (outputs, inputs) and the same packed, with something in the gaps that must not count."""
    generator = np.random.default_rng(1)
    matrices = [
        generator.normal(0, inputs**-0.5, (outputs, inputs)).astype(np.float16)
        for inputs, outputs in zip(sizes, sizes[1:])
    ]
    packed = np.concatenate([np.pad(m, ((0, 0), (0, GAP)), constant_values=99).ravel() for m in matrices])
    assert len(packed) == packed_size(sizes)
    return matrices, packed


def expected(matrices: list[np.ndarray], rows: np.ndarray) -> np.ndarray:
    x = rows.astype(np.float32)
    for k, matrix in enumerate(matrices):
        x = x @ matrix.astype(np.float32).T
        if k < len(matrices) - 1:
            x = np.maximum(x, 0).astype(np.float16).astype(np.float32)
    return x


def random_rows(sizes: tuple[int, ...], length: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(2)
    return generator.normal(0, 1, (32, length)).astype(np.float16), generator.uniform(0.5, 1, 32).astype(np.float32)


@pytest.mark.parametrize("sizes", [TWO, THREE])
def test_outputs_in_single_precision(sizes: tuple[int, ...], tmp_path: Path) -> None:
    matrices, packed = random_network(sizes)
    length = row_length(sizes)
    rows, factors = random_rows(sizes, length)
    after, _ = run_warp(network(sizes, length).native_snippet, packed, rows, factors, tmp_path)
    found = np.ascontiguousarray(after).view(np.float32)[:, : sizes[-1]]
    np.testing.assert_allclose(found, expected(matrices, rows[:, : sizes[0]]), atol=2e-3)


def test_outputs_into_the_row_of_inputs(tmp_path: Path) -> None:
    sizes, length, place = (64, 64, 32), 88, 16
    matrices, packed = random_network(sizes)
    rows, factors = random_rows(sizes, length)
    snippet = network_to_row(sizes, length).native_snippet
    after, _ = run_warp(snippet, packed, rows, factors, tmp_path, place=place)
    outputs = factors[:, None] * expected(matrices, rows[:, :64])
    np.testing.assert_allclose(after[:, place : place + 32], outputs, atol=4e-3)
    assert np.array_equal(after[:, :place], rows[:, :place])
    assert np.array_equal(after[:, place + 32 :], rows[:, place + 32 :])


@pytest.mark.parametrize("logits", [False, True])
def test_scores_are_added_to_pixels(logits: bool, tmp_path: Path) -> None:
    sizes, count = TWO, 39
    matrices, packed = random_network(sizes)
    length = row_length((sizes[0], 0))
    rows, weights = random_rows(sizes, length)
    weights[5] = 0.0  # a thread without a sample
    pixel = [k // 3 for k in range(32)]
    snippet = network_to_pixels(sizes, length, logits).native_snippet
    _, pixels = run_warp(snippet, packed, rows, weights, tmp_path, pixel=pixel, count=count)
    scores = expected(matrices, rows[:, : sizes[0]])[:, :count]
    if not logits:
        scores = np.exp(scores - scores.max(1, keepdims=True))
        scores /= scores.sum(1, keepdims=True)
    sums = np.zeros((32, count))
    np.add.at(sums, pixel, weights[:, None] * scores)
    np.testing.assert_allclose(pixels, sums, atol=2e-2 if logits else 2e-3)
    assert np.abs(sums).max() > 0.1
