"""Levels of detail: fewer triangles, the same borders, places and colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.kernels.closest import ClosestPoints
from fieldwork.nerfcore.mesh import decimate as decimation
from fieldwork.nerfcore.mesh.decimate import decimate, decimate_closed, decimate_patches
from fieldwork.nerfcore.mesh.lods import level_files, make_levels, write_level
from fieldwork.nerfcore.mesh.metrics import sample_surface
from fieldwork.nerfcore.mesh.parts import texture_of
from fieldwork.nerfcore.mesh.surface import Surface, is_watertight
from fieldwork.nerfcore.mesh.triangles import border_edges
from fieldwork.nerfcore.progress import Reporter
from skimage.measure import marching_cubes


def ball() -> Surface:
    """A ball of 20 voxels' radius as marching cubes makes it, in three classes whose borders are jagged."""
    place = np.stack(np.meshgrid(*[np.arange(44)] * 3, indexing="ij"), -1) - 21.3
    vertices, faces, normals, _ = marching_cubes(np.linalg.norm(place, axis=-1) - 20, 0.0)
    vertices = vertices - 21.3
    middle = vertices[faces].mean(1)
    classes = np.where(middle[:, 2] > 5, 1, np.where(middle[:, 0] > 0, 2, 5)).astype(np.int32)
    instance = np.where(classes == 1, 1, 0).astype(np.uint32)
    ids = np.zeros(len(vertices), np.int32)
    ids[faces] = classes[:, None]
    colors = ((vertices / 44 + 0.5) * 255).astype(np.uint8)
    return Surface(vertices.astype(np.float32), faces.astype(np.int32), -normals, colors, ids, classes, instance)


def outline(vertices: np.ndarray, faces: np.ndarray) -> set:
    """The border of triangles, as pairs of places."""
    return {tuple(sorted(map(tuple, vertices[edge].tolist()))) for edge in border_edges(faces)}


def most_at_an_edge(faces: np.ndarray) -> int:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return int(np.unique(edges, axis=0, return_counts=True)[1].max())


@pytest.mark.parametrize("unit", [1e-3, 1e6])
def test_levels_are_as_near_whatever_the_unit(unit: float) -> None:
    full, place = ball(), np.array([3.0, -2.0, 1.0], np.float32)
    other = replace(full, vertices=((full.vertices + place) * unit).astype(np.float32))
    for plain, level in zip(make_levels(full, None, 2, Reporter()), make_levels(other, None, 2, Reporter())):
        assert len(level.surface.faces) == pytest.approx(len(plain.surface.faces), rel=0.01)
        assert level.deviation == pytest.approx(plain.deviation * unit, rel=0.1)


@pytest.mark.parametrize("simplify", [decimate, decimate_closed])
def test_a_small_region_is_simplified_as_well_as_a_large_one(simplify: Callable) -> None:
    """As of a thing in a room, or of a block of a large capture."""
    round_ball = trimesh.creation.icosphere(4)
    places = np.asarray(round_ball.vertices)
    bumpy = places * (1 + 0.15 * np.sin(7 * places).prod(1))[:, None]
    points, far = sample_surface(bumpy, round_ball.faces, 5000)[0], []
    for size in (1.0, 0.01):
        vertices, faces = simplify(bumpy * size, np.asarray(round_ball.faces), 600, Reporter())
        assert len(faces) <= 660
        far.append(np.quantile(ClosestPoints(vertices / size, faces).find(points)[2], 0.95))
    assert far[1] == pytest.approx(far[0], rel=0.2)


def test_levels_keep_class_borders_and_stay_closed_and_near() -> None:
    full = ball()
    levels = make_levels(full, None, 2, Reporter())
    counts = [len(full.faces), *(len(level.surface.faces) for level in levels)]
    assert counts[1] == pytest.approx(counts[0] / 4, rel=0.02)
    assert counts[2] < 0.5 * counts[1]
    for level in levels:
        made = level.surface
        assert is_watertight(made.faces)
        for number in (1, 2, 5):
            ours = outline(full.vertices, full.faces[full.face_class == number])
            assert outline(made.vertices, made.faces[made.face_class == number]) == ours
        assert ((made.face_instance == 1) == (made.face_class == 1)).all()
        assert np.abs(np.linalg.norm(made.normals, axis=1) - 1).max() < 1e-5
        assert np.abs(made.colors - (made.vertices / 44 + 0.5) * 255).max() < 8
    # No place of either surface is farther than half a voxel from the other.
    first = levels[0].surface
    theirs = ClosestPoints(first.vertices, first.faces).find(full.vertices)[2]
    ours = ClosestPoints(full.vertices, full.faces).find(first.vertices[first.faces].mean(1))[2]
    assert max(theirs.max(), ours.max()) <= 0.5
    assert levels[0].deviation <= 0.1
    assert levels[1].deviation > levels[0].deviation


def test_chunks_leave_no_cracks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decimation, "CHUNK", 700)
    full = ball()
    _, faces, patch = decimate_patches(
        full.vertices.astype(float), full.faces, full.face_class, len(full.faces) // 6, Reporter()
    )
    assert is_watertight(faces)
    assert len(faces) < len(full.faces) / 4
    assert set(patch.tolist()) == {1, 2, 5}


