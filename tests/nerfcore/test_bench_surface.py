"""Figures of a mesh beside the true one where they are known, and the suite's table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.bench import surface as suite
from fieldwork.nerfcore.bench.surface_exposure import exposed
from fieldwork.nerfcore.bench.surface_figures import (
    Sight,
    Truth,
    both_sides,
    class_figures,
    hit_share,
    seam_ratio,
    surface_figures,
    volume_error,
)
from fieldwork.nerfcore.bench.surface_outlines import outline_texels, true_outline
from fieldwork.nerfcore.bench.surface_table import FIGURES, figure_table
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.metrics import distances
from fieldwork.nerfcore.mesh.painted import Painted
from fieldwork.nerfcore.mesh.photos import Photo
from fieldwork.nerfcore.mesh.surface import Surface
from fieldwork.nerfcore.mesh.surface_labels import ClassMaps, SurfaceClasses
from fieldwork.nerfcore.mesh.triangles import cross, unit
from fieldwork.nerfcore.mesh.uv import UvMap
from fieldwork.nerfcore.mesh.visibility import PosedCamera
from fieldwork.nerfcore.params import BenchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.depth_views import look_at, orbit
from fieldwork.tests.nerfcore.test_bench import TINY
from fieldwork.tests.nerfcore.test_training import tiny_project  # noqa: F401

CAMERA = Camera(width=90, height=90, fx=100.0, fy=100.0, cx=45.0, cy=45.0)


def ball_and_plate() -> Truth:
    """A ball of class 1 above a plate of class 2, two hundredths thick."""
    import trimesh

    ball = trimesh.creation.icosphere(4, 0.3)
    plate = trimesh.creation.box((0.8, 0.8, 0.02))
    plate = plate.subdivide_to_size(0.1).apply_translation((0, 0, -0.45))
    whole = trimesh.util.concatenate([ball, plate])
    kinds = np.repeat([1, 2], [len(ball.faces), len(plate.faces)])
    return Truth(np.asarray(whole.vertices), np.asarray(whole.faces), kinds)


def scene_around() -> Scene:
    views = [View(f"{k}", CAMERA, pose, image=None) for k, pose in enumerate(orbit(20, 2.0))]  # type: ignore[arg-type]
    return Scene(views, list(range(18)), [18, 19])


def as_surface(vertices: np.ndarray, faces: np.ndarray, kinds: np.ndarray) -> Surface:
    nothing = np.zeros((len(vertices), 3))
    return Surface(vertices, faces, nothing, nothing.astype(np.uint8), np.zeros(len(vertices), int), kinds)


def unpainted() -> Painted:
    none = np.zeros(0)
    return Painted(SurfaceClasses(none, none, none, none))


def test_the_truth_itself_has_no_fault() -> None:
    truth, scene = ball_and_plate(), scene_around()
    scene = Scene(scene.views, scene.train, [])  # pictures are measured with photos
    mesh = as_surface(truth.vertices, truth.faces, truth.face_class)
    found = surface_figures(mesh, unpainted(), truth, scene, 2)
    assert found["f_size"] == found["f_pixel"] == found["both_sides"] == pytest.approx(1)
    assert found["surface_miou"] > 0.999  # what no camera sees has the class of what one does
    assert found["excess_area"] == 0
    assert found["mesh_psnr"] is found["delta_e"] is found["gradient"] is found["seams"] is None
    assert found["class_area_error"] < 0.02  # though no camera sees the rim of the plate, and little below it


def test_a_photo_with_more_light_is_brighter_and_no_more_than_white() -> None:
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    rgba = np.stack([levels, levels, levels, 255 - levels], -1)
    view = scene_around().views[0]
    photo = Photo(PosedCamera(view.camera, np.eye(4)), lambda: rgba)
    more = exposed(photo, 1.0).read()
    assert more[12, 8].tolist() == [255, 255, 255, 55]  # 200 is 58 % of the light
    assert more[8, 0].tolist() == [176, 176, 176, 127]  # 21.6 % become 43.2 %, IEC 61966-2-1
    assert (exposed(photo, -1.0).read()[8, 0, :3] == 92).all()
    assert rgba[8, 0, 0] == 128


def test_the_truth_is_sampled_where_photos_look_however_large_it_is() -> None:
    """A ball above a ground of a square kilometre, of which the photos show a few metres."""
    import trimesh

    ball = trimesh.creation.icosphere(3, 0.3)
    ground = trimesh.Trimesh(
        [[-500, -500, -0.4], [500, -500, -0.4], [500, 500, -0.4], [-500, 500, -0.4]], [[0, 1, 2], [0, 2, 3]]
    )
    whole = trimesh.util.concatenate([ball, ground])
    kinds = np.repeat([1, 2], [len(ball.faces), 2])
    scene = scene_around()
    sight = Sight(Truth(np.asarray(whole.vertices), np.asarray(whole.faces), kinds), scene.views)
    points, face, area = sight.seen
    assert len(points) > 5000
    normals = unit(cross(np.asarray(whole.vertices), np.asarray(whole.faces)))
    assert sight.visible(points, normals[face]).all()
    assert (np.abs(points[kinds[face] == 2, 2] + 0.4) < 1e-6).all()
    np.testing.assert_allclose(np.linalg.norm(points[kinds[face] == 1], axis=1), 0.3, atol=0.01)
    # All of the ball is seen but for what the ground hides from the photos below it.
    assert area * (kinds[face] == 1).mean() == pytest.approx(4 * np.pi * 0.09, rel=0.1)


@pytest.mark.slow
def test_areas_of_classes_are_compared_where_enough_cameras_see() -> None:
    truth, scene = ball_and_plate(), scene_around()
    scene = Scene(scene.views, scene.train, [])
    sizes = {}
    for share in (0.05, 0.1):  # of the ball, called plate: both areas change, that of the ball by its share
        kinds = truth.face_class.copy()
        ball = np.flatnonzero(kinds == 1)
        high = truth.vertices[truth.faces[ball]].mean(1)[:, 2]
        kinds[ball[high > np.quantile(high, 1 - share)]] = 2
        found = surface_figures(as_surface(truth.vertices, truth.faces, kinds), unpainted(), truth, scene, 2)
        sizes[share] = found["class_area_error"]
    assert sizes[0.1] == pytest.approx(2 * sizes[0.05], rel=0.15)
    assert sizes[0.1] > 0.08


@pytest.mark.slow
def test_a_plate_of_one_side_and_a_missing_ball_are_seen() -> None:
    truth, scene = ball_and_plate(), scene_around()
    sight = Sight(truth, [scene.views[i] for i in scene.train])
    normal = unit(np.cross(*(truth.vertices[truth.faces[:, k]] - truth.vertices[truth.faces[:, 0]] for k in (1, 2))))
    upper = truth.faces[(truth.face_class == 1) | (normal[:, 2] > 0.5)]
    assert both_sides((truth.vertices, truth.faces), truth, sight, 2) > 0.99
    assert both_sides((truth.vertices, upper), truth, sight, 2) < 0.1
    held_out = [scene.views[i] for i in scene.test]
    plate = truth.vertices, truth.faces[truth.face_class == 2]
    assert hit_share((truth.vertices, truth.faces), truth, held_out, sight.far) == 1
    assert 0.2 < hit_share(plate, truth, held_out, sight.far) < 0.9


def test_classes_are_those_of_what_can_be_seen() -> None:
    """A box that stands on a plate: what touches is nobody's."""
    import trimesh

    box = trimesh.creation.box((0.2, 0.2, 0.06)).subdivide_to_size(0.1).apply_translation((0, 0, 0.03))
    plate = trimesh.creation.box((0.8, 0.8, 0.2)).subdivide_to_size(0.1).apply_translation((0, 0, -0.1))
    whole = trimesh.util.concatenate([plate, box])
    kinds = np.repeat([2, 1], [len(plate.faces), len(box.faces)])
    scene = scene_around()
    sight = Sight(Truth(np.asarray(whole.vertices), np.asarray(whole.faces), kinds), scene.views)
    inside = np.array([[0, 0, -0.002], [0.02, 0.01, 0.004], [0.3, 0.3, 0.001]])
    assert sight.class_near(inside).tolist() == [1, 1, 2]


