"""Two epochs of one object: registered, their distances, and how the areas of classes changed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import InputError, ProjectError
from fieldwork.nerfcore.files import write_json
from fieldwork.nerfcore.geometry.registration import by_points, by_surfaces
from fieldwork.nerfcore.geometry.similarity import make_similarity, similarity_scale, transform_points
from fieldwork.nerfcore.measure.epochs import compare, distance_colors, moved_faces
from fieldwork.nerfcore.mesh.metrics import sample_surface
from fieldwork.nerfcore.mesh.stored import mesh_folder
from fieldwork.nerfcore.mesh.triangles import areas, cross, unit
from fieldwork.nerfcore.params import CompareParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import MEASURES
from fieldwork.nerfcore.project.schema import Project
from fieldwork.nerfcore.project.store import save_project
from fieldwork.tests.nerfcore.support.flat import wall_mesh
from fieldwork.tests.nerfcore.support.meshed import CLASSES, store_mesh
from scipy.spatial.transform import Rotation

TURN = Rotation.from_euler("zx", [100, 3], degrees=True).as_matrix()
MOVED = make_similarity(1.0, TURN, np.array([3.0, -2, 0.5]))
GROWN = 0.02  # metres by which the top of the plinth rose


def thing(random: np.random.Generator, grown: float = 0.0) -> tuple[trimesh.Trimesh, np.ndarray]:
    """A plinth of 1.2 × 1 × 1 m on a floor of 3 × 2.4 m, with the noise of a reconstruction; its faces' classes."""
    floor = trimesh.creation.box(bounds=[[0, 0, -0.2], [3, 2.4, 0]]).subdivide_to_size(0.12)
    plinth = trimesh.creation.box(bounds=[[0.4, 0.5, 0.01], [1.6, 1.5, 1 + grown]]).subdivide_to_size(0.06)
    mesh = trimesh.util.concatenate([floor, plinth])
    mesh.vertices = mesh.vertices + random.normal(scale=0.001, size=mesh.vertices.shape)
    return mesh, np.repeat([1, 3], [len(floor.faces), len(plinth.faces)])


def epoch(folder: Path, transform: np.ndarray, seed: int, grown: float = 0.0, metric: bool = True) -> Path:
    save_project(folder, Project(classes=CLASSES))
    mesh, labels = thing(np.random.default_rng(seed), grown)
    mesh.vertices = transform_points(transform, np.asarray(mesh.vertices))
    store_mesh(folder, mesh, labels, mesh, 0.01, metric=metric)
    return folder


def test_two_epochs_are_registered_and_what_grew_is_found(tmp_path: Path) -> None:
    now, before = epoch(tmp_path / "now", np.eye(4), 0, GROWN), epoch(tmp_path / "before", MOVED, 1)
    report = Reporter()
    result = compare(CompareParams(project=now, other=before, views=["top"], scale=100, out=tmp_path / "out"), report)
    found = np.array(result["transform"]) @ MOVED
    np.testing.assert_allclose(found, np.eye(4), atol=2e-3)
    assert result["rms"] < 0.002
    assert 0.0005 < result["detectable"] < 0.006
    # The top grew by 2 cm; 1.2 m² of it, and no more than a rim around it.
    assert result["changed_area"] == pytest.approx(1.2, rel=0.1)
    mesh = trimesh.load(tmp_path / "out" / "distance.ply", process=False)
    distance = np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"]["distance"]).ravel()
    inner = (np.abs(np.asarray(mesh.vertices)[:, :2] - 1).max(1) < 0.4) & (np.asarray(mesh.vertices)[:, 2] > 0.9)
    top = np.asarray(mesh.vertices)[:, 2] > 1 + GROWN / 2  # its edges too
    assert distance[top].min() > 0.01
    assert np.median(distance[inner]) == pytest.approx(GROWN, abs=0.002)
    assert np.abs(np.median(distance[np.asarray(mesh.vertices)[:, 2] < 0.05])) < 0.001
    rows = {row["name"]: row for row in result["classes"]}
    assert rows["plinth"]["change"] == pytest.approx(GROWN * 4.4, abs=0.02)
    assert rows["floor"]["change"] == pytest.approx(0, abs=0.05)
    assert rows["plinth"]["change_low"] is None
    assert {Path(file).name for file in result["files"]} >= {"distance_top.png", "distance_top.pdf", "compare.json"}
    drawn = next(Path(file) for file in result["files"] if file.endswith("distance_top.svg"))
    assert f"noise ±{1000 * result['detectable']:.3g} mm (95 %)" in drawn.read_text(encoding="utf-8")
    assert json.loads((tmp_path / "out" / "compare.json").read_text()) == result


