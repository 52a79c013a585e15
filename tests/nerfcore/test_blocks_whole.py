"""The mesh of all blocks, written again: what was made by hand of the one before stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.blocks.plan import PART, Plan, block_folder
from fieldwork.nerfcore.blocks.surface import Part, save_part
from fieldwork.nerfcore.blocks.whole import NAME, write_whole
from fieldwork.nerfcore.errors import Cancelled, DiskError
from fieldwork.nerfcore.files import file_hash
from fieldwork.nerfcore.mesh.instances import read_instances, write_instances
from fieldwork.nerfcore.mesh.surface import Surface
from fieldwork.nerfcore.params import BlocksParams, InstancesParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import MEASURES, SCENE_GRAPH, run_folder
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.things.edit import instances
from fieldwork.tests.nerfcore.support.ball import ball_project


def halves() -> Surface:
    """A ball whose upper half has the class 1 and whose lower half has the class 2."""
    ball = trimesh.creation.icosphere(3, 0.5)
    vertices, faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32)
    kind = [np.where(z > 0.01, 1, 2).astype(np.int32) for z in (vertices[:, 2], vertices[faces].mean(1)[:, 2])]
    colors = np.full(vertices.shape, 128, np.uint8)
    return Surface(vertices, faces, np.asarray(ball.vertex_normals, np.float32), colors, *kind)


@pytest.fixture
def asked(tmp_path: Path) -> tuple[Plan, BlocksParams]:
    """A project with the part of its only block."""
    project = ball_project(tmp_path / "p", views=6, side=32, points=100)
    with edit_project(project) as edited:
        edited.classes = [SemanticClass(id=k, name=name, color=(1, 0, 0)) for k, name in ((1, "upper"), (2, "lower"))]
    corners = {"low": (-1, -1, -1), "high": (1, 1, 1)}
    plan = Plan.model_validate({**corners, "blocks": [{"name": "1", **corners, "images": []}]})
    part = Part(halves(), np.zeros((0, 2)), 0.05)
    save_part(run_folder(block_folder(project, plan.blocks[0]), "main") / PART, part)
    return plan, BlocksParams(project=project, count=2, holdout=0)


def test_names_and_joins_made_by_hand_stay_and_what_was_said_of_the_mesh_before_goes(
    asked: tuple[Plan, BlocksParams],
) -> None:
    plan, params = asked
    folder, target = params.project, params.project / "exports" / NAME
    write_whole(folder, plan, params, Reporter())
    assert [one.name for one in read_instances(target)] == ["upper.001", "lower.001"]
    instances(InstancesParams(project=folder, run=NAME, rename=["upper.001", "dome"]), Reporter())
    dome, lower = read_instances(target)
    pieces = ((lower.area / 2, (0.1, 0.0, -0.2)), (lower.area / 2, (-0.1, 0.0, -0.2)))
    write_instances(target, [dome, replace(lower, parts=pieces)])
    for name in (MEASURES, SCENE_GRAPH):
        (target / name).write_text("{}")
    write_whole(folder, plan, params, Reporter())
    assert [(one.name, one.parts) for one in read_instances(target)] == [("dome", ()), ("lower.001", pieces)]
    assert not any((target / name).exists() for name in (MEASURES, SCENE_GRAPH))


def test_things_keep_their_numbers(asked: tuple[Plan, BlocksParams]) -> None:
    plan, params = asked
    target = params.project / "exports" / NAME
    write_whole(params.project, plan, params, Reporter())
    upper, lower = read_instances(target)
    write_instances(target, [replace(lower, id=1), replace(upper, id=2)])  # as where the lower one was larger
    write_whole(params.project, plan, params, Reporter())
    assert [(one.id, one.name) for one in read_instances(target)] == [(2, "upper.001"), (1, "lower.001")]
    with np.load(target / "mesh.npz") as mesh:
        assert (mesh["face_instance"] == np.where(mesh["face_class"] == 1, 2, 1)).all()


def test_things_are_called_after_a_class_by_its_new_name_unless_they_have_one_of_their_own(
    asked: tuple[Plan, BlocksParams],
) -> None:
    plan, params = asked
    folder, target = params.project, params.project / "exports" / NAME
    write_whole(folder, plan, params, Reporter())
    instances(InstancesParams(project=folder, run=NAME, rename=["upper.001", "dome"]), Reporter())
    with edit_project(folder) as edited:
        edited.classes = [one.model_copy(update={"name": f"{one.name} half"}) for one in edited.classes]
    write_whole(folder, plan, params, Reporter())
    assert [one.name for one in read_instances(target)] == ["dome", "lower half.001"]


class Stops(Reporter):
    """Cancels when a stage begins."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def stage(self, name: str) -> None:
        super().stage(name)
        if name == self.name:
            self.cancel()


@pytest.mark.parametrize("how", ["stopped", "no room"])
def test_stopped_or_without_room_for_its_file_the_mesh_before_stays(asked: tuple[Plan, BlocksParams], how: str) -> None:
    plan, params = asked
    folder, target = params.project, params.project / "exports" / NAME
    write_whole(folder, plan, params, Reporter())
    instances(InstancesParams(project=folder, run=NAME, rename=["upper.001", "dome"]), Reporter())
    before = {path.name: file_hash(path) for path in target.iterdir()}
    (folder / "a file").touch()
    if how == "stopped":
        report, more, error = Stops("Looking at it"), {"turntable": folder / "around"}, Cancelled
    else:
        report, more, error = Reporter(), {"out": folder / "a file" / "mesh.glb"}, DiskError
    with pytest.raises(error):
        write_whole(folder, plan, params.model_copy(update=more), report)
    assert {path.name: file_hash(path) for path in target.iterdir()} == before
    write_whole(folder, plan, params, Reporter())
    assert "dome" in [one.name for one in read_instances(target)]


def test_files_and_pictures_come_to_their_folders(asked: tuple[Plan, BlocksParams]) -> None:
    plan, params = asked
    folder = params.project
    everywhere = {"out": folder / "out" / "a.obj", "turntable": folder / "around", "lods": 1}
    result = write_whole(folder, plan, params.model_copy(update=everywhere), Reporter())
    target, files = folder / "exports" / NAME, {Path(file) for file in result["files"]}
    wanted = [target / name for name in ("mesh.npz", "mesh.ply", "mesh_lod1.npz", "instances.json")]
    wanted += [folder / "out" / "a.obj", folder / "out" / "a_lod1.obj", folder / "around" / "color_0.png"]
    assert set(wanted) <= files
    assert all(file.is_file() for file in files)