def test_a_ground_in_large_pieces_is_itself_up_to_what_stands_on_it() -> None:
    """The middle of a large piece of the ground may lie under the box, where no camera sees it."""
    import trimesh

    box = trimesh.creation.box((0.4, 0.4, 0.2)).subdivide_to_size(0.1).apply_translation((0, 0, 0.1))
    plate = trimesh.creation.box((60, 60, 0.2)).apply_translation((0.3, 0.3, -0.1))
    whole = trimesh.util.concatenate([plate, box])
    kinds = np.repeat([2, 1], [len(plate.faces), len(box.faces)])
    sight = Sight(Truth(np.asarray(whole.vertices), np.asarray(whole.faces), kinds), scene_around().views)
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 81), np.linspace(-0.4, 0.4, 81))
    beside = np.maximum(np.abs(x), np.abs(y)) > 0.2 + 3 * sight.pixel
    ground = np.stack([x[beside], y[beside], np.zeros(beside.sum())], 1)
    assert (sight.class_near(ground) == 2).all()
    assert (sight.class_near(np.stack([x, y, np.full(x.shape, 0.2)], -1)[~beside]) == 1).all()


def test_a_ground_that_few_cameras_see_is_none_of_what_stands_on_it() -> None:
    """Two cameras look from the other side of the box; one sees what they do not, of the plate beside it."""
    import trimesh

    box = trimesh.creation.box((0.2, 0.2, 0.06)).subdivide_to_size(0.1).apply_translation((0, 0, 0.03))
    plate = trimesh.creation.box((0.8, 0.8, 0.2)).subdivide_to_size(0.1).apply_translation((0, 0, -0.1))
    whole = trimesh.util.concatenate([plate, box])
    kinds = np.repeat([2, 1], [len(plate.faces), len(box.faces)])
    places = np.array([[2, 0, 0.5], [2, 0.3, 0.5], [-2, 0, 0.5]])
    views = [View(f"{k}", CAMERA, look_at(p, np.zeros(3)), image=None) for k, p in enumerate(places)]  # type: ignore[arg-type]
    sight = Sight(Truth(np.asarray(whole.vertices), np.asarray(whole.faces), kinds), views)
    assert sight.cameras_at(np.array([[-0.13, 0, 0]]), np.array([[0.0, 0, 1]])).tolist() == [1]
    mesh = np.asarray(whole.vertices), np.asarray(whole.faces)
    found = distances(mesh, mesh, count=20_000, true=sight.seen)
    assert class_figures(found, as_surface(*mesh, kinds), unpainted(), sight)["surface_miou"] > 0.98


