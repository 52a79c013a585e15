"""Areas and volumes with their intervals: held against simulated surfaces whose true sizes are known."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import Cancelled, InputError, ProjectError
from fieldwork.nerfcore.evaluate.documentation import sections
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.measure import verb
from fieldwork.nerfcore.measure.closing import border_loops, closed
from fieldwork.nerfcore.measure.placing import area_rates, border_lengths, u_places
from fieldwork.nerfcore.measure.resampling import Votes
from fieldwork.nerfcore.measure.scale import EXACT, read_distances, scale_of
from fieldwork.nerfcore.measure.stored import read_measures
from fieldwork.nerfcore.measure.verb import Measured, Sized, amounts, measure
from fieldwork.nerfcore.measure.wording import amount, interval, significant
from fieldwork.nerfcore.mesh.facelets import facelets
from fieldwork.nerfcore.mesh.instances import find_instances
from fieldwork.nerfcore.mesh.stored import COARSE, mesh_folder
from fieldwork.nerfcore.mesh.surface import Surface
from fieldwork.nerfcore.mesh.visibility import PosedCamera
from fieldwork.nerfcore.params import InstancesParams, MeasureParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import MEASURES, MESH_RECORD
from fieldwork.nerfcore.project.schema import PosedImage, Poses, Project
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.things.edit import instances as change_instances
from fieldwork.tests.nerfcore.support.ball import RADIUS, ball_project
from fieldwork.tests.nerfcore.support.flat import box_mesh, wall_mesh
from fieldwork.tests.nerfcore.support.meshed import store_mesh
from skimage.measure import marching_cubes

SIDE, ROUND = 33, 11.0  # corners of the grid, radius of the ball in its cells
U_SCALE = 0.005
BALL = trimesh.creation.icosphere(4)
RIM = 0.3  # height, in radii, of the border between the two classes


def noisy_ball(
    random: np.random.Generator, pixel: float
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A ball of radius 1 as it comes out of noisy distances that are all off by up to a pixel's footprint, at cells of h
    and of 2h: vertices and faces of each."""
    axis = np.arange(SIDE) - SIDE // 2 + random.uniform(-0.5, 0.5, (3, 1))
    distance = np.sqrt(sum(g**2 for g in np.meshgrid(*axis, indexing="ij"))) - ROUND
    distance += random.normal(scale=0.1, size=distance.shape) + ROUND * random.uniform(-pixel, pixel)
    made = []
    for every in (1, 2):
        vertices, faces, *_ = marching_cubes(distance[::every, ::every, ::every], 0.0, gradient_direction="descent")
        made.append(((vertices * every + axis[:, 0]) / ROUND, faces))
    return made[0], made[1]


def voted(centers: np.ndarray, random: np.random.Generator, photos: int = 12) -> Votes:
    """Label maps of photos around the ball, each with its own error of where the border runs: 0 above it, 1 below."""
    found = []
    up = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    for number in range(photos):
        angle = 2 * np.pi * number / photos
        towards = np.array([np.cos(angle), np.sin(angle), random.uniform(-0.6, 0.6)])
        seen = np.flatnonzero(up @ (towards / np.linalg.norm(towards)) > 0.2)
        above = up[seen, 2] > RIM + random.normal(scale=0.04)
        found.append((np.full(len(seen), number), seen, np.stack([above, ~above], 1).astype(float)))
    return Votes(photos, *(np.concatenate(part) for part in zip(*found)))