def test_a_mesh_compared_with_itself_has_not_changed(tmp_path: Path) -> None:
    now = epoch(tmp_path / "now", np.eye(4), 0)
    result = compare(CompareParams(project=now, other=now, views=[]), Reporter())
    assert result["changed_area"] == 0
    assert 0.001 <= result["detectable"] < 0.002  # a tenth of a cell, or what registering leaves
    # Of two reconstructions of what did not change, next to nothing.
    before = epoch(tmp_path / "before", np.eye(4), 1)
    result = compare(CompareParams(project=now, other=before, views=[]), Reporter())
    assert result["changed_area"] < 0.01 * 20


def test_patches_that_moved_to_one_side_count() -> None:
    vertices, faces, _ = wall_mesh(10, 0.5)  # 10 × 10 squares of 0.1, two triangles each
    area = areas(vertices, faces)
    distance = np.full(len(vertices), 0.001)
    x, y, _ = vertices.T
    distance[(x < -0.15) & (y < -0.15)] = -0.02
    distance[np.hypot(x - 0.4, y - 0.4) < 0.11] = 0.02
    distance[x > 0.45] = np.nan
    moved = moved_faces(faces, area, distance, 0.01, 0.05)
    assert area[moved].sum() == pytest.approx(0.3**2)
    assert moved_faces(faces, area, distance, 0.01, 0.0).sum() > moved.sum()  # the small one too
    assert not moved_faces(faces, area, distance, 0.01, 0.1).any()
    # Two patches that moved to different sides are not one.
    distance = np.where(x < 0.05, 0.02, -0.02)
    assert area[moved_faces(faces, area, distance, 0.01, 0.45)].sum() == pytest.approx(0.5)


def test_changes_of_measured_areas_have_intervals(tmp_path: Path) -> None:
    now, before = epoch(tmp_path / "now", np.eye(4), 0), epoch(tmp_path / "before", np.eye(4), 1)
    for folder, area in ((now, 5.0), (before, 4.0)):
        row = {"id": 3, "name": "plinth", "area": area, "area_low": area - 0.3, "area_high": area + 0.3}
        write_json(mesh_folder(folder, "main") / MEASURES, {"classes": [row]})
    result = compare(CompareParams(project=now, other=before, views=[]), Reporter())
    row = next(row for row in result["classes"] if row["name"] == "plinth")
    assert row["change"] == pytest.approx(1.0)
    assert [row["change_low"], row["change_high"]] == pytest.approx([1 - 0.3 * 2**0.5, 1 + 0.3 * 2**0.5])


def test_a_scale_on_paper_needs_a_known_one(tmp_path: Path) -> None:
    now, before = epoch(tmp_path / "now", np.eye(4), 0, metric=False), epoch(tmp_path / "before", np.eye(4), 1)
    report = Reporter()
    compare(CompareParams(project=now, other=before, views=[], scale=100), report)
    assert any("1:100 is not used" in warning for warning in report.warnings)


def test_an_epoch_of_unknown_size_is_brought_to_this_one() -> None:
    random = np.random.default_rng(0)
    mesh, other = thing(random)[0], thing(random)[0]
    points, face = sample_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), 6000)
    normals = unit(cross(np.asarray(mesh.vertices), np.asarray(mesh.faces)))[face]
    smaller = make_similarity(0.37, Rotation.from_euler("z", 77, degrees=True).as_matrix(), np.array([1.0, 2, 0]))
    there = sample_surface(np.asarray(other.vertices), np.asarray(other.faces), 6000, seed=1)[0]
    there = random.permutation(transform_points(smaller, there))
    found = by_surfaces((points, normals), there, True, Reporter())
    assert similarity_scale(found.transform @ smaller) == pytest.approx(1, abs=2e-3)
    np.testing.assert_allclose((found.transform @ smaller)[:3, 3], 0, atol=5e-3)