def test_what_no_camera_sees_takes_no_area_from_what_lies_before_it() -> None:
    """What a mesh has of a carpet, sunk into it, lies closest to its underside; a surface deep inside counts as well."""
    import trimesh

    carpet = trimesh.creation.box((0.5, 0.5, 0.01)).subdivide_to_size(0.1).apply_translation((0, 0, 0.005))
    plate = trimesh.creation.box((0.8, 0.8, 0.2)).subdivide_to_size(0.1).apply_translation((0, 0, -0.1))
    whole = trimesh.util.concatenate([plate, carpet])
    kinds = np.repeat([2, 1], [len(plate.faces), len(carpet.faces)])
    sight = Sight(Truth(np.asarray(whole.vertices), np.asarray(whole.faces), kinds), scene_around().views)
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.2, 0.2, 5))
    sunk = np.stack([x, y, 0 * x + 0.002], -1).reshape(-1, 3)
    assert not sight.visible(sunk - [0, 0, 0.002], np.array([[0.0, 0, -1]]).repeat(25, 0)).any()
    assert sight.visible_near(sunk).all()
    assert sight.visible_near(np.array([[0.0, 0, -0.05]])).all()


def test_volumes_of_bodies_are_compared() -> None:
    truth = ball_and_plate()
    ball = truth.faces[truth.face_class == 1]
    kinds = np.ones(len(ball), int)
    assert volume_error((truth.vertices * 1.1, ball), kinds, truth, [(1,)]) == pytest.approx(1.1**3 - 1, rel=1e-6)
    standing = ball[truth.vertices[ball].mean(1)[:, 2] > -0.27]  # its foot is not seen
    assert volume_error((truth.vertices, standing), kinds[: len(standing)], truth, [(1,)]) < 0.02
    half = ball[truth.vertices[ball].mean(1)[:, 2] > 0]
    assert volume_error((truth.vertices, half), kinds[: len(half)], truth, [(1,)]) is None
    assert volume_error((truth.vertices, ball), kinds, truth, [(1,), (2,)]) is None  # no plate


