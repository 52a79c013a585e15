"""The kernels of surfaces against their references, on all devices that run them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.kernels import surface
from fieldwork.nerfcore.kernels.closest import ClosestPoints
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.kernels.packed_info import PackedInfo
from fieldwork.nerfcore.kernels.patch_sums import quads
from fieldwork.nerfcore.kernels.patches import refine
from fieldwork.nerfcore.kernels.raycast import FrontFaces
from fieldwork.nerfcore.kernels.triangles import nearest_triangle
from fieldwork.nerfcore.mesh.depth_maps import DepthMap, FlatView, confirmed_maps, map_arrays, normals
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support import (
    normals_reference,
    patches_reference,
    surface_reference,
    triangles_reference,
)
from fieldwork.tests.nerfcore.support.backends import WARP_DEVICES
from fieldwork.tests.nerfcore.support.depth_views import maps_of, orbit, sphere

CPU = torch.device("cpu")
SMALL = Camera(width=60, height=45, fx=55.0, fy=56.0, cx=29.0, cy=23.0)


def on(device: str, maps: MapArrays) -> MapArrays:
    return MapArrays(*[getattr(maps, f.name).to(device) for f in fields(maps)])


@pytest.fixture(scope="module")
def views() -> tuple[list[FlatView], list[DepthMap]]:
    return maps_of(sphere(0.5), orbit(9, 1.8))


@pytest.fixture(scope="module")
def rough(views: tuple[list[FlatView], list[DepthMap]]) -> MapArrays:
    """A ball's depth maps with errors of 1 %, holes, and spreads around a voxel."""
    maps, random = map_arrays(*views, CPU), torch.Generator().manual_seed(2)
    depth = maps.depth * (1 + 0.01 * torch.randn(maps.depth.shape, generator=random))
    depth = torch.where(maps.depth < FREE, depth, maps.depth)
    holes = torch.rand(depth.shape, generator=random) < 0.05
    spread = 0.05 * torch.rand(depth.shape, generator=random)
    return replace(maps, depth=torch.where(holes, 0.0, depth), spread=spread, certain=(spread < 0.03).float())


