"""Unwrapping in processes: whole charts, seams, and an end when one is asked for."""

from __future__ import annotations

import time

import numpy as np
import psutil
import pytest
import torch
import trimesh
from fieldwork.nerfcore.errors import Cancelled, TrainingError
from fieldwork.nerfcore.kernels.triangles import triangle_texels
from fieldwork.nerfcore.mesh import uv
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.flat import box_mesh


class Heard(Reporter):
    def __init__(self) -> None:
        super().__init__()
        self.fractions: list[float] = []

    def progress(self, fraction: float, message: str = "") -> None:
        self.fractions.append(fraction)
        super().progress(fraction, message)


def test_a_cube_is_cut_at_edges_only() -> None:
    vertices, faces = box_mesh()
    made = uv.unwrap(vertices, faces, 256, Reporter())
    assert made.corners.shape == (12, 3, 2)
    assert made.corners.min() >= 0
    assert made.corners.max() <= 1
    edges = vertices[made.seams]
    # Of the 12 edges of a cube a net keeps 5; diagonals of its squares are no seams.
    assert 7 <= len(edges) <= 12
    assert np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1) == pytest.approx(1)


def test_chunks_make_one_map_without_overlap_and_of_one_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uv, "CHUNK_FACES", 300)
    ball = trimesh.creation.icosphere(3)
    report = Heard()
    made = uv.unwrap(ball.vertices, ball.faces, 512, report)
    assert report.fractions == sorted(report.fractions)
    assert (np.bincount(made.chart) > 0).all()
    assert 0.4 < made.utilization <= 1
    corners = made.corners * [1, -1] * 512 + [0, 512]
    first, texel, _ = triangle_texels(corners, 0, 0, 512, 512, torch.device("cpu"))
    owner = made.chart[np.repeat(np.arange(len(ball.faces)), np.diff(first))]
    # No texel belongs to two charts.
    pairs = np.unique(np.stack([texel, owner], 1), axis=0)
    assert len(pairs) == len(np.unique(texel))
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    scale = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2 / ball.area_faces
    assert np.percentile(scale, 95) / np.percentile(scale, 5) < 2


@pytest.mark.parametrize("radius", [1e-3, 1.0, 1e5])
def test_every_face_has_a_place_whatever_the_unit(radius: float) -> None:
    ball = trimesh.creation.icosphere(3)
    made = uv.unwrap((ball.vertices * radius).astype(np.float32), ball.faces, 256, Reporter())
    u, v = made.corners[:, 1] - made.corners[:, 0], made.corners[:, 2] - made.corners[:, 0]
    share = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    assert share.min() > 0
    assert 0.3 < share.sum() <= 1


def test_faces_without_area_get_a_place() -> None:
    vertices, faces = box_mesh()
    made = uv.unwrap(vertices, np.concatenate([faces, [[0, 1, 1], [2, 2, 2]]]), 256, Reporter())
    assert np.isfinite(made.corners).all()
    assert made.corners.min() >= 0
    assert made.corners.max() <= 1


class Impatient(Reporter):
    """Cancels two seconds after the first progress."""

    cancelled_at: float | None = None
    began: float | None = None

    def progress(self, fraction: float, message: str = "") -> None:
        self.began = self.began or time.monotonic()
        if self.cancelled_at is None and time.monotonic() > self.began + 2:
            self.cancelled_at = time.monotonic()
            self.cancel()
        super().progress(fraction, message)


def test_cancelled_unwrapping_ends_its_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uv, "CHUNK_FACES", 25_000)
    rough = trimesh.creation.icosphere(6)  # 81 920 faces in four chunks: much longer than the patience
    vertices = rough.vertices * (1 + 0.05 * np.random.default_rng(0).normal(size=(len(rough.vertices), 1)))
    report = Impatient()
    with pytest.raises(Cancelled):
        uv.unwrap(vertices, rough.faces, 4096, report)
    assert report.cancelled_at is not None
    assert time.monotonic() - report.cancelled_at < 2
    mine = psutil.Process().children(recursive=True)
    assert not [child for child in mine if "uv_worker" in " ".join(child.cmdline())]


def test_a_process_that_dies_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uv.sys, "executable", "/bin/false")
    with pytest.raises(TrainingError, match="Unwrapping the mesh failed"):
        uv.unwrap(*box_mesh(), 256, Reporter())
    with pytest.raises(TrainingError, match="no area"):
        uv.unwrap(np.zeros((3, 3)), np.array([[0, 1, 2]]), 256, Reporter())