def test_the_outline_of_a_class_map_is_measured_in_texels() -> None:
    """A square of two triangles with 64 texels a side, whose class changes at column 40."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = UvMap(vertices[faces][..., :2].astype(np.float32), np.zeros(2, np.int32), np.zeros((0, 2), int), 1.0, 64)
    ids = np.where(np.arange(64) < 40, 1, 2).astype(np.uint8)[None].repeat(64, 0)
    painted = replace(unpainted(), uv=uv, maps=ClassMaps(ids, np.full((64, 64), 255, np.uint8)))
    for texels in (0, 3):
        x = (40 + texels) / 64
        line = np.array([[[x, 0.1, 0], [x, 0.9, 0]]])
        assert outline_texels(vertices, faces, painted, line, 1.0) == pytest.approx(texels, abs=0.3)  # between texels
    assert outline_texels(vertices, faces, painted, line + 5, 1.0) is None  # a place that the mesh lacks
    assert outline_texels(vertices, faces, unpainted(), line, 1.0) is None
    edges, normals = true_outline(vertices, faces, np.array([1, 2]))
    assert edges.tolist() == [[[0, 0, 0], [1, 1, 0]]]
    assert normals.tolist() == [[0, 0, 1]]


def test_seams_are_told_from_other_edges() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 4]])
    corners = np.array(
        [[[0, 0], [0.4, 0], [0, 0.4]], [[0, 0], [0, 0.4], [-0.0, 0.4]], [[0.6, 0.9], [0.9, 0.6], [1, 1]]]
    )
    corners[1, 2] = [0.3, 0.8]
    image = np.full((64, 64, 3), 90, np.uint8)
    image[:, :] += (np.arange(64) // 2).astype(np.uint8)[None, :, None]
    uv = UvMap(corners.astype(np.float32), np.zeros(3, int), np.array([[1, 2]]), 1.0, 64)
    smooth = seam_ratio(faces, Painted(unpainted().classes, uv, image))
    image[:32, 32:] = 250  # the other chart
    assert seam_ratio(faces, Painted(unpainted().classes, uv, image)) > 2 * smooth
    assert seam_ratio(faces, unpainted()) is None


def test_the_table_has_a_row_for_each_figure_and_stage() -> None:
    rows = [{"scene": "museum", "f_size": 0.9512, "stages": {"Fusing": 6.2}}, {"scene": "vase", "both_sides": None}]
    columns, made = figure_table(rows)
    assert list(columns) == ["figure", "asked", "museum", "vase"]
    assert made[0] == {"figure": "F at 1 % of the size", "asked": "≥ 0.97", "museum": "0.951", "vase": "–"}
    assert made[-1] == {"figure": "Fusing (processor s)", "asked": "", "museum": "6", "vase": "–"}
    assert len(made) == len(FIGURES) + 1


def test_the_suite_measures_each_field_while_it_is_there(
    tiny_project: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = []

    def measure(job, project, report, root) -> dict:
        seen.append((project / "runs" / job.name / "field.safetensors").is_file())
        return {"f_size": 0.5, "f_pixel": 0.25, "stages": {"Fusing": 1.0}}

    params = BenchParams(suite="surface", out=tmp_path, scenes=[str(tiny_project)], steps=3, preset="draft", set=TINY)
    with pytest.raises(InputError, match="true surface"):
        run_verb("bench", params, Reporter())
    monkeypatch.setattr(suite, "measure", measure)
    monkeypatch.setattr(suite, "read_truth", lambda root, scene: None)
    params = params.model_copy(update={"page": tmp_path / "page.md"})
    result = run_verb("bench", params, Reporter())
    assert result["failed"] == 0
    assert result["rows"][0]["f_size"] == 0.5
    assert (tmp_path / "surface" / "plot.png").is_file()
    again = run_verb("bench", params, Reporter())
    assert again["rows"] == result["rows"]
    assert seen == [True]
    assert "| F at two pixels | ≥ 0.90 | 0.250 |" in (tmp_path / "page.md").read_text("utf-8")
