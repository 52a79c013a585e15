"""Things and how they stand to each other, in rooms built from boxes: every relation, questions, names that stay."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import InputError, ProjectError
from fieldwork.nerfcore.files import write_json
from fieldwork.nerfcore.geometry.similarity import make_similarity
from fieldwork.nerfcore.mesh.features import features_of
from fieldwork.nerfcore.mesh.files import write_surface
from fieldwork.nerfcore.mesh.instances import (
    Instance,
    joined,
    read_instances,
    read_known,
    with_earlier_joins,
    with_earlier_names,
    with_earlier_numbers,
    write_instances,
    write_kept,
)
from fieldwork.nerfcore.mesh.lods import make_levels, write_level
from fieldwork.nerfcore.mesh.stored import MESH, load_surface, mesh_folder
from fieldwork.nerfcore.mesh.verb import beyond_region
from fieldwork.nerfcore.params import InstancesParams, RelationsParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.fingerprints import read_made, write_made
from fieldwork.nerfcore.project.runs import MEASURES, MESH_RECORD, SCENE_GRAPH
from fieldwork.nerfcore.project.schema import Project, SemanticClass
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.things.edit import instances
from fieldwork.nerfcore.things.graph import relate
from fieldwork.nerfcore.things.query import answer
from fieldwork.tests.nerfcore.support.meshed import store_mesh

NAMES = ["floor", "wall", "table", "vase", "book", "bowl", "apple", "painting", "chair", "chair/leg", "rug"]
IDS = {name: number for number, name in enumerate(NAMES, 1)}


def box(low: list[float], high: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def open_shell(mesh: trimesh.Trimesh, gone: int, above: bool) -> trimesh.Trimesh:
    """The mesh without its faces that look up (or down): as a capture has it, or as a bowl is."""
    keep = mesh.face_normals[:, gone] < 0.9 if above else mesh.face_normals[:, gone] > -0.9
    return trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)


def table(x: float, y: float) -> trimesh.Trimesh:
    legs = [box([x + i, y + j, 0.002], [x + i + 0.06, y + j + 0.06, 0.7]) for i in (0, 1.14) for j in (0, 0.74)]
    plate = open_shell(box([x, y, 0.7], [x + 1.2, y + 0.8, 0.75]), 2, False)
    return trimesh.util.concatenate([*(open_shell(leg, 2, True) for leg in legs), plate])


def bowl(x: float, y: float, z: float) -> trimesh.Trimesh:
    outer, inner = (
        box([x, y, z], [x + 0.4, y + 0.4, z + 0.2]),
        box([x + 0.01, y + 0.01, z + 0.02], [x + 0.39, y + 0.39, z + 0.2]),
    )
    inner = open_shell(inner, 2, True)
    inner.invert()
    return trimesh.util.concatenate([open_shell(outer, 2, True), inner])


def room() -> list[tuple[str, trimesh.Trimesh]]:
    """A table with a vase, a book on which a bowl with an apple stands; a second book under it on the floor; a chair with a
    leg of its own class, a painting on the wall, a rug."""
    return [
        ("floor", box([0, 0, -0.1], [5, 4, 0])),
        ("wall", box([0, 4, 0], [5, 4.1, 2.8])),
        ("table", table(1, 1)),
        ("vase", open_shell(box([1.1, 1.1, 0.755], [1.25, 1.25, 1.1]), 2, False)),
        ("book", box([1.5, 1.2, 0.755], [2.0, 1.7, 0.82])),
        ("bowl", bowl(1.55, 1.25, 0.825)),
        ("apple", box([1.7, 1.4, 0.85], [1.78, 1.48, 0.93])),
        ("book", box([1.4, 1.3, 0.002], [1.7, 1.5, 0.06])),
        ("painting", box([2, 3.96, 1.4], [3, 3.995, 2.1])),
        ("chair", box([3.2, 1.2, 0.4], [3.7, 1.7, 0.9])),
        ("chair/leg", box([3.4, 1.4, 0.002], [3.5, 1.5, 0.398])),
        ("rug", box([3.0, 2.5, 0.001], [4.4, 3.4, 0.02])),
    ]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = tmp_path / "p"
    color = (0.5, 0.5, 0.5)
    save_project(folder, Project(classes=[SemanticClass(id=i, name=n, color=color) for n, i in IDS.items()]))
    parts = [(name, part.subdivide_to_size(0.25)) for name, part in room()]
    mesh = trimesh.util.concatenate([part for _, part in parts])
    labels = np.repeat([IDS[name] for name, _ in parts], [len(part.faces) for _, part in parts])
    store_mesh(folder, mesh, labels, mesh, 0.005)
    return folder


def asked(folder: Path, query: str = "") -> dict[str, Any]:
    return relate(RelationsParams(project=folder, query=query), Reporter())


def changed(folder: Path, **values: Any) -> dict[str, Any]:
    return instances(InstancesParams(project=folder, **values), Reporter())


def told(result: dict[str, Any]) -> set[str]:
    return {f"{r['subject']} {r['relation']} {r['object']}" for r in result["relations"]}


def test_every_relation_of_a_room_is_found_and_no_other(project: Path) -> None:
    found = told(asked(project))
    expected = {
        "wall.001 on floor.001",
        "table.001 on floor.001",
        "vase.001 on table.001",
        "book.001 on table.001",
        "bowl.001 on book.001",
        "apple.001 in bowl.001",
        "book.002 on floor.001",
        "painting.001 hangs on wall.001",
        "chair/leg.001 part of chair.001",
        "chair/leg.001 on floor.001",
        "rug.001 on floor.001",
    }
    assert {line for line in found if "next to" not in line} == expected
    graph = json.loads((mesh_folder(project, "main") / SCENE_GRAPH).read_text())
    apple = next(thing for thing in graph["things"] if thing["name"] == "apple.001")
    np.testing.assert_allclose([apple["low"], apple["high"]], [[1.7, 1.4, 0.85], [1.78, 1.48, 0.93]], atol=0.01)
    assert apple["class"] == "apple"


def test_questions_mean_the_things_that_stand_so(project: Path) -> None:
    def ask(question: str) -> set[str]:
        return set(asked(project, question)["found"])

    assert ask("everything on the table") == {"vase.001", "book.001", "bowl.001", "apple.001"}
    assert ask("Books on the table?") == {"book.001"}
    assert ask("everything in bowl.001") == {"apple.001"}
    assert ask("what hangs on the wall") == {"painting.001"}
    assert ask("everything under the vase") == {"table.001"}
    assert ask("what is part of the chair") == {"chair/leg.001"}
    assert ask("book") == {"book.001", "book.002"}
    assert ask("legs") == {"chair/leg.001"}
    assert ask("all the books on the table") == {"book.001"}
    assert ask("the table") == {"table.001"}
    changed(project, rename=["vase.001", "vase on wall"])
    assert ask("Vase on wall") == {"vase on wall"}, "a name of a thing, though it reads like a question"
    with pytest.raises(InputError, match="no thing and no class “lamp”") as told_:
        ask("everything on the lamp")
    assert "table" in told_.value.hint


def test_next_to_is_for_neighbours_of_one_height_and_goes_either_way(project: Path) -> None:
    beside = {line for line in told(asked(project)) if "next to" in line}
    assert not any("painting" in line or "wall" in line for line in beside)
    for one, other in (line.split(" next to ") for line in beside):
        assert other in asked(project, f"everything next to {one}")["found"]
        assert one in asked(project, f"everything next to {other}")["found"]


def test_things_of_one_class_may_be_next_to_each_other() -> None:
    things = [{"id": k, "name": f"{kind}.00{k}", "class": kind} for k, kind in ((1, "vase"), (2, "vase"), (3, "wall"))]
    relations = [{"subject": a, "relation": "next to", "object": a + 1, "gap": 0} for a in (1, 2)]
    graph = {"things": things, "relations": relations}
    assert answer(graph, "vase next to a vase") == ["vase.001", "vase.002"]
    assert answer(graph, "vase.001 next to vase") == ["vase.001"]
    assert answer(graph, "wall next to vase") == ["wall.003"]


def test_a_graph_is_kept_until_the_things_change(project: Path) -> None:
    assert not asked(project)["reused"]
    assert asked(project)["reused"]
    assert changed(project, rename=["vase.001", "Ming"])["changed"] == ["Ming"]
    again = asked(project, "everything on the table")
    assert not again["reused"]
    assert "Ming" in again["found"]
    (mesh_folder(project, "main") / SCENE_GRAPH).write_text("{")
    assert not asked(project)["reused"], "a damaged graph is made anew"


def test_a_new_name_stands_in_measures_and_package_too(project: Path) -> None:
    target = mesh_folder(project, "main")
    rows = {"instances": [{"id": i.id, "name": i.name, "area": i.area} for i in read_instances(target)]}
    package = target / "package/package.json"
    package.parent.mkdir()
    write_json(target / MEASURES, {"unit": "m", **rows})
    write_json(package, {**rows, "measures": rows, "cameras": []})
    changed(project, rename=["vase.001", "Ming"])
    names = [i.name for i in read_instances(target)]
    assert "Ming" in names
    measures, packed = (json.loads(path.read_text("utf-8")) for path in (target / MEASURES, package))
    for found in (measures, packed, packed["measures"]):
        assert [row["name"] for row in found["instances"]] == names
    assert measures["instances"][0]["area"] == rows["instances"][0]["area"]
    (target / MEASURES).write_text("{")
    with pytest.raises(ProjectError, match=r"measures\.json is damaged"):
        changed(project, rename=["Ming", "vase.001"])
    assert "Ming" in [i.name for i in read_instances(target)]
    (target / MEASURES).unlink()
    package.unlink()


def test_instances_are_joined_and_split(project: Path) -> None:
    before = {i.name: i.area for i in read_instances(mesh_folder(project, "main"))}
    assert changed(project, merge=["book.001", "book.002"])["changed"] == ["book.001"]
    now = {i.name: i for i in read_instances(mesh_folder(project, "main"))}
    assert "book.002" not in now
    assert now["book.001"].area == pytest.approx(before["book.001"] + before["book.002"])
    with np.load(mesh_folder(project, "main") / MESH) as data:
        own = data["face_instance"] == now["book.001"].id
        assert set(data["face_class"][own].tolist()) == {IDS["book"]}
        assert np.isin(data["face_instance"], [i.id for i in now.values()]).all()
    asked(project)
    made = changed(project, split="book.001")["changed"]
    assert not (mesh_folder(project, "main") / SCENE_GRAPH).exists(), "the panel would list things without the new one"
    assert made == ["book.001.2"]
    apart = {i.name: i.area for i in read_instances(mesh_folder(project, "main"))}
    assert apart["book.001"] == pytest.approx(before["book.001"])
    assert apart["book.001.2"] == pytest.approx(before["book.002"])
    assert "bowl.001" in asked(project, "everything on the table")["found"]


def test_levels_of_detail_have_the_things_as_they_are_now(project: Path, tmp_path: Path) -> None:
    target = mesh_folder(project, "main")
    surface, _ = load_surface(project, "main")
    features = features_of(surface, load_project(project).classes, 0, read_instances(target))
    files = write_surface(target / "mesh.ply", surface, features, "none")
    for number, level in enumerate(make_levels(surface, None, 2, Reporter()), 1):
        files += write_level(target, number, level, lambda: None)
        features = features_of(level.surface, load_project(project).classes, 0, read_instances(target))
        files += write_surface(target / f"mesh_lod{number}.glb", level.surface, features, "instances")
    files += write_surface(tmp_path / "mine.glb", surface, features_of(surface, [], 0), "none")
    made = read_made(target / MESH_RECORD)
    assert made is not None
    made.settings, made.result = {"split": "instances"}, {"lods": [{}, {}], "files": [str(f) for f in files]}
    write_made(target / MESH_RECORD, made)

    def extents(path: Path) -> dict[int, np.ndarray]:
        with np.load(path) as data:
            corners, of = data["vertices"][data["faces"]], data["face_instance"]
            return {n: np.ptp(corners[of == n].reshape(-1, 3), axis=0) for n in np.unique(of).tolist()}

    report = Reporter()
    for values in ({"rename": ["book.001", "atlas"]}, {"merge": ["atlas", "book.002"]}, {"split": "atlas"}):
        instances(InstancesParams(project=project, **values), report)
        now = read_instances(target)
        full = extents(target / MESH)
        assert set(full) == {i.id for i in now}
        ply = trimesh.load(target / "mesh.ply", process=False).metadata["_ply_raw"]["face"]["data"]["face_instance"]
        assert set(ply.ravel().tolist()) == set(full)
        for number in (1, 2):
            level = extents(target / f"mesh_lod{number}.npz")
            assert set(level) == set(full)
            for n in full:
                np.testing.assert_allclose(level[n], full[n], atol=0.1)
            assert set(trimesh.load(target / f"mesh_lod{number}.glb").geometry) == {i.name for i in now}
    assert len(report.warnings) == 3
    assert all("mine.glb still has the things as they were" in warning for warning in report.warnings)


def test_what_cannot_be_done_with_instances_is_a_sentence(project: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for words, values in {
        "no instance “lamp”": {"rename": ["lamp", "light"]},
        "an instance “table.001” already": {"rename": ["vase.001", "table.001"]},
        "several classes": {"merge": ["vase.001", "table.001"]},
        "Only one": {"merge": ["vase.001"]},
        "one connected piece": {"split": "rug.001"},
    }.items():
        with pytest.raises(InputError, match=words):
            changed(project, **values)
    with pytest.raises(ProjectError, match="no mesh"):
        relate(RelationsParams(project=project, run="other"), Reporter())
    assert main(["relations", str(project), "--query", "everything on the table", "--json"]) == 0
    assert "vase.001" in json.loads(capfd.readouterr().out)["found"]
    assert main(["instances", str(project), "--rename", "vase.001,Ming"]) == 0
    assert "Ming" in {i.name for i in read_instances(mesh_folder(project, "main"))}
    # Names with commas, as Blender takes them, stand in quotes.
    assert main(["instances", str(project), "--rename", 'Ming,"vase, blue"']) == 0
    assert main(["instances", str(project), "--rename", "vase, blue,Ming"]) == 2
    assert "stands in quotes" in capfd.readouterr().err
    assert main(["instances", str(project), "--rename", '"vase, blue",Ming']) == 0
    assert "Ming" in {i.name for i in read_instances(mesh_folder(project, "main"))}


def test_a_mesh_that_is_made_again_keeps_the_names_of_its_things() -> None:
    before = [
        Instance(1, "Ming", 4, 0.50, (0.0, 0.0, 1.0)),
        Instance(2, "vase.002", 4, 0.48, (2.0, 0.0, 1.0)),
        Instance(3, "book.001", 5, 0.30, (0.0, 0.0, 1.0)),
    ]
    # The second vase came out larger, so that it is the first now; a third one stands where none was.
    after = [
        Instance(1, "vase.001", 4, 0.51, (2.01, 0.0, 1.0)),
        Instance(2, "vase.002", 4, 0.49, (0.02, 0.0, 1.0)),
        Instance(3, "vase.003", 4, 0.20, (0.0, 5.0, 1.0)),
        Instance(4, "book.001", 5, 0.10, (9.0, 0.0, 0.0)),
    ]
    named = with_earlier_names(after, before)
    assert [i.name for i in named] == ["vase.002", "Ming", "vase.003", "book.001"]
    assert [i.id for i in named] == [1, 2, 3, 4]
    assert [i.name for i in with_earlier_names(after, [])] == [i.name for i in after]
    # Objects in Blender are known by the numbers.
    faces, numbered = with_earlier_numbers(np.array([0, 1, 2, 3, 4, 1], np.uint32), named, before)
    assert [(i.id, i.name) for i in numbered] == [(2, "vase.002"), (1, "Ming"), (4, "vase.003"), (3, "book.001")]
    assert faces.tolist() == [0, 2, 1, 4, 3, 2]
    assert faces.dtype == np.uint32
    faces, numbered = with_earlier_numbers(np.array([0, 3], np.uint32), after, [])
    assert (faces.tolist(), numbered) == ([0, 3], after)
    assert with_earlier_numbers(np.array([0, 0], np.uint32), [], before)[0].tolist() == [0, 0]


def test_a_mesh_that_is_made_again_joins_what_was_joined_by_hand(tmp_path: Path) -> None:
    top, foot = Instance(1, "lamp.001", 4, 0.50, (0.0, 0.0, 2.0)), Instance(2, "lamp.002", 4, 0.25, (0.0, 0.0, 0.5))
    other = Instance(3, "lamp.003", 4, 0.25, (5.0, 0.0, 0.5))
    whole = replace(joined([top, foot]), name="reading lamp")
    assert (whole.area, whole.center) == (0.75, (0.0, 0.0, 1.5))
    write_instances(tmp_path, [whole, other])
    before = read_instances(tmp_path)
    assert before == [whole, other], "what a thing was joined from is on disk"
    # Made again the pieces are a little different, and come in another order.
    after = [
        Instance(1, "lamp.001", 4, 0.26, (5.02, 0.0, 0.5)),
        Instance(2, "lamp.002", 4, 0.48, (0.01, 0.0, 2.0)),
        Instance(3, "lamp.003", 4, 0.24, (0.0, 0.02, 0.5)),
    ]
    faces, found = with_earlier_joins(np.array([1, 2, 3, 3, 0]), after, before)
    assert faces.tolist() == [1, 2, 2, 2, 0]
    named = with_earlier_names(found, before)
    assert [(i.id, i.name) for i in named] == [(1, "lamp.003"), (2, "reading lamp")]
    assert named[1].area == pytest.approx(0.72)
    # A third mesh, whose pieces hang together by themselves, and a fourth one, where they do not.
    faces, third = with_earlier_joins(np.array([1]), [Instance(1, "lamp.001", 4, 0.73, (0.0, 0.0, 1.5))], named)
    assert faces.tolist() == [1]
    faces, _ = with_earlier_joins(np.array([1, 2, 3]), after, with_earlier_names(third, named))
    assert faces.tolist() == [1, 2, 2]
    faces, found = with_earlier_joins(np.array([1, 2, 3]), after, [top, foot, other])
    assert (faces.tolist(), found) == ([1, 2, 3], after), "nobody joined these"


def test_names_stay_beyond_the_region_and_after_the_project_was_turned_and_scaled(tmp_path: Path) -> None:
    ming, book = Instance(2, "Ming", 4, 0.5, (0.0, 0.0, 1.0)), Instance(7, "book.001", 5, 0.3, (2.0, 0.0, 1.0))
    earlier = [ming, replace(book, parts=((0.2, (2.0, 0.0, 1.0)),))]
    beyond = beyond_region(earlier, (np.array([-1, -1, 0]), np.array([1, 1, 2])))
    assert [one.name for one in beyond] == ["book.001"]
    assert beyond_region(earlier, None) == []
    # In the region there is a new book, which takes neither name nor number of the other one.
    found = [Instance(1, "vase.001", 4, 0.5, (0.0, 0.0, 1.0)), Instance(2, "book.001", 5, 0.1, (0.5, 0.0, 1.0))]
    named = with_earlier_names(found, earlier, [one.name for one in beyond])
    assert [one.name for one in named] == ["Ming", "book.002"]
    _, named = with_earlier_numbers(np.array([1, 2]), named, earlier)
    assert [one.id for one in named] == [2, 8]
    write_instances(tmp_path, named)
    assert read_known(tmp_path, np.eye(4)) is None
    write_kept(tmp_path, beyond, np.eye(4))
    assert read_known(tmp_path, np.eye(4)) == [*named, *beyond]
    # The world lies elsewhere now, is turned and twice as large.
    motion = make_similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
    known = read_known(tmp_path, motion)
    assert known is not None
    assert [(one.id, one.name) for one in known] == [(2, "Ming"), (8, "book.002"), (7, "book.001")]
    np.testing.assert_allclose([one.center for one in known], [[1, 2, 5], [1, 3, 5], [1, 6, 5]])
    np.testing.assert_allclose([one.area for one in known], [2.0, 0.4, 1.2])
    np.testing.assert_allclose(known[2].parts[0][1], (1, 6, 5))
    # A number or a name that another one was given meanwhile.
    write_instances(tmp_path, [replace(named[0], id=7), named[1]])
    assert [one.id for one in read_known(tmp_path, np.eye(4)) or []] == [7, 8, 9]
    write_instances(tmp_path, [replace(named[0], name="book.001")])
    assert [one.name for one in read_known(tmp_path, np.eye(4)) or []] == ["book.001"]
    (tmp_path / "instances_kept.json").write_text('{"beyond": []}')
    assert read_known(tmp_path, np.eye(4)) is None
