"""The verb `blocks` with fields that are trained: on this machine, and with the same tasks on a cluster."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.blender.blend import blend
from fieldwork.nerfcore.blocks import whole
from fieldwork.nerfcore.blocks.join import joined, open_at_seams
from fieldwork.nerfcore.blocks.maps import joined_maps, load_maps
from fieldwork.nerfcore.blocks.plan import MAPS, SIGHTS, Plan, block_folder, cut
from fieldwork.nerfcore.blocks.sights import load_sights
from fieldwork.nerfcore.blocks.surface import Part, load_part, shared_region
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import SettingError, TrainingError
from fieldwork.nerfcore.mesh.clean import shown
from fieldwork.nerfcore.mesh.extract import extract
from fieldwork.nerfcore.mesh.fusion import fuse_maps
from fieldwork.nerfcore.mesh.instances import read_instances
from fieldwork.nerfcore.mesh.stored import load_guessed, load_surface
from fieldwork.nerfcore.mesh.surface import Surface, vertex_normals
from fieldwork.nerfcore.mesh.triangles import area_share, border_edges, compact
from fieldwork.nerfcore.params import BlendParams, BlocksParams, InstancesParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import run_folder
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.things.edit import instances
from fieldwork.nerfcore.workflows import blocks as workflow
from fieldwork.nerfcore.workflows.blocks import blocks, tasks_of
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project

CPU = torch.device("cpu")
STEPS = 120
BOUNDS = [[-0.7, -0.7, -0.7], [0.7, 0.7, 0.7]]


def capture(folder: Path, views: int = 14) -> Path:
    project = ball_project(folder, views=views, side=64, points=400)
    with edit_project(project) as edited:
        edited.frame.bounds = BOUNDS
    return project


def asked(project: Path, **more: Any) -> BlocksParams:
    settings = {**SMALL, "train.batch_samples": "8192"}
    return BlocksParams(
        project=project, preset="draft", steps=STEPS, set=settings, holdout=0, resolution=48, faces=0, **more
    )


def in_one_piece(project: Path, plan: Plan) -> Surface:
    """The surface of the depth maps of all blocks, fused and extracted at once."""
    maps = joined_maps([load_maps(run_folder(block_folder(project, b), "main") / MAPS, CPU) for b in plan.blocks])
    sights = [load_sights(run_folder(block_folder(project, b), "main") / SIGHTS) for b in plan.blocks]
    region = shared_region(BOUNDS, plan, sights, 48)
    vertices, faces = extract(fuse_maps(maps, region, Reporter()), Reporter())
    vertices, faces = compact(vertices, faces[shown(vertices, faces, maps, 4 * region.voxel, Reporter())])
    nothing = np.zeros(len(vertices), np.int32)
    surface = Surface(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        vertex_normals(vertices, faces),
        np.zeros((len(vertices), 3), np.uint8),
        nothing,
        np.zeros(len(faces), np.int32),
    )
    return joined([Part(surface, np.zeros((0, 2)), region.voxel)])[0]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    project = capture(tmp_path_factory.mktemp("blocks") / "ball")
    return project, blocks(asked(project, out=project / "whole.glb"), Reporter())


@pytest.mark.slow
def test_two_trained_blocks_make_the_surface_of_their_maps_in_one_piece(made: tuple[Path, dict[str, Any]]) -> None:
    project, result = made
    assert [block["name"] for block in result["blocks"]] == ["1", "2"]
    assert min(block["psnr_train"] for block in result["blocks"]) > 18
    # The parts, each computed by itself, are the surface of all maps in one piece: the same triangles, the same holes.
    plan = cut(load_scene(project, 0), 2)
    parts = [load_part(project, block) for block in plan.blocks]
    one = in_one_piece(project, plan)
    assert len(joined(parts)[0].faces) == len(one.faces)
    assert len(border_edges(joined(parts)[0].faces)) == len(border_edges(one.faces))
    assert result["open_at_seams"] == open_at_seams(one, parts)
    (surface, _), filled = load_surface(project, "blocks"), load_guessed(project, "blocks")
    assert filled is not None
    assert len(filled) == len(surface.faces)
    assert result["unseen"] == round(area_share(surface.vertices, surface.faces, filled), 4)
    names = [instance.name for instance in read_instances(project / "exports/blocks")]
    assert {name.split(".")[0] for name in names} <= {"top", "bottom"}
    assert (project / "whole.glb").stat().st_size > 1000


@pytest.mark.slow
def test_a_second_call_does_nothing_again_and_other_classes_only_the_parts(
    made: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    project = Path(shutil.copytree(made[0], tmp_path / "ball"))
    again = blocks(asked(project), Reporter())
    assert again["reused"] == [task.id for task in tasks_of(asked(project), cut(load_scene(project, 0), 2))]
    assert again["faces"] == made[1]["faces"]
    with edit_project(project) as edited:
        edited.classes[0].name = "lid"
    renamed = blocks(asked(project), Reporter())
    assert [task.split()[0] for task in renamed["reused"]] == ["train", "train", "maps", "maps"]
    assert set(renamed["classes"]) - {"void"} == {"lid", "bottom"}


@pytest.mark.slow
def test_the_whole_has_a_texture_levels_of_detail_and_opens_in_blender(
    made: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    project = Path(shutil.copytree(made[0], tmp_path / "ball"))
    found = blocks(asked(project, texture=256, lods=1, out=project / "whole.glb"), Reporter())
    assert len(found["reused"]) == 6
    assert found["painted_by_photos"] > 0.9
    assert found["lods"][0]["faces"] < 0.5 * found["faces"]
    surface, texture = load_surface(project, "blocks")
    assert texture is not None
    assert texture.image.shape == (256, 256, 3)
    # The texture shows in the middle of each triangle about what its vertices have: the same photos.
    corners = texture.unwrapped.uv[texture.unwrapped.faces].mean(1)
    x, y = (corners * [256, -256] + [0, 256]).clip(0, 255).astype(int).T
    painted, plain = texture.image[y, x].astype(float), surface.colors[surface.faces].mean(1)
    apart = np.abs(painted - plain).mean(1)
    assert np.median(apart) < 25
    assert plain.std(0).max() > 25, "it has more than one colour"
    assert {p.name for p in project.glob("whole*.glb")} == {"whole.glb", "whole_lod1.glb"}
    # Without them the next call leaves none that is not true any more.
    blocks(asked(project), Reporter())
    assert load_surface(project, "blocks")[1] is None
    assert not list((project / "exports/blocks").glob("*lod*"))
    listed = instances(InstancesParams(project=project, run="blocks"), Reporter())["instances"]
    assert {each["class"] for each in listed} <= {"top", "bottom"}
    pytest.importorskip("bpy", reason="there is no Blender to open it in")
    file = blend(BlendParams(project=project, out=project / "whole.blend", run="blocks"), Reporter())
    assert (file["mesh"], file["cameras"]) == (found["faces"], 14)


@pytest.mark.slow
def test_what_photos_and_masks_refute_is_left_out_of_the_whole(
    made: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = Path(shutil.copytree(made[0], tmp_path / "ball"))
    monkeypatch.setattr(whole, "not_refuted", lambda vertices, faces, *_: (vertices[faces].mean(1)[:, 2] > 0, 0.0))
    result = blocks(asked(project), Reporter())
    surface, _ = load_surface(project, "blocks")
    assert 0.3 < result["faces"] / made[1]["faces"] < 0.7
    assert (surface.vertices[surface.faces].mean(1)[:, 2] > -1e-4).all(), "asked about in the world"
    assert set(np.unique(surface.faces)) == set(range(len(surface.vertices)))
    monkeypatch.setattr(whole, "not_refuted", lambda vertices, faces, *_: (np.zeros(len(faces), bool), 0.0))
    with pytest.raises(TrainingError, match="masks leave out all"):
        blocks(asked(project), Reporter())
    assert len(load_surface(project, "blocks")[0].faces) == result["faces"], "what was there stays"


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="the extra “cluster” is not installed")
def test_on_a_cluster_blocks_are_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fieldwork.tests.nerfcore.support.ray_cluster import Cluster

    project = capture(tmp_path / "ball", views=12)
    with Cluster() as cluster:
        for name, value in cluster.access.items():
            monkeypatch.setenv(name, value)
        given = asked(project, cluster=cluster.address, keep_free=0.2).model_copy(update={"steps": 60})
        result = blocks(given, Reporter())
    assert set(result["stages"]) == {f"{stage} {k}" for stage in ("train", "maps", "part") for k in (1, 2)}
    assert result["faces"] > 500
    # On one machine the same command finds all of it done.
    assert len(blocks(given.model_copy(update={"cluster": None}), Reporter())["reused"]) == 6


def test_impossible_blocks_are_told_before_anything_is_made(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball", views=4, side=24)
    for values in ({"set": {"train.speed": "9"}}, {"out": tmp_path / "mesh.xyz"}):
        with pytest.raises(SettingError):
            blocks(BlocksParams(project=project, **values), Reporter())
    assert not (project / "blocks").exists()


def test_tasks_wait_for_what_they_read(tmp_path: Path) -> None:
    project = capture(tmp_path / "ball", views=8)
    tasks = {task.id: task for task in tasks_of(asked(project), cut(load_scene(project, 0), 2))}
    assert tasks["train 1"].needs == ()
    assert tasks["maps 2"].needs == ("train 2",)
    assert tasks["part 1"].needs == ("maps 1", "maps 2")
    assert tasks["train 1"].need.gpu > 0
    assert {task.function for task in tasks.values()} == {"fieldwork.nerfcore.workflows.blocks:run_stage"}
    assert {task.values["folder"] for task in tasks.values()} == {str(project)}
    assert workflow.settings_of(asked(project))["scene.contraction"] == "on"