def simulated(seed: int, pixel: float) -> Measured:
    """One capture of the ball, whose scale is off as well: what is measured of its two classes."""
    random = np.random.default_rng(seed)
    (vertices, faces), coarse = noisy_ball(random, pixel)
    factor = 1 + random.normal(scale=U_SCALE)
    vertices, coarse = vertices * factor, (coarse[0] * factor, coarse[1])
    pieces = facelets(vertices, faces)
    votes = voted(pieces.centers, random)
    mass = np.zeros((len(faces), 2))
    np.add.at(mass, votes.piece, votes.vote)
    face_class = np.where(mass.any(1), mass.argmax(1) + 1, np.where(pieces.centers[:, 2] > 0, 1, 2))
    face_instance, instances = find_instances(vertices, faces, face_class, {}, 0, 0.2)
    surface = Surface(vertices, faces, vertices, vertices, face_class[:0], face_class, face_instance)
    sized = Sized(1 / ROUND, lambda _, count: np.full(count, pixel / np.sqrt(3)))
    return amounts(surface, pieces, coarse, sized, [1, 2], instances, votes, None, U_SCALE, 0.9, Reporter())


@pytest.mark.parametrize(("pixel", "widest"), [(0.0, 0.25), (0.06, 0.4)])
def test_true_sizes_lie_in_the_intervals(pixel: float, widest: float) -> None:
    """In at least 18 of 20 runs, and intervals are not so wide that they say nothing."""
    truth = np.array([2 * np.pi * (1 - RIM), 2 * np.pi * (1 + RIM)])
    cap = np.pi * (1 - RIM) ** 2 * (2 + RIM) / 3
    solids = np.array([cap, 4 / 3 * np.pi - cap])
    runs = [simulated(seed, pixel) for seed in range(20)]
    for number in range(2):
        intervals = np.array([run.areas[number].interval for run in runs])
        inside = (intervals[:, 0] <= truth[number]) & (truth[number] <= intervals[:, 1])
        assert inside.sum() >= 18
        assert np.ptp(intervals, axis=1).mean() < widest * truth[number]
        bodies = [run.instance_volumes[number] for run in runs]
        assert all(body is not None for body in bodies)
        held = [body is not None and body.interval[0] <= solids[number] <= body.interval[1] for body in bodies]
        assert sum(held) >= 18
    # Photos matter: without them the border would be thought certain.
    assert min(run.areas[0].u_photos for run in runs) > 0.003


def test_what_a_moved_surface_costs() -> None:
    """Of a cube with a red top: its area grows by four times its edges' length as it grows, the top by its rim."""
    vertices, faces = box_mesh(0.5)
    top = (vertices[faces][..., 2] > 0).all(1).astype(int)
    assert border_lengths(vertices, faces, top, 2) == pytest.approx([4, 4])
    assert area_rates(
        np.asarray(BALL.vertices), np.asarray(BALL.faces), np.zeros(len(BALL.faces), int), 1
    ) == pytest.approx([8 * np.pi], rel=0.01)
    view = PosedCamera(Camera(width=100, height=80, fx=50, fy=50, cx=50, cy=40), np.eye(4))
    centers = np.array([[0, 0, 2.0], [0, 0, 4], [0, 0, -3]])
    # A pixel is 4 and 8 cm there; photos of half the size have pixels twice as large; what no photo shows has the mean.
    found = u_places([view], centers, np.arange(3), 3, 50) * np.sqrt(3)
    assert found == pytest.approx([0.08, 0.16, 0.12])
    assert (u_places([view], centers[2:], np.zeros(1, int), 1, 50) == 0).all()


def test_the_volume_of_an_open_box_is_that_of_the_box_with_a_lid() -> None:
    vertices, faces = box_mesh(0.5)
    whole = closed(vertices, faces)
    assert whole is not None
    assert (whole.volume, whole.capped) == pytest.approx((1.0, 0.0))
    top = (vertices[faces][..., 2] > 0).all(1)
    assert closed(vertices, faces[~top]) is None  # a sixth is too much of a lid
    lid = closed(vertices, faces[~top], 0.2)
    assert lid is not None
    assert (lid.volume, lid.capped, lid.uneven) == pytest.approx((1.0, 1 / 6, 0.0))
    assert closed(vertices, faces[:, ::-1], 0.5) is None  # seen from inside it is a room
    assert closed(*wall_mesh()[:2], most_capped=0.6) is None  # nothing is inside a wall
    assert closed(vertices, faces[:0]) is None


