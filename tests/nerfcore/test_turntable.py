"""Pictures of a mesh from all around, or from before what has a front alone."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import DiskError
from fieldwork.nerfcore.mesh.parts import texture_of
from fieldwork.nerfcore.mesh.surface import Surface
from fieldwork.nerfcore.mesh.turntable import framed, front_angles, write_turntable
from fieldwork.nerfcore.params import TurntableParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import ball_project
from PIL import Image


def test_a_turntable_shows_fronts_in_their_colours(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3, 1.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    colors = np.where(vertices[:, 2:] > 0, [250, 10, 10], [10, 10, 250]).astype(np.uint8)
    ids = np.where(vertices[:, 2] > 0, 3, 7)
    surface = Surface(vertices, faces, vertices, colors, ids, ids[faces[:, 0]])
    paths = write_turntable(tmp_path, surface, None, {3: (0.0, 1.0, 0.0)}, Reporter())
    assert len(paths) == 16
    color, label = (np.array(Image.open(tmp_path / f"{name}_0.png")).astype(int) for name in ("color", "class"))
    shown = (color != color[0, 0]).any(-1)
    rows = np.flatnonzero(shown.any(1))
    assert shown.mean() == pytest.approx(np.pi * 0.47**2, abs=0.02)
    upper, lower = color[rows[0] + 20, 320], color[rows[-1] - 20, 320]
    assert upper[0] > 200 > upper[2]
    assert lower[2] > 200 > lower[0]
    assert label[rows[0] + 20, 320, 1] > 100 > label[rows[-1] - 20, 320, 1]
    inside_out = Surface(vertices, faces[:, ::-1], -vertices, colors, ids, surface.face_class)
    write_turntable(tmp_path, inside_out, None, {}, Reporter())
    within, clay = (np.array(Image.open(tmp_path / f"{name}_0.png")).astype(int) for name in ("color", "class"))
    # Without any class only the shape is shown, light before the dark background.
    assert (clay == clay[..., :1]).all()
    assert np.median(clay[shown]) > 100 > clay[0, 0, 0]
    assert np.ptp(clay[shown]) > 50
    assert color[320, 320, 0] > 200 > color[320, 320, 2]
    assert within[320, 320, 2] > 200 > within[320, 320, 0]  # through the near upper side, onto the far lower one
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :4, 1] = image[:, 4:, 0] = 200  # green on the left, red on the right
    left = np.broadcast_to(np.where(vertices[faces].mean(1)[:, :1, None] > 0, 0.25, 0.75), (len(faces), 3, 1))
    texture = texture_of(faces, np.concatenate([left, np.full_like(left, 0.5)], 2), image)
    class_map = np.where(image[..., 1] > 0, 5, 6)
    write_turntable(tmp_path, surface, texture, {5: (0.0, 0.0, 1.0), 6: (1.0, 1.0, 0.0)}, Reporter(), class_map)
    near, far = (np.array(Image.open(tmp_path / f"class_{number}.png")).astype(int) for number in (0, 4))
    assert near[320, 320, 2] > 100 > near[320, 320, 0]  # classes of texels rather than of triangles
    assert far[320, 320, 0] > 100 > far[320, 320, 2]
    front, back = (np.array(Image.open(tmp_path / f"color_{number}.png")).astype(int) for number in (0, 4))
    assert front[320, 320] == pytest.approx([0, 200, 0], abs=2)
    assert back[320, 320] == pytest.approx([200, 0, 0], abs=2)


def test_a_turntable_stays_before_what_has_a_front_alone(tmp_path: Path) -> None:
    """A wall that faces +x, and its narrow sides: eight different views of it, none of its back."""
    wall = trimesh.creation.box((0.2, 3.0, 2.0))
    vertices, faces = np.asarray(wall.vertices), np.asarray(wall.faces)
    faces = faces[wall.face_normals[:, 0] > -0.5]
    angles = np.degrees(front_angles(vertices, faces))
    assert angles.min() == pytest.approx(-angles.max(), abs=6)
    assert 60 < angles.max() < 90
    plain = np.full(vertices.shape, 250, np.uint8)
    ids = np.zeros(len(vertices), int)
    write_turntable(tmp_path, Surface(vertices, faces, vertices, plain, ids, ids[faces[:, 0]]), None, {}, Reporter())
    views = [np.array(Image.open(tmp_path / f"color_{number}.png")) for number in range(8)]
    shares = [(view > 200).all(-1).mean() for view in views]
    assert min(shares) > 0.1
    assert len(np.unique(np.round(shares, 3))) >= 4


def test_a_little_that_is_far_off_does_not_make_the_rest_small() -> None:
    ball, far = trimesh.creation.icosphere(3, 1.0), trimesh.creation.icosphere(1, 0.05)
    far.apply_translation([5.0, 0, 0])
    both = trimesh.util.concatenate([ball, far])
    vertices = np.asarray(both.vertices)
    shown = framed(vertices, np.asarray(both.faces))
    np.testing.assert_allclose([shown.min(0), shown.max(0)], [[-1] * 3, [1] * 3], atol=1e-3)
    # What is no small part, or not far off, is in sight, and so is all of a few large triangles.
    large = trimesh.util.concatenate([ball, trimesh.creation.icosphere(2, 0.3).apply_translation([5.0, 0, 0])])
    near = trimesh.util.concatenate([ball, far.copy().apply_translation([-3.8, 0, 0])])
    for mesh in (large, near, ball, trimesh.creation.box((3.0, 2.0, 0.1))):
        assert len(framed(np.asarray(mesh.vertices), np.asarray(mesh.faces))) == len(mesh.vertices)


def test_a_folder_that_cannot_be_is_said_before_the_work(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball")
    (tmp_path / "file").touch()
    with pytest.raises(DiskError, match="in its way"):  # and not that there is no mesh yet
        run_verb("turntable", TurntableParams(project=project, out=tmp_path / "file"), Reporter())


def test_the_front_of_many_triangles_takes_little_memory() -> None:
    ball = trimesh.creation.icosphere(6)
    vertices, faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces)
    tracemalloc.start()
    angles = front_angles(vertices, faces)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(angles) == 72
    assert peak < 300 * len(faces)
