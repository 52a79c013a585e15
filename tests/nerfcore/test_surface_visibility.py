"""Depth buffers of a mesh against exact depths; pieces of a mesh and their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.facelets import facelets
from fieldwork.nerfcore.mesh.visibility import DepthBuffers, PosedCamera, depth_buffer, observe
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.flat import LENS, box_mesh, looking, on_plane, ring, wall_mesh

FISHEYE = Camera(
    model="OPENCV_FISHEYE", width=320, height=240, fx=170, fy=170, cx=160, cy=120, distortion=(0.02, 0, 0, 0)
)
PANORAMA = Camera(model="EQUIRECTANGULAR", width=512, height=256, fx=1, fy=1, cx=256, cy=128)


@pytest.mark.parametrize("camera", [LENS, LENS.undistorted(), FISHEYE, PANORAMA], ids=lambda c: c.model)
def test_depth_is_that_of_the_ray_through_the_pixel_centre(camera: Camera) -> None:
    vertices, faces, _ = wall_mesh(60)
    pose = looking((0.1, 0, 0), (0.5, 0.4, 1.5))
    buffer = depth_buffer(PosedCamera(camera, pose), vertices, faces)
    points, depth = on_plane(camera, pose)
    if camera.model in ("EQUIRECTANGULAR", "OPENCV_FISHEYE"):
        depth = np.linalg.norm(points - pose[:3, 3], axis=1)
        ahead = (points - pose[:3, 3]) @ pose[:3, 2] > 0
    else:
        ahead = depth > 0
    inside = ahead & (np.abs(points[:, :2]).max(1) < 0.59)
    outside = ~ahead | (np.abs(points[:, :2]).max(1) > 0.61)
    found = buffer.depth.reshape(-1)
    assert inside.sum() > 300
    assert np.abs(found[inside] - depth[inside]).max() < 2e-3 if camera.distortion else 1e-4
    assert not np.isfinite(found[outside]).any()


def test_a_box_hides_what_is_behind_it_and_its_own_back() -> None:
    wall, wall_faces, _ = wall_mesh(24, half=1.5)
    box, box_faces = box_mesh(0.2)
    vertices = np.concatenate([wall, box + [0, 0, 0.6]])
    faces = np.concatenate([wall_faces, box_faces + len(wall)])
    pieces = facelets(vertices, faces, limit=0.08)
    view = PosedCamera(LENS, looking((0, 0, 0), (0, 0.01, 3.0)))
    seen = observe(DepthBuffers([view], pieces), Reporter())
    visible = seen.view[:, 0] == 0
    center = pieces.centers
    on_wall = pieces.parent < len(wall_faces)
    # The shadow of the box's front on the wall, from 3 away: 0.2 · 3 / 2.2.
    shadow = 0.2 * 3 / 2.2
    middle = np.abs(center[:, :2]).max(1)
    assert not visible[on_wall & (middle < shadow - 0.06)].any()
    assert visible[on_wall & (middle > shadow + 0.1) & (middle < 1.0)].all()
    front = ~on_wall & (pieces.normals[:, 2] > 0.9)
    assert visible[front].all()
    assert not visible[~on_wall & (pieces.normals[:, 2] < -0.9)].any()


def test_better_views_come_first_out_of_many() -> None:
    pieces = facelets(*wall_mesh(6)[:2])
    far = [looking((0, 0, 0), (0, 0.01, z)) for z in (6.0, 5.0, 4.0)]
    near = [PosedCamera(LENS, pose) for pose in ring(4, radius=0.3)]
    seen = observe(DepthBuffers([*(PosedCamera(LENS, p) for p in far), *near], pieces), Reporter(), most=4)
    assert {3, 4, 5, 6} == set(np.unique(seen.view).tolist())


def test_views_whose_masks_hide_a_piece_do_not_take_the_place_of_others() -> None:
    pieces = facelets(*wall_mesh(6)[:2])
    hidden = np.ones((LENS.height, LENS.width), bool)
    hidden[:, LENS.width // 2 :] = False
    near = [PosedCamera(LENS, looking((0, 0, 0), (0.01 * n, 0.01, 2.0)), lambda: hidden) for n in range(4)]
    far = PosedCamera(LENS, looking((0, 0, 0), (0, 0.01, 6.0)))
    seen = observe(DepthBuffers([*near, far], pieces), Reporter(), most=4)
    by_far, by_near = (seen.view == 4).any(1), ((seen.view >= 0) & (seen.view < 4)).any(1)
    assert (by_far | by_near).all()
    side = pieces.centers @ near[0].pose[:3, 0]
    assert not by_near[side > 0.05].any()
    assert by_near[side < -0.05].all()
    assert by_far[side > 0.05].all()


def test_what_hides_a_wall_at_the_edge_of_a_panorama_hides_all_of_it() -> None:
    wall, wall_faces, _ = wall_mesh(8)
    front = wall * [1.2, 1.2, 1] + [0, 0, 1.0]
    vertices, faces = np.concatenate([wall, front]), np.concatenate([wall_faces, wall_faces + len(wall)])
    pieces = facelets(vertices, faces, limit=0.1)
    for turn in (0, 90, 180):  # 180: the wall lies across the edge
        pose = looking((0, 0, 0), (0, 0.001, 3.0))
        angle = np.radians(turn)
        pose[:3, :3] = pose[:3, :3] @ [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        buffer = depth_buffer(PosedCamera(PANORAMA, pose), pieces.vertices, pieces.faces)
        drawn = pieces.parent[buffer.face[buffer.face >= 0]]
        assert (drawn >= len(wall_faces)).all(), turn
        assert len(drawn) > 1000
        seen = observe(DepthBuffers([PosedCamera(PANORAMA, pose)], pieces), Reporter())
        visible = seen.view[:, 0] == 0
        assert not visible[pieces.parent < len(wall_faces)].any(), turn
        assert visible[pieces.parent >= len(wall_faces)].all(), turn


def test_pieces_cover_the_mesh_and_know_their_neighbours() -> None:
    vertices, faces, corners = wall_mesh(2)
    pieces = facelets(vertices, faces, corners, limit=0.11)
    assert len(pieces) > 20 * len(faces)
    assert pieces.areas.sum() == pytest.approx(1.2**2)
    assert np.linalg.norm(np.diff(pieces.vertices[pieces.faces], axis=1), axis=2).max() <= 0.11
    assert np.abs(pieces.corners - (pieces.vertices[pieces.faces][..., :2] / 0.6 + 1) / 2).max() < 1e-6
    inner = pieces.neighbours >= 0
    back = pieces.neighbours[pieces.neighbours[inner], pieces.opposite[inner]]
    assert (back == np.nonzero(inner)[0]).all()
    # Only the rim has edges without a neighbour: cracks would show as more.
    ends = pieces.vertices[pieces.faces[np.nonzero(~inner)[0], np.nonzero(~inner)[1]]]
    assert (np.abs(ends[:, :2]).max(1) > 0.599).all()


def test_walls_that_reach_behind_the_camera_are_drawn_in_pieces() -> None:
    vertices, faces, _ = wall_mesh(1, half=30.0)
    pieces = facelets(vertices, faces, limit=1.0)
    pose = looking((0, 10, 0.3), (0, 0, 0.5))
    buffer = depth_buffer(PosedCamera(LENS, pose), pieces.vertices, pieces.faces)
    points, depth = on_plane(LENS, pose)
    inside = (depth > 2) & (np.abs(points[:, :2]).max(1) < 28)
    assert np.isfinite(buffer.depth.reshape(-1)[inside]).all()