def test_collapses_that_fold_an_edge_are_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    full = ball()
    upper, scale = full.face_class == 1, decimation.enlargement(full.vertices)
    real = decimation.fast_simplification.simplify

    def folding(points: np.ndarray, triangles: np.ndarray, **how):
        points, triangles, *_ = real(points, triangles, **how)
        if points[:, 2].max() > 15 * scale:  # the patch at the top gets a fin
            fin = [*triangles[0, :2], len(points)]
            points, triangles = np.vstack([points, points[0] + 1]), np.vstack([triangles, fin])
        return points, triangles

    monkeypatch.setattr(decimation.fast_simplification, "simplify", folding)
    _, faces, patch = decimate_patches(
        full.vertices.astype(float), full.faces, full.face_class, len(full.faces) // 4, Reporter()
    )
    assert most_at_an_edge(faces) == 2
    assert is_watertight(faces)
    assert (patch == 1).sum() == upper.sum()
    assert (patch == 2).sum() < 0.5 * (full.face_class == 2).sum()


def test_where_all_large_chunks_fold_smaller_ones_are_simplified(monkeypatch: pytest.MonkeyPatch) -> None:
    full = ball()
    real = decimation.fast_simplification.simplify

    def folding(points: np.ndarray, triangles: np.ndarray, **how):
        large = len(triangles) > decimation.SMALL_CHUNK
        points, triangles, *_ = real(points, triangles, **how)
        if large:
            fin = [*triangles[0, :2], len(points)]
            points, triangles = np.vstack([points, points[0] + 1]), np.vstack([triangles, fin])
        return points, triangles

    monkeypatch.setattr(decimation.fast_simplification, "simplify", folding)
    faces = make_levels(full, None, 1, Reporter())[0].surface.faces
    assert is_watertight(faces)
    assert len(faces) < 0.4 * len(full.faces)


def test_a_level_has_the_texture_of_the_full_surface(tmp_path: Path) -> None:
    full = ball()
    # One texel row of the texture for each height, by a plain projection.
    image = np.zeros((512, 512, 3), np.uint8)
    image[..., 0] = np.linspace(255, 0, 512)[:, None]
    image[..., 1] = 90
    uv = (full.vertices[full.faces][..., [0, 2]] / 42 + 0.5).astype(np.float32)
    (level,) = make_levels(full, texture_of(full.faces, uv, image), 1, Reporter())
    assert level.texture is not None
    assert level.texture.image.shape == (256, 256, 3)
    assert level.uv is not None
    middle = (level.uv.mean(1) * [1, -1] * 256 + [0, 256]).astype(int)
    found = level.texture.image[middle[:, 1], middle[:, 0]].astype(float)
    height = level.surface.vertices[level.surface.faces].mean(1)[:, 2]
    assert np.abs(found[:, 0] - (height / 42 + 0.5) * 255).max() < 8
    assert np.abs(found[:, 1] - 90).max() <= 1
    files = write_level(tmp_path, 1, level, Reporter().check)
    assert [path.name for path in files] == ["mesh_lod1.npz", "texture_lod1.png"]
    with np.load(files[0]) as data:
        assert {"vertices", "faces", "face_class", "face_instance", "uv"} <= set(data.files)
    (tmp_path / "mesh.npz").write_bytes(b"")
    assert sorted(level_files(tmp_path)) == sorted(files)


@pytest.mark.parametrize("number", [1, 2])
def test_detail_finer_than_a_level_shows_becomes_its_mean(number: int) -> None:
    full = ball()
    image = np.random.default_rng(0).integers(0, 2, (1024, 1024, 1), np.uint8).repeat(3, 2) * np.uint8(200)
    uv = (full.vertices[full.faces][..., [0, 2]] / 42 + 0.5).astype(np.float32)
    level = make_levels(full, texture_of(full.faces, uv, image), number, Reporter())[-1]
    assert level.texture is not None
    middle = (level.uv.mean(1) * [1, -1] * len(level.texture.image) + [0, len(level.texture.image)]).astype(int)
    found = level.texture.image[middle[:, 1], middle[:, 0]].astype(float)
    assert found.mean() == pytest.approx(100, abs=3)
    assert found.std() < 0.7 / number * image.std()  # of a mean of 2 × 2, or 4 × 4, weighted by distance


def test_without_instances_and_when_stopped() -> None:
    full = replace(ball(), face_instance=None)
    (level,) = make_levels(full, None, 1, Reporter())
    assert level.surface.face_instance is None
    assert make_levels(full, None, 0, Reporter()) == []
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        make_levels(full, None, 1, report)


def test_closest_points_are_those_of_another_library() -> None:
    mesh = trimesh.creation.icosphere(2)
    points = np.random.default_rng(0).normal(size=(300, 3))
    face, weights, distance = ClosestPoints(mesh.vertices, mesh.faces).find(points)
    there = (mesh.vertices[mesh.faces[face]] * weights[..., None]).sum(1)
    every = np.stack(
        [trimesh.triangles.closest_point(mesh.triangles, np.tile(p, (len(mesh.faces), 1))) for p in points]
    )
    true = np.linalg.norm(every - points[:, None], axis=2).min(1)
    np.testing.assert_allclose(distance, true, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(there - points, axis=1), true, atol=1e-5)