@pytest.fixture(scope="module")
def beside(rough: MapArrays) -> MapArrays:
    """The same of photos that end within their picture, as those of lenses do: beside them depths are negative."""
    depth = rough.depth.clone()
    for first, (width, height) in zip(rough.first.tolist(), rough.size.tolist()):
        depth[first : first + width * height].view(height, width)[:, 2 * width // 3 :] = -1.0
    return replace(rough, depth=torch.where(torch.arange(len(depth)) < int(rough.first[1]), rough.depth, depth))


def on_ball(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (N, 3) within 5 % of a ball's surface, and directions (N, 3) of all kinds beside its normals."""
    random = torch.Generator().manual_seed(3)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    far = 0.5 * (1 + 0.05 * torch.randn(count, 1, generator=random))
    turned = torch.nn.functional.normalize(normal + 0.8 * torch.randn(count, 3, generator=random), dim=1)
    return normal * far, turned


def test_depth_quantiles_equal_their_reference(device: torch.device) -> None:
    random = torch.Generator().manual_seed(0)
    count = torch.tensor([0, 5, 17, 1, 9], dtype=torch.int32)
    start = torch.cat([torch.zeros(1, dtype=torch.int32), count.cumsum(0)[:-1].int()])
    total = int(count.sum())
    ray = torch.repeat_interleave(torch.arange(5), count.long()).int()
    density, delta = 8 * torch.rand(total, generator=random), 0.2 * torch.rand(total, generator=random)
    depth = torch.rand(total, generator=random).sort().values
    expected = surface_reference.depth_quantiles(density, delta, depth, PackedInfo(start, count, ray))
    packed_info = PackedInfo(start.to(device), count.to(device), ray.to(device))
    found = surface.depth_quantiles(density.to(device), delta.to(device), depth.to(device), packed_info)
    assert sum(far > 0 for _, _, far, _ in expected) >= 2
    torch.testing.assert_close(torch.stack(found, 1).cpu(), torch.tensor(expected), atol=2e-5, rtol=1e-4)


def test_the_median_depth_of_a_wall_is_where_half_is_absorbed(device: torch.device) -> None:
    density, delta = torch.full((100,), 5.0, device=device), torch.full((100,), 0.01, device=device)
    depth = 1 + 0.01 * (torch.arange(100, device=device) + 0.5)
    starts, counts, ray = (torch.tensor(x, dtype=torch.int32, device=device) for x in ([0], [100], [0] * 100))
    found = surface.depth_quantiles(density, delta, depth, PackedInfo(starts, counts, ray))
    near, middle, far, opacity = (float(x) for x in found)
    assert [near, middle, far] == pytest.approx([1 + np.log(s) / 5 for s in (4 / 3, 2, 4)], abs=1e-4)
    assert opacity == pytest.approx(1 - np.exp(-5), abs=1e-5)


@pytest.mark.parametrize("device", WARP_DEVICES)
def test_fused_distances_equal_their_reference(device: str, views: tuple[list[FlatView], list[DepthMap]]) -> None:
    maps = confirmed_maps(*views, CPU, Reporter())
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) * 1.4 - 0.7
    ours = [x.cpu() for x in surface.fuse(points.to(device), on(device, maps), 0.02, 0.08, 0.03, 0.03)]
    expected = surface_reference.fuse(points, maps, 0.02, 0.08, 0.03, 0.03)
    # A point that falls on the border of two pixels may take the other one: rounding differs.
    same = (ours[0] - expected[0]).abs() < 1e-4
    assert float(same.float().mean()) > 0.998
    torch.testing.assert_close(ours[1][same], expected[1][same], rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("device", WARP_DEVICES)
def test_unsure_and_thin_places_are_fused_as_their_reference_says(device: str, rough: MapArrays) -> None:
    points, _ = on_ball(4000)
    ours = [x.cpu() for x in surface.fuse(points.to(device), on(device, rough), 0.02, 0.08, 0.03, 0.03)]
    expected = surface_reference.fuse(points, rough, 0.02, 0.08, 0.03, 0.03)
    assert 0.2 < float((expected[0] < 0).float().mean()) < 0.8
    same = (ours[0] - expected[0]).abs() < 1e-4
    assert float(same.float().mean()) > 0.99
    assert float(((ours[1] - expected[1]).abs() < 1e-3 * expected[1] + 1e-2).float().mean()) > 0.99


def test_normals_of_depths_equal_their_reference() -> None:
    flats, maps = maps_of(sphere(0.5), orbit(3, 1.8), SMALL)
    depth = np.where(np.random.default_rng(3).random(maps[0].depth.shape) < 0.02, 0, maps[0].depth)
    expected = normals_reference.normals(flats[0].camera, depth)
    ours = normals(flats[0].camera, depth)
    assert (depth >= FREE).mean() > 0.2
    assert 0.1 < (expected != 0).any(-1).mean() < 0.8
    assert np.abs(ours - expected).max() < 1e-5


@pytest.mark.parametrize("device", WARP_DEVICES)
@pytest.mark.parametrize("ends", [False, True])
def test_as_many_views_agree_as_their_reference_says(
    device: str, rough: MapArrays, beside: MapArrays, ends: bool
) -> None:
    rough = beside if ends else rough
    others = [1, 2, 3, 4, 5, 6, 7, 8]
    near = torch.tensor(others, dtype=torch.int32, device=device)
    ours = surface.agreement(on(device, rough), 0, near, 0.02, 1.5).cpu()
    expected = surface_reference.agreement(rough, 0, others, 0.02, 1.5)
    assert torch.equal(surface.agreement(on(device, rough), 0, near, 0.02, 1.5, 2).cpu(), ours.clamp(max=2))
    assert len(expected.unique()) >= 4
    assert ours.shape == expected.shape
    assert float((ours == expected)[expected > 0].float().mean()) > 0.99
    assert float((ours == expected).float().mean()) > 0.998


@pytest.mark.parametrize("device", WARP_DEVICES)
@pytest.mark.parametrize("ends", [False, True])
def test_as_many_views_could_show_a_place_as_their_reference_says(
    device: str, rough: MapArrays, beside: MapArrays, ends: bool
) -> None:
    others = [1, 2, 3, 4, 5, 6, 7, 8]
    everywhere, rough = surface_reference.able_views(rough, 0, others, 0.03), beside if ends else rough
    near = torch.tensor(others, dtype=torch.int32, device=device)
    ours = surface.able_views(on(device, rough), 0, near, 0.03).cpu()
    expected = surface_reference.able_views(rough, 0, others, 0.03)
    assert bool((expected <= everywhere).all())
    assert (int((expected < everywhere).sum()) > 500) == ends
    assert torch.equal(surface.able_views(on(device, rough), 0, near, 0.03, 2).cpu(), ours.clamp(max=2))
    assert len(expected.unique()) >= 4
    assert float((ours == expected)[expected > 0].float().mean()) > 0.99


@pytest.mark.parametrize("device", WARP_DEVICES)
def test_views_see_points_as_well_as_their_reference_says(device: str, rough: MapArrays) -> None:
    points, directions = on_ball(4000)
    ours = surface.sight(points.to(device), directions.to(device), on(device, rough), 0.03).cpu()
    expected = surface_reference.sight(points, directions, rough, 0.03)
    assert 0.05 < float((expected > 0).float().mean()) < 0.6
    same = (ours - expected).abs() <= 1e-3 * expected + 1e-3
    assert float(same[expected > 0].float().mean()) > 0.995
    assert float(same.float().mean()) > 0.999


@pytest.mark.parametrize("device", WARP_DEVICES)
def test_slopes_are_compared_as_their_reference_says(device: str, rough: MapArrays) -> None:
    points, directions = on_ball(4000)
    ours = surface.slopes(points.to(device), directions.to(device), on(device, rough), 0.03, 0.3).cpu()
    expected = surface_reference.slopes(points, directions, rough, 0.03, 0.3)
    assert (expected.mean(0) > 0.2).all()
    everything = replace(rough, certain=torch.ones_like(rough.certain))
    assert (surface_reference.slopes(points, directions, everything, 0.03, 0.3).mean(0) > 1.2 * expected.mean(0))[1]
    assert float((ours == expected).float().mean()) > 0.995


@pytest.fixture(scope="module")
def painted() -> tuple[MapArrays, np.ndarray, np.ndarray]:
    """A painted ball whose depths are up to 1.5 % off: maps, photos (P,) and normals (H·W, 3) of the first view."""
    flats, maps = maps_of(sphere(0.5), orbit(24, 1.8), SMALL)
    grey = []
    for flat, map_ in zip(flats, maps):
        local, _ = rays(flat.camera, pixel_centers(flat.camera.width, flat.camera.height).reshape(-1, 2))
        z = np.where(map_.hit, map_.depth, 1).reshape(-1, 1)
        points = (local / local[:, 2:] * z) @ flat.pose[:3, :3].T + flat.pose[:3, 3]
        tone = 0.5 + 0.2 * np.sin(23 * points + 5 * np.sin(11 * points[:, [1, 2, 0]])).sum(1) / 1.5
        grey.append(np.where(map_.hit.reshape(-1), tone, 0.1).astype(np.float32))
    arrays = map_arrays(flats, maps, CPU)
    wave = 1 + 0.015 * torch.sin(torch.arange(len(arrays.depth)) / 7.0)
    arrays = replace(arrays, depth=torch.where(arrays.depth < FREE, arrays.depth * wave, arrays.depth))
    arrays = replace(arrays, spread=torch.full_like(arrays.spread, 0.05))
    return arrays, np.concatenate(grey), normals(flats[0].camera, maps[0].depth).reshape(-1, 3).astype(np.float32)


def quads_of(grey: np.ndarray, maps: MapArrays) -> torch.Tensor:
    """Photos (P,) of maps of one size as `refine` takes them."""
    width, height = maps.size[0].tolist()
    return torch.cat([quads(torch.from_numpy(photo)) for photo in grey.reshape(-1, height, width)])


@pytest.mark.parametrize("host", [False, True])
@pytest.mark.parametrize("device", WARP_DEVICES)
def test_photos_move_depths_as_their_reference_says(
    device: str, host: bool, painted: tuple[MapArrays, np.ndarray, np.ndarray]
) -> None:
    if host and device != "cpu":
        pytest.skip("this code is for CPUs")
    maps, grey, normal = painted
    others, least, gain = [3, 8, 5, 16, 21], 0.6, 0.05
    near = torch.tensor(others, dtype=torch.int32, device=device)
    facing = torch.from_numpy(normal).to(device)
    depth, score = refine(quads_of(grey, maps).to(device), facing, on(device, maps), 0, near, least, gain, host)
    views = patches_reference.Views(maps, grey)
    pixels = [(row, column) for row in range(0, SMALL.height, 3) for column in range(0, SMALL.width, 4)]
    expected = np.array(
        [
            patches_reference.refined(views, 0, others, row, column, normal[row * SMALL.width + column], least, gain)
            for row, column in pixels
        ]
    )
    place = [row * SMALL.width + column for row, column in pixels]
    before = maps.depth[place].double().numpy()
    moved = expected[:, 0] != before
    assert moved.sum() > 15
    ours_depth, ours_score = depth.cpu()[place].double().numpy(), score.cpu()[place].double().numpy()
    assert ((ours_score == -1) == (expected[:, 1] == -1)).all()
    assert (np.abs(ours_score - expected[:, 1]) < 1e-3).mean() > 0.99
    # Depths hardly apart may be equally good: the other one may be taken.
    same = np.abs(ours_depth - expected[:, 0]) <= 1e-4 * before
    assert same[moved].mean() > 0.95
    assert same.mean() > 0.98


def test_rays_meet_the_triangles_that_their_reference_says() -> None:
    """Triangles in a tangle, half of them seen from behind, which rays pass."""
    random = np.random.default_rng(4)
    centers = random.uniform(-1, 1, (60, 1, 3))
    vertices = (centers + random.normal(0, 0.3, (60, 3, 3))).reshape(-1, 3).astype(np.float32)
    faces = np.arange(180).reshape(60, 3)
    origins = random.normal(size=(2000, 3))
    origins = (3 * origins / np.linalg.norm(origins, axis=1, keepdims=True)).astype(np.float32)
    directions = random.uniform(-1, 1, (2000, 3)) - origins
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    face, corner = FrontFaces(vertices, faces).cast(origins, directions)
    doubles = (x.astype(float) for x in (vertices, origins, directions))
    points, start, ahead = doubles
    expected, weights, margin = triangles_reference.cast(points, faces, start, ahead)
    clear = margin > 1e-4  # rays through an edge may meet either side of it
    assert clear.mean() > 0.97
    assert 0.1 < (expected == -1).mean() < 0.9
    assert (face == expected)[clear].mean() > 0.999
    hit = clear & (face == expected) & (expected >= 0)
    assert np.abs(corner[hit] - weights[hit]).max() < 1e-3


@pytest.mark.parametrize("unit", [1e-6, 1e3, 1e7])
def test_rays_and_closest_points_reach_as_far_in_any_unit(unit: float) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * unit
    faces, eye = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0.6, 0.3, 2.0]]) * unit
    face, _ = FrontFaces(square, faces).cast(eye, np.array([[0.0, 0.0, -1.0]]))
    assert face.tolist() == [0]
    closest, _, distance = ClosestPoints(square, faces).find(eye)
    assert closest.tolist() == [0]
    assert distance[0] == pytest.approx(2 * unit)


@pytest.mark.parametrize("device", WARP_DEVICES)
def test_the_nearest_triangle_of_a_pixel_is_that_of_its_reference(device: str) -> None:
    random = np.random.default_rng(5)
    pixels = random.uniform(-10, 60, (90, 2)).astype(np.float32)
    depth = random.uniform(0.5, 5, 90).astype(np.float32)
    depth[::17] = -1  # behind the camera
    faces = random.permutation(90).reshape(30, 3)
    triangle, z = nearest_triangle(pixels, depth, faces, 50, 40, torch.device(device))
    expected, at = triangles_reference.nearest(pixels.astype(float), depth.astype(float), faces, 50, 40)
    assert len(np.unique(expected)) > 8
    same = triangle == expected
    assert same.mean() > 0.998
    shown = same & (expected >= 0)
    assert np.abs(z[shown] / at[shown] - 1).max() < 1e-4
    assert np.isinf(z[triangle == -1]).all()
