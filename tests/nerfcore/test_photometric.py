"""A surface moved to where painted photos of it agree."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.kernels.warping import NOT_SEEN, photo_forces
from fieldwork.nerfcore.mesh import photometric
from fieldwork.nerfcore.mesh.depth_maps import DepthMap, FlatView, map_arrays
from fieldwork.nerfcore.mesh.photometric import (
    Pictures,
    barycentric_slopes,
    bending,
    means_around,
    moved_by_photos,
    not_turned,
    pictures_of,
    thin,
    without_unknown,
)
from fieldwork.nerfcore.mesh.triangles import border_edges, cross
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support import warping_reference
from fieldwork.tests.nerfcore.support.backends import WARP_DEVICES
from fieldwork.tests.nerfcore.support.depth_views import CAMERA, maps_of, orbit, sphere
from fieldwork.tests.nerfcore.test_refine import painted_photos

CPU = torch.device("cpu")
RADIUS = 0.5


@pytest.fixture(scope="module")
def scene() -> tuple[list[FlatView], list[DepthMap], SimpleNamespace]:
    flats, true = maps_of(sphere(RADIUS), orbit(16, 1.8))
    store = painted_photos(flats, true)
    store.usable = None
    return flats, true, store


@pytest.fixture
def pictures(scene) -> Pictures:
    flats, true, store = scene
    return pictures_of(flats, store, map_arrays(flats, true, CPU), Reporter())


def ball(radius: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(4, radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def off(vertices: np.ndarray) -> float:
    """Median distance from the true ball."""
    return float(np.median(np.abs(np.linalg.norm(vertices, axis=1) - RADIUS)))


@pytest.mark.parametrize("device", WARP_DEVICES)
def test_forces_are_those_of_the_reference(scene, device: str) -> None:
    flats, true, _ = scene
    random = np.random.default_rng(3)
    maps = map_arrays(flats, true, CPU)
    smooth = np.sin(np.arange(len(maps.depth)) / 7)[:, None] * 0.2 + 0.5
    grey = np.concatenate([smooth + random.uniform(0, 0.2, smooth.shape), random.normal(0, 0.1, (len(smooth), 2))], 1)
    grey[random.uniform(size=len(grey)) < 0.01, 0] = NOT_SEEN
    nearest = maps.depth.numpy() * np.where(random.uniform(size=len(grey)) < 0.1, 0.8, 1)
    depth = torch.where(maps.depth < FREE, maps.depth, torch.zeros(()))
    maps, view, near = replace(maps, depth=depth), 2, [0, 5, 7]
    count = CAMERA.width * CAMERA.height
    facing = np.tile(-flats[view].pose[:3, 2], (count, 1)) + random.normal(0, 0.2, (count, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    expected = warping_reference.photo_forces(grey, facing, nearest, maps, view, near)
    moved = replace(maps, **{name: getattr(maps, name).to(device) for name in maps.__dataclass_fields__})
    given = [torch.from_numpy(a.astype(np.float32)).to(device) for a in (grey, facing, nearest)]
    found = photo_forces(*given, moved, view, torch.tensor(near, dtype=torch.int32, device=device)).cpu().numpy()
    assert (expected[:, 1] > 0).sum() > 50
    # A place on the border of what is hidden, or of a window that counts, may fall on either side in float32.
    close = np.isclose(found, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max(0)).all(1)
    assert close.mean() > 0.998


@pytest.mark.parametrize("radius", [0.97 * RADIUS, 1.03 * RADIUS])
def test_a_ball_gets_the_size_that_its_photos_show(pictures: Pictures, radius: float) -> None:
    vertices, faces = ball(radius)
    moved = moved_by_photos(vertices, faces, pictures, Reporter())
    assert off(moved) < 0.15 * off(vertices)


def test_bumps_go_and_what_is_right_stays(pictures: Pictures) -> None:
    vertices, faces = ball(RADIUS)
    bumps = 1 + 0.02 * np.sin(12 * vertices[:, :1]) * np.cos(9 * vertices[:, 1:2])
    moved = moved_by_photos(vertices * bumps, faces, pictures, Reporter())
    assert off(moved) < 0.3 * off(vertices * bumps)
    assert off(moved_by_photos(vertices, faces, pictures, Reporter())) < 0.001
    away = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    assert (away * vertices / RADIUS).sum(1).min() > np.cos(np.radians(2)), "vertices move along normals alone"


def test_the_misfit_is_least_where_the_surface_is(pictures: Pictures) -> None:
    def misfit(radius: float) -> float:
        vertices, faces = ball(radius)
        drawn = photometric._drawn(vertices, faces, pictures, Reporter())
        near = [[(n + 3) % 16, (n + 5) % 16] for n in range(16)]
        told = []

        def listened(*args):
            told.append(photo_forces(*args))
            return told[-1]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(photometric, "photo_forces", listened)
            normals = vertices / radius
            photometric._forces(vertices, faces, normals, pictures, drawn, near, Reporter())
        together = torch.cat(told)
        seen = together[:, 1] > 0
        return float(together[seen, 2].mean())

    assert misfit(RADIUS) < 0.5 * min(misfit(0.97 * RADIUS), misfit(1.03 * RADIUS))


def test_plain_photos_and_masked_ones_move_nothing(scene) -> None:
    flats, true, store = scene
    vertices, faces = ball(0.97 * RADIUS)
    maps = map_arrays(flats, true, CPU)
    plain = SimpleNamespace(**{**vars(store), "rgba": torch.full_like(store.rgba, 128)})
    plain.rgba[:, 3] = 255
    unmoved = moved_by_photos(vertices, faces, pictures_of(flats, plain, maps, Reporter()), Reporter())
    np.testing.assert_allclose(unmoved, vertices, atol=1e-6)
    clear = SimpleNamespace(**{**vars(store), "rgba": store.rgba.clone()})
    clear.rgba[:, 3] = 0
    unused = SimpleNamespace(**{**vars(store), "usable": torch.zeros(0, dtype=torch.long)})
    for hidden in (clear, unused):
        shown = pictures_of(flats, hidden, maps, Reporter())
        assert (shown.grey[:, 0] == NOT_SEEN).all()
        np.testing.assert_array_equal(moved_by_photos(vertices, faces, shown, Reporter()), vertices)


def test_a_mask_hides_its_own_pixels_alone(scene) -> None:
    flats, true, store = scene
    half = (torch.arange(len(store.rgba)) % CAMERA.width) < CAMERA.width // 2
    used = SimpleNamespace(**{**vars(store), "usable": half.nonzero()[:, 0]})
    shown = pictures_of(flats, used, map_arrays(flats, true, CPU), Reporter())
    torch.testing.assert_close(shown.grey[:, 0] >= 0, half)


def test_open_borders_stay(pictures: Pictures) -> None:
    vertices, faces = ball(0.97 * RADIUS)
    faces = faces[vertices[faces].mean(1)[:, 2] > 0]
    border = np.unique(border_edges(faces))
    moved = moved_by_photos(vertices, faces, pictures, Reporter())
    np.testing.assert_array_equal(moved[border], vertices[border])
    inner = np.setdiff1d(np.unique(faces), border)
    assert off(moved[inner]) < 0.3 * off(vertices[inner])


def test_vertices_move_as_far_as_they_are_free(pictures: Pictures) -> None:
    vertices, faces = ball(0.97 * RADIUS)
    height = vertices[:, 2] / RADIUS
    free = np.clip(2 * height, 0, 1)
    moved = moved_by_photos(vertices, faces, pictures, Reporter(), free)
    np.testing.assert_array_equal(moved[free == 0], vertices[free == 0])
    assert off(moved[free == 1]) < 0.15 * off(vertices[free == 1])
    steps = np.linalg.norm(moved - vertices, axis=1)
    assert 0 < np.median(steps[(free > 0) & (free < 0.1)]) < 0.5 * np.median(steps[free == 1])


def test_pixels_of_unknown_depth_say_nothing(scene, pictures: Pictures) -> None:
    """As in a block of a large capture, whose maps do not show what other blocks have in front of it."""
    depth = torch.where(torch.arange(len(pictures.maps.depth)) % 3 == 0, 0, pictures.maps.depth)
    partly = without_unknown(replace(pictures, maps=replace(pictures.maps, depth=depth)))
    known = (depth > 0) & (depth < FREE)
    assert known.any()
    torch.testing.assert_close(partly.grey[known], pictures.grey[known])
    assert (partly.grey[~known, 0] == NOT_SEEN).all()


def test_no_triangle_turns_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """One vertex that would pass its neighbours moves as they do; where all steps are wild, some stay where they are."""
    vertices, faces = ball(RADIUS)
    around, free = means_around(faces, len(vertices)), np.ones(len(vertices))
    small = 0.01 * vertices
    wild = small.copy()
    wild[7] = 0.3 * np.roll(vertices[7], 1)
    np.testing.assert_allclose(not_turned(vertices, wild, faces, around, free), small, atol=0.03)
    np.testing.assert_array_equal(not_turned(vertices, small, faces, around, free), small)
    random = np.random.default_rng(0).normal(0, 0.1, vertices.shape)
    for turns in (photometric.TURNS, 0):
        monkeypatch.setattr(photometric, "TURNS", turns)
        found = not_turned(vertices, random, faces, around, free)
        assert (cross(vertices, faces) * cross(vertices + found, faces)).sum(1).min() >= 0
    still = (found == 0).all(1)
    assert still.any()
    np.testing.assert_array_equal(found[~still], random[~still])
    free[7] = 0
    monkeypatch.setattr(photometric, "TURNS", 5)
    held = not_turned(vertices, free[:, None] * random, faces, around, free)
    np.testing.assert_array_equal(held[7], 0)


def test_what_is_thin_says_nothing_of_itself(pictures: Pictures) -> None:
    """A wire before a wall: photos mix the two in each of its pixels."""
    wall, wire = trimesh.creation.box((3, 0.1, 3)), trimesh.creation.cylinder(0.02, 2)
    wire.apply_translation((0, -0.5, 0))
    vertices = np.concatenate([wall.vertices, wire.vertices])
    faces = np.concatenate([wall.faces, wire.faces + len(wall.vertices)])
    pose = np.array([[1.0, 0, 0, 0], [0, 0, 1, -2], [0, -1, 0, 0], [0, 0, 0, 1]])
    view = replace(pictures.views[0], pose=pose)
    drawn = photometric._drawn(vertices, faces, replace(pictures, views=[view]), Reporter())[0]
    on_wire = drawn.face >= len(wall.faces)
    assert on_wire.sum() > 20
    assert thin(drawn)[on_wire].all()
    assert not thin(drawn)[~on_wire].any()
    moved = moved_by_photos(np.zeros((0, 3)), np.zeros((0, 3), int), pictures, Reporter())
    assert moved.shape == (0, 3)


def test_it_can_be_stopped_at_any_time(pictures: Pictures) -> None:
    vertices, faces = ball(RADIUS)

    class Stopped(Reporter):
        left = 0

        def check(self) -> None:
            self.left -= 1
            if self.left < 0:
                raise Cancelled

    for calls in (0, 3, 20, 60):
        report = Stopped()
        report.left = calls
        with pytest.raises(Cancelled):
            moved_by_photos(vertices, faces, pictures, report)


def test_progress_only_grows(pictures: Pictures) -> None:
    seen: list[float] = []

    class Listening(Reporter):
        def progress(self, fraction: float, message: str = "") -> None:
            seen.append(fraction)

    moved_by_photos(*ball(RADIUS), pictures, Listening())
    assert seen == sorted(seen)
    assert seen[0] >= 0
    assert 0.9 < seen[-1] <= 1


def test_weights_of_corners() -> None:
    random = np.random.default_rng(1)
    corners, weights = random.normal(size=(50, 3, 3)), random.dirichlet(np.ones(3), 50)
    points = np.einsum("nk,nkc->nc", weights, corners)
    slopes, offsets = barycentric_slopes(corners)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slopes, points) + offsets, weights, atol=1e-9)
    corners[:, 2] = corners[:, 1]  # without an area
    slopes, offsets = barycentric_slopes(corners)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slopes, points) + offsets, np.tile([1.0, 0, 0], (50, 1)))


def test_a_plate_bends_no_plane() -> None:
    place = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), -1).reshape(-1, 2)
    at = np.arange(64).reshape(8, 8)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
    plate = bending(means_around(np.concatenate([np.stack([a, b, c], 1), np.stack([d, c, b], 1)]), 64))
    plane = place @ [0.3, -0.7] + 2
    inner = ((place > 1) & (place < 6)).all(1)
    np.testing.assert_allclose((plate @ plane)[inner], 0, atol=1e-12)
    assert np.linalg.eigvalsh(plate.toarray()).min() > -1e-12
    assert (plate @ (place[:, 0] ** 4))[inner].min() > 0.1