def sampled(mesh: trimesh.Trimesh, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a mesh with noise of 2 mm along their unit normals (N, 3), and these."""
    vertices, faces, random = np.asarray(mesh.vertices), np.asarray(mesh.faces), np.random.default_rng(seed)
    points, face = sample_surface(vertices, faces, 20_000, seed)
    normals = unit(cross(vertices, faces))[face]
    order = random.permutation(len(points))
    return (points + random.normal(scale=0.002, size=(len(points), 1)) * normals)[order], normals[order]


@pytest.mark.parametrize("seed", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_epochs_of_a_symmetric_thing_that_lie_over_each_other_are_not_turned(seed: int) -> None:
    """A column, from which nothing but a chip at its foot tells where its front is."""
    column = trimesh.creation.cylinder(0.3, 2.0, sections=96).subdivide_to_size(0.05)
    near = np.clip(1 - np.linalg.norm(column.vertices - [0.3, 0, 0.2], axis=1) / 0.15, 0, 1)
    column.vertices = column.vertices - 0.075 * near[:, None] * column.vertex_normals
    found = by_surfaces(sampled(column, seed), sampled(column, seed + 1)[0], False, Reporter())
    np.testing.assert_allclose(found.transform, np.eye(4), atol=0.01)


@pytest.mark.parametrize("angle", [45, pytest.param(100, marks=pytest.mark.slow)])
def test_an_epoch_that_lies_elsewhere_is_found_where_parts_of_it_fit_in_a_wrong_place(angle: float) -> None:
    """Two plinths, of which one was moved by 10 cm, on a slab before a wall: slab and wall alone fit in several ways."""

    def scene(moved: float) -> trimesh.Trimesh:
        plinth = [[0.5, 0.5 - moved, 0.001], [1.5, 1.5 - moved, 1]]
        bounds = [[[0, 0, -0.1], [4, 3, 0]], [[0, 3, 0], [4, 3.1, 2.5]], plinth, [[2.75, 1, 0.001], [3.25, 1.5, 1.5]]]
        return trimesh.util.concatenate([trimesh.creation.box(bounds=each) for each in bounds])

    turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    elsewhere = make_similarity(1.0, turn, np.array([0.5, 0.2, 0.1]))
    there = transform_points(elsewhere, sampled(scene(0), 1)[0])
    found = by_surfaces(sampled(scene(0.1), 0), there, False, Reporter())
    np.testing.assert_allclose(found.transform @ elsewhere, np.eye(4), atol=2e-3)


def test_common_points_register(tmp_path: Path) -> None:
    here = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 1]])
    there = transform_points(np.linalg.inv(MOVED), here)
    head = "name,x,y,z,other_x,other_y,other_z\n"
    lines = [
        f"p{k}," + ",".join(map(repr, [*a, *b])) + "\n" for k, (a, b) in enumerate(zip(here.tolist(), there.tolist()))
    ]
    path = tmp_path / "points.csv"
    path.write_text(head + "".join(lines))
    found = by_points(path, False)
    np.testing.assert_allclose(found.transform, MOVED, atol=1e-9)
    assert found.rms < 1e-9
    for text in (head + "".join(lines[:2]), head + 3 * lines[0], "name,x\na,1\n", head + "a,b,c,d,e,f,g\n"):
        path.write_text(text)
        with pytest.raises(InputError, match="common points"):
            by_points(path, False)


@pytest.mark.parametrize("cell", ["nan", "inf"])
@pytest.mark.parametrize("column", [0, 5])
def test_common_points_with_cells_that_say_nothing_are_refused(tmp_path: Path, cell: str, column: int) -> None:
    """As tables have them where a value is missing."""
    rows = [["0", "0", "0", "0", "0", "0"], ["1", "0", "0", "1", "0", "0"], ["0", "1", "0", "0", "1", "0"]]
    rows[1][column] = cell
    lines = ["name,x,y,z,other_x,other_y,other_z", *(f"p{i}," + ",".join(row) for i, row in enumerate(rows))]
    (tmp_path / "points.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match="do not say how the epochs lie"):
        by_points(tmp_path / "points.csv", False)


def test_things_that_have_nothing_in_common_are_not_compared(tmp_path: Path) -> None:
    now, before = epoch(tmp_path / "now", np.eye(4), 0), epoch(tmp_path / "before", np.eye(4), 1)
    path = tmp_path / "points.csv"
    path.write_text("name,x,y,z,other_x,other_y,other_z\na,50,0,0,0,0,0\nb,51,0,0,1,0,0\nc,50,1,0,0,1,0\n")
    with pytest.raises(ProjectError, match=r"within 0\.2 of each other"):
        compare(CompareParams(project=now, other=before, points=path), Reporter())


def test_colours_are_white_where_nothing_changed_and_grey_where_nothing_is_known() -> None:
    colors, legend = distance_colors(np.array([0.0, 0.01, -0.01, np.nan]), "m")
    assert colors[0].min() > 240
    assert colors[1][0] > colors[1][2] + 60
    assert colors[2][2] > colors[2][0] + 60
    assert colors[3].tolist() == [153, 153, 153]
    assert legend[0].text == "+10 mm"