@pytest.mark.parametrize("slit", [0, 1, 6])
def test_the_wall_of_a_tower_without_roof_and_floor_has_no_volume_slit_or_not(slit: int) -> None:
    """120 columns of squares around a tower, some of which are missing: with them its two rims are one loop."""
    around, up, height = 120, 30, 3.0
    angle, z = np.meshgrid(2 * np.pi * np.arange(around) / around, np.linspace(0, height, up), indexing="ij")
    vertices = np.stack([np.cos(angle), np.sin(angle), z], -1).reshape(-1, 3)
    i, k = np.meshgrid(np.arange(around - slit), np.arange(up - 1), indexing="ij")
    a, b = (i * up + k).ravel(), ((i + 1) % around * up + k).ravel()
    faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    assert len(border_loops(faces)) == (1 if slit else 2)
    assert closed(vertices, faces, 0.9 / (1 + height)) is None  # two lids of π beside a wall of 2 π · height
    assert closed(vertices, faces, 0.5) is not None


def test_openings_that_touch_at_a_vertex_are_two() -> None:
    vertices, faces, _ = wall_mesh(4)
    middle = vertices[faces].mean(1)
    hole = (np.abs(middle - [0.15, 0.15, 0]).max(1) < 0.15) | (np.abs(middle + [0.15, 0.15, 0]).max(1) < 0.15)
    assert sorted(len(loop) for loop in border_loops(faces[~hole])) == [4, 4, 16]
    box = box_mesh()[1]
    fin = np.array([[*box[0, :2], 8]])  # a third triangle at an edge
    assert [len(loop) for loop in border_loops(np.concatenate([box, fin]))] == [3]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The ball with its mesh, two halves of two classes; its scale is known."""
    folder = ball_project(tmp_path / "ball", views=10, side=48)
    ball, coarse = trimesh.creation.icosphere(4, RADIUS), trimesh.creation.icosphere(3, RADIUS)
    face_class = np.where(ball.triangles_center[:, 2] > 0, 1, 2)
    store_mesh(folder, ball, face_class, coarse, voxel=0.03)
    return folder


def test_the_verb_measures_a_mesh_with_the_label_maps_of_its_photos(project: Path, tmp_path: Path) -> None:
    table = tmp_path / "lengths.csv"
    rows = [
        ("across", "-0.5 0 0", "0.5 0 0", "1.0", "2", "scale"),
        ("up", "0 0 -0.5", "0 0 0.5", "1.02", "", "check"),
        ("camera to camera", "00", "01", "", "", ""),
    ]
    with open(table, "w", newline="") as file:
        csv.writer(file).writerows([("name", "from", "to", "metres", "u_mm", "use"), *rows])
    result = measure(MeasureParams(project=project, distances=table, caps=0.4), Reporter())
    assert result["unit"] == "m"
    assert json.loads((mesh_folder(project, "main") / MEASURES).read_text())["classes"] == result["classes"]
    half, body = 2 * np.pi * RADIUS**2, 2 / 3 * np.pi * RADIUS**3
    assert result["whole"]["area"] == pytest.approx(sum(row["area"] for row in result["classes"]))
    assert result["whole"]["volume_low"] < 2 * body < result["whole"]["volume_high"]
    for row in [*result["classes"], *result["instances"]]:
        assert row["area_low"] < half < row["area_high"]
        assert row["volume_low"] < body < row["volume_high"]
        assert row["area_u"]["photos"] > 0
    assert [row["name"] for row in result["instances"]] == ["top.001", "bottom.001"]
    across, up, between = result["distances"]
    assert across["length"] == pytest.approx(1.0)
    assert up["difference"] == pytest.approx(-0.02)
    assert between["known"] is None
    assert between["low"] < between["length"] < between["high"]
    # One distance, known to 2 mm and picked to a voxel at both ends.
    assert result["scale"]["u_percent"] == pytest.approx(100 * np.hypot(0.002, np.sqrt(2) * 0.03), rel=1e-3)


def test_what_of_an_area_is_a_guess_is_told(project: Path) -> None:
    before = measure(MeasureParams(project=project), Reporter())
    assert {row["area_guessed"] for row in [before["whole"], *before["classes"], *before["instances"]]} == {0}
    path = mesh_folder(project, "main") / "mesh.npz"
    with np.load(path) as data:
        arrays = dict(data)
    height = arrays["vertices"][arrays["faces"]].mean(1)[:, 2]
    np.savez(path, **arrays, unseen=height > RADIUS / 2)
    after = measure(MeasureParams(project=project), Reporter())
    cap = np.pi * RADIUS**2  # of the sphere above half of its radius
    top, bottom = after["classes"]
    for row in (after["whole"], top, after["instances"][0]):
        assert row["area_guessed"] == pytest.approx(cap, rel=0.05)
    assert bottom["area_guessed"] == after["instances"][1]["area_guessed"] == 0
    assert top["area"] == before["classes"][0]["area"]


def test_things_that_were_joined_by_hand_are_measured_as_one(tmp_path: Path) -> None:
    """Cubes of four sizes, of which the first two become one: the ids of the others are no places in the list any more."""
    folder, sides = ball_project(tmp_path / "ball", views=4), (0.7, 0.6, 0.5, 0.4)
    cubes = [trimesh.creation.box(bounds=[[n, 0, 0], [n + side, side, side]]) for n, side in enumerate(sides)]
    coarse, mesh = (trimesh.util.concatenate(part) for part in (cubes, [c.subdivide_to_size(0.12) for c in cubes]))
    store_mesh(folder, mesh, np.ones(len(mesh.faces), int), coarse, 0.02)
    before = measure(MeasureParams(project=folder), Reporter())["instances"]
    change_instances(InstancesParams(project=folder, merge=["top.001", "top.002"]), Reporter())
    result = measure(MeasureParams(project=folder), Reporter())
    assert [row["id"] for row in result["instances"]] == [1, 3, 4]
    sizes = [[row[name] for row in result["instances"]] for name in ("area", "volume")]
    assert sizes[0] == pytest.approx([6 * (0.7**2 + 0.6**2), 6 * 0.5**2, 6 * 0.4**2])
    assert sizes[1] == pytest.approx([0.7**3 + 0.6**3, 0.5**3, 0.4**3])
    assert result["instances"][1:] == before[2:]
    assert result["classes"][0]["volume"] == pytest.approx(sum(sizes[1]))


@pytest.mark.parametrize("step", ["area_deviations", "transferred", "area_deviations_of_place", "volume_amount"])
def test_a_cancel_does_not_wait_for_what_comes_after(project: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    report, done = Reporter(), []
    true = getattr(verb, step)

    def last(*args: Any) -> Any:
        done.append(step)
        report.cancel()
        return true(*args)

    monkeypatch.setattr(verb, step, last)
    with pytest.raises(Cancelled):
        measure(MeasureParams(project=project), report)
    assert len(done) == (3 if step == "area_deviations_of_place" else 1)
    assert not (mesh_folder(project, "main") / MEASURES).exists()


def test_a_mesh_without_classes_is_measured_as_a_whole(tmp_path: Path) -> None:
    folder = ball_project(tmp_path / "ball", views=10, side=48)
    ball, coarse = trimesh.creation.icosphere(4, RADIUS), trimesh.creation.icosphere(3, RADIUS)
    store_mesh(folder, ball, np.zeros(len(ball.faces), int), coarse, voxel=0.03)
    result = measure(MeasureParams(project=folder), Reporter())
    assert (result["classes"], result["instances"]) == ([], [])
    whole = result["whole"]
    assert whole["name"] == "whole surface"
    assert whole["area_low"] < 4 * np.pi * RADIUS**2 < whole["area_high"] < 1.5 * whole["area"]
    assert whole["volume_low"] < 4 / 3 * np.pi * RADIUS**3 < whole["volume_high"] < 1.5 * whole["volume"]
    made = sections(folder, "main", {}, read_measures(folder, "main"))
    (written,) = [table for table in made if table.title == "Whole surface: area and volume"]
    assert written.rows[0][0] == "whole surface"


@pytest.mark.parametrize(("metres", "told"), [(1.25, "-20.00 % off"), (0.8, "+25.00 % off")])
def test_by_how_much_lengths_are_off_has_the_sign_of_their_error(
    project: Path, tmp_path: Path, metres: float, told: str
) -> None:
    """A length of 1 that is 1.25 m long is measured a fifth too short."""
    table = tmp_path / "lengths.csv"
    table.write_text(f"name,from,to,metres,use\nbar,-0.5 0 0,0.5 0 0,{metres},scale\n")
    report = Reporter()
    measure(MeasureParams(project=project, distances=table), report)
    assert [warning for warning in report.warnings if told in warning]


def test_while_the_scale_is_not_known_nothing_is_held_against_metres(project: Path, tmp_path: Path) -> None:
    table = tmp_path / "lengths.csv"
    table.write_text("name,from,to,metres,use\nacross,-0.5 0 0,0.5 0 0,2.5,check\n")
    with edit_project(project) as edited:
        edited.frame.scale_known = False
    report = Reporter()
    (row,) = measure(MeasureParams(project=project, distances=table, scale_error=2), report)["distances"]
    assert [warning for warning in report.warnings if "--scale-error is not used" in warning]
    assert (row["known"], row["difference"]) == (2.5, None)
    assert [warning for warning in report.warnings if "scale is not known" in warning and "align --scale" in warning]
    (written,) = [
        table for table in sections(project, "main", {}, read_measures(project, "main")) if "Control" in table.title
    ]
    assert written.rows[0][-2:] == ["2.5000", ""]
    assert "The scale is not known" in written.text
    assert "mean square" not in written.text
    sizes = [table for table in sections(project, "main", {}, read_measures(project, "main")) if "areas" in table.title]
    assert {table.text for table in sizes} == {"The scale is not known: sizes are in scene units."}
    earlier = read_measures(project, "main") or {}
    earlier["distances"][0]["difference"] = -1.5  # as earlier versions wrote it
    (written,) = [table for table in sections(project, "main", {}, earlier) if "Control" in table.title]
    assert written.rows[0][-1] == ""
    assert "mean square" not in written.text


def test_sizes_are_written_with_two_digits_of_their_uncertainty_and_no_exponent() -> None:
    assert amount(1234.5, 38) == "1234 ± 38"
    assert amount(123456.0, 4321) == "123500 ± 4300"
    assert amount(1.2384, 0.0296) == "1.238 ± 0.030"
    assert amount(0.00012345, 0.0000099) == "0.0001234 ± 0.0000099"
    assert amount(1.0, 0.0996) == "1.00 ± 0.10"
    assert amount(1234567.0, 0.0) == "1235000 ± 0"
    assert interval(1234.5, 1000.0, 1469.0) == ("1230", "1000 … 1470")
    assert interval(2e6, 1.9e6, 2.1e6) == ("2000000", "1900000 … 2100000")
    assert interval(0.1, 0.0, 1.3) == ("0.1", "0.0 … 1.3")  # whose low end is cut off at 0
    assert [significant(x) for x in (1234.5, 10.0, 0.0000123, 0.0)] == ["1230", "10", "0.0000123", "0"]


def test_a_mesh_that_lies_elsewhere_is_not_measured(project: Path) -> None:
    with edit_project(project) as edited:
        edited.frame.world_from_sfm = (2 * np.eye(4)).tolist()
    with pytest.raises(ProjectError, match="aligned anew"):
        measure(MeasureParams(project=project), Reporter())
    (mesh_folder(project, "main") / COARSE).unlink()
    (mesh_folder(project, "main") / MESH_RECORD).unlink()
    with pytest.raises(ProjectError, match="no mesh"):
        measure(MeasureParams(project=project), Reporter())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name,from\na,b\n", "columns"),
        ("name,from,to,metres\na,0 0 0,1 0 0,long\n", "line 2"),
        ("name,from,to,metres,use\na,0 0 0,1 0 0,1,tell\n", "'tell'"),
        ("name,from,to,metres,use\na,0 0 0,1 0 0,,scale\n", "metres ''"),
        ("name,from,to,metres\na,0 0 0,1 0 0,-1\n", "positive"),
        ("name,from,to\na,1 0 0,1 0 0\n", "same place"),
        ("name,from,to\n\n\na,IMG_7,1 0 0\n", "line 4: No placed photo is called 'IMG_7'"),
        ("name,from,to\na,0,0,0,1,0,0\n", "line 2: it has more cells than there are columns"),
        ("name,from,to\na\n", "line 2: No placed photo is called ''"),
    ],
)
def test_faults_in_the_table_of_distances_are_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "lengths.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_distances(path, np.eye(4), Poses())


def test_places_in_the_table_of_distances_are_written_in_several_ways(tmp_path: Path) -> None:
    path = tmp_path / "lengths.csv"
    path.write_text('name,from,to\na,0  0 0,3 4 0\nb,"0, 0, 0","0,0,2"\nc,my first photo,0 0 7\n')
    poses = Poses(images=[PosedImage(name="my_first_photo", camera=0, camera_to_world=np.eye(4).tolist())])
    assert [distance.length for distance in read_distances(path, np.eye(4), poses)] == [5, 2, 7]


def test_how_sure_the_scale_is(tmp_path: Path) -> None:
    path = tmp_path / "lengths.csv"
    path.write_text("name,from,to,metres,use\na,0 0 0,1 0 0,1.02,scale\nb,0 0 0,0 2 0,1.98,scale\n")
    project = Project()
    distances = read_distances(path, np.eye(4), Poses())
    assert scale_of(project, Poses(), distances, 0.01, None).unit == "scene units"
    project.frame.scale_known = True
    assert scale_of(project, Poses(), [], 0.01, None).u == 0
    assert scale_of(project, Poses(), [], 0.01, 0.5).u == 0.005
    found = scale_of(project, Poses(), distances, 0.001, None)
    # The longer one counts four times; the two differ by far more than a voxel would make them.
    assert found.factor == pytest.approx((1.02 + 4 * 0.99) / 5)
    assert found.u == pytest.approx(np.sqrt((0.024**2 + 4 * 0.006**2) / 5), rel=1e-6)
    project.record("align", {"scale": ["a", "b", 0.5]}, {})
    assert scale_of(project, Poses(), [], 0.001, None).u == pytest.approx(np.sqrt(2) * 0.002)
    project.record("poses", {}, {"world_kept": True})
    assert scale_of(project, Poses(), [], 0.001, None).source == "one distance of 0.5 m"
    for placing in ("poses", "import"):  # which set a world of their own: what was said of the one before is void
        project.record(placing, {}, {"world_kept": False})
        assert scale_of(project, Poses(), [], 0.001, None).source == EXACT
        project.record("align", {"scale": ["a", "b", 0.5]}, {})


def test_a_scale_that_nothing_is_known_of_is_told(project: Path) -> None:
    told = "Nothing says how sure the scale is"
    for given, warned in (({}, True), ({"scale_error": 1.0}, False)):
        report = Reporter()
        measure(MeasureParams(project=project, **given), report)
        assert any(told in warning for warning in report.warnings) == warned
    with edit_project(project) as edited:
        edited.frame.scale_known = False
    report = Reporter()
    measure(MeasureParams(project=project), report)
    assert not any(told in warning for warning in report.warnings)
