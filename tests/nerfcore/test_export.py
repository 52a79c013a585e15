"""Files for other programs, read back by other libraries; and the field as a graph, computed by another program."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import trimesh
from fieldwork.nerfcore.config import FieldConfig
from fieldwork.nerfcore.data.box import Box
from fieldwork.nerfcore.errors import ProjectError, SettingError
from fieldwork.nerfcore.export.onnx_field import field_model
from fieldwork.nerfcore.field.encoding import spherical_harmonics
from fieldwork.nerfcore.field.hybrid import HybridField
from fieldwork.nerfcore.geometry.contraction import grid_position
from fieldwork.nerfcore.mesh.instances import read_instances
from fieldwork.nerfcore.mesh.painted import MAPS
from fieldwork.nerfcore.params import ExportParams, InstancesParams, MeshParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.render.run import RunInfo
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.meshed import court
from onnx import TensorProto
from onnx.reference import ReferenceEvaluator
from onnxruntime import InferenceSession
from PIL import Image
from pxr import Usd, UsdGeom


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of two classes, trained for a moment, with a textured mesh."""
    folder = ball_project(tmp_path_factory.mktemp("export") / "Kugel ü")
    # With some seeds a floater stays after so few steps.
    settings = {**SMALL, "train.seed": "0"}
    run_verb("train", TrainParams(project=folder, preset="draft", steps=500, set=settings), Reporter())
    run_verb("mesh", MeshParams(project=folder, resolution=32, texture=128), Reporter())
    return folder


def export(folder: Path, to: str, **more) -> list[Path]:
    params = ExportParams.model_validate({"project": folder, "to": to, **more})
    return [Path(path) for path in run_verb("export", params, Reporter())["files"]]


def surface(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "exports/main/mesh.npz") as data:
        return {name: data[name] for name in data.files}


def test_glb_and_obj_stand_upright_with_texture(trained: Path, tmp_path: Path) -> None:
    ours = surface(trained)
    for kind in ("glb", "obj"):
        first, *beside = export(trained, kind, out=tmp_path / f"ball.{kind}")
        loaded = trimesh.load(first, force="mesh")
        assert len(loaded.faces) == len(ours["faces"])
        # Blender's x, y, z are x, −z, y there.
        turned = np.stack([loaded.vertices[:, 0], -loaded.vertices[:, 2], loaded.vertices[:, 1]], 1)
        assert np.abs(turned.min(0) - ours["vertices"].min(0)).max() < 1e-5
        assert np.abs(turned.max(0) - ours["vertices"].max(0)).max() < 1e-5
        material = loaded.visual.material
        assert (material.image if kind == "obj" else material.baseColorTexture).size == (128, 128)
        # The same texel of the picture at the same place of the surface.
        corner_uv, face = loaded.visual.uv[loaded.faces], loaded.vertices[loaded.faces]
        centres = np.stack([face[..., 0], -face[..., 2], face[..., 1]], -1).mean(1)
        order = np.argsort(np.linalg.norm(centres, axis=1).round(6), kind="stable")
        mine = ours["vertices"][ours["faces"]].mean(1)
        nearest = np.array([np.argmin(np.linalg.norm(mine - c, axis=1)) for c in centres[order[:20]]])
        assert np.abs(corner_uv[order[:20]].mean(1) - ours["uv"][nearest].mean(1)).max() < 1e-4
        assert {path.suffix for path in beside} == ({".mtl", ".png"} if kind == "obj" else set())


def test_a_mesh_has_its_photos_on_it_and_maps_of_its_classes(trained: Path) -> None:
    target = trained / "exports/main"
    step = [s for s in json.loads((trained / "project.json").read_text())["provenance"] if s["verb"] == "mesh"][-1]
    assert step["settings"]["texture_kind"] == "photo"
    assert 0.5 < step["result"]["painted_by_photos"] <= 1
    maps = {name: np.asarray(Image.open(target / name)) for name in ("texture.png", *MAPS)}
    assert {m.shape[:2] for m in maps.values()} == {(128, 128)}
    assert set(np.unique(maps["class_id.png"])) <= {0, 1, 2}
    assert (maps["class_confidence.png"][maps["class_id.png"] == 0] == 0).all()
    ours = surface(trained)
    assert set(np.unique(ours["class_id"])) <= {0, 1, 2}
    assert (ours["confidence"][ours["class_id"] == 0] == 0).all()
    assert ours["confidence"].max() <= 1
    # The ball is labelled by halves: what the maps say at a face's middle is what the face is.
    middle = ours["uv"].mean(1)
    x, y = np.clip(np.stack([middle[:, 0], 1 - middle[:, 1]]) * 128, 0, 127).astype(int)
    height = ours["vertices"][ours["faces"]].mean(1)[:, 2]
    clear = (np.abs(height) > 0.15) & (ours["face_class"] > 0)
    assert (maps["class_id.png"][y, x] == ours["face_class"])[clear].mean() > 0.95
    assert (np.where(height > 0, 1, 2) == ours["face_class"])[clear].mean() > 0.97


@pytest.mark.slow
def test_a_texture_of_the_field_and_none_leave_no_maps_behind(trained: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(trained, copy)
    params = MeshParams(project=copy, resolution=32, texture=64, texture_kind="field", lods=1)
    result = run_verb("mesh", params, Reporter())
    assert result["lods"][0]["faces"] < 0.3 * result["faces"]
    assert len(trimesh.load(copy / "exports/main/mesh_lod1.glb", force="mesh").faces) == result["lods"][0]["faces"]
    assert "painted_by_photos" not in result
    assert (copy / "exports/main/class_id.png").is_file()
    assert not (copy / "exports/main/texture_unseen.png").exists()
    picture = np.asarray(Image.open(copy / "exports/main/texture.png"))
    assert picture.shape == (64, 64, 3)
    assert picture.std() > 5
    run_verb("mesh", MeshParams(project=copy, resolution=32), Reporter())
    assert not list((copy / "exports/main").glob("*.png"))
    assert not list((copy / "exports/main").glob("*lod*"))
    assert "uv" not in surface(copy)


def test_parts_and_levels_without_a_successor_go_and_files_of_the_user_stay(trained: Path, tmp_path: Path) -> None:
    copy, folder = tmp_path / "copy", tmp_path / "out"
    shutil.copytree(trained, copy)
    params = {"project": copy, "resolution": 32, "out": folder / "ball.stl"}
    run_verb("mesh", MeshParams(split="classes", lods=1, **params), Reporter())
    assert {"ball_top.stl", "ball_lod1_top.stl"} <= {path.name for path in folder.iterdir()}
    (folder / "ball_mine.stl").write_text("mine")
    (folder / "ball_top.stl").write_text("edited")
    os.utime(folder / "ball_top.stl", (time.time() + 60, time.time() + 60))
    run_verb("mesh", MeshParams(project=copy, resolution=32), Reporter())
    run_verb("mesh", MeshParams(**params), Reporter())
    assert {path.name for path in folder.iterdir()} == {"ball.stl", "ball_mine.stl", "ball_top.stl"}
    assert (folder / "ball_top.stl").read_text() == "edited"
    # As of `export`, in the folder of the project too.
    own = set((copy / "exports/main").iterdir())
    export(copy, "stl", split="classes")
    assert len(set((copy / "exports/main").iterdir()) - own) > 1
    export(copy, "stl")
    assert set((copy / "exports/main").iterdir()) - own == {copy / "exports/main/copy.stl"}
    # Of other formats in one folder.
    masks = export(copy, "masks", out=tmp_path / "both")
    export(copy, "colmap", out=tmp_path / "both")
    assert masks
    assert all(path.is_file() for path in masks)


def test_things_keep_their_names_beyond_the_region_and_in_a_larger_world(trained: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(trained, copy)
    before = {one.id: one.name for one in read_instances(copy / "exports/main")}
    run_verb("instances", InstancesParams(project=copy, rename=["top.001", "lid"]), Reporter())
    run_verb("mesh", MeshParams(project=copy, resolution=32, region="-1,-1,-1,1,1,-0.1"), Reporter())
    assert "lid" not in [one.name for one in read_instances(copy / "exports/main")]
    assert surface(copy)["vertices"][:, 2].max() <= -0.1 + 1e-6
    with edit_project(copy) as project:
        project.frame.world_from_sfm = (np.diag([3.0, 3, 3, 1]) @ project.frame.world_from_sfm).tolist()
    run_verb("mesh", MeshParams(project=copy, resolution=32), Reporter())
    after = {one.id: one.name for one in read_instances(copy / "exports/main")}
    lid = next(number for number, name in before.items() if name == "top.001")
    assert after[lid] == "lid"
    assert set(after.values()) == set(before.values()) - {"top.001"} | {"lid"}


def test_ply_and_stl_keep_the_world_and_the_classes(trained: Path, tmp_path: Path) -> None:
    ours = surface(trained)
    (ply,) = export(trained, "ply", out=tmp_path / "ball.ply")
    loaded = trimesh.load(ply, process=False)
    assert np.abs(loaded.vertices - ours["vertices"]).max() < 1e-5
    assert (loaded.metadata["_ply_raw"]["vertex"]["data"]["class_id"].ravel() == ours["class_id"]).all()
    assert (loaded.visual.vertex_colors[:, :3] == ours["colors"]).all()
    parts = export(trained, "stl", out=tmp_path / "ball.stl", split="classes")
    named = {"ball_bottom.stl", "ball_top.stl"}
    assert {path.name for path in parts} - {"ball_void.stl"} == named  # what no label reaches is void
    assert sum(len(trimesh.load(path).faces) for path in parts) == len(ours["faces"])


def test_default_place_and_wrong_endings(trained: Path, tmp_path: Path) -> None:
    (path,) = export(trained, "glb", split="classes")
    assert path == trained / "exports/main/Kugel ü.glb"
    assert set(trimesh.load(path).geometry) - {"void"} == {"top", "bottom"}
    with pytest.raises(SettingError, match=r"end in \.glb"):
        export(trained, "glb", out=tmp_path / "ball.obj")
    with pytest.raises(ProjectError, match="no mesh yet"):
        export(trained, "ply", run="other")
    steps = json.loads((trained / "project.json").read_text())["provenance"]
    assert [step["verb"] for step in steps][-1] == "export"


def test_usd_holds_the_mesh_its_texture_and_the_cameras(trained: Path, tmp_path: Path) -> None:
    path, picture = export(trained, "usd", out=tmp_path / "ball.usda")
    stage = Usd.Stage.Open(str(path))
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    ours = surface(trained)
    np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get()), ours["vertices"], atol=1e-6)
    assert list(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("class_id").Get()) == ours["face_class"].tolist()
    assert sum(prim.IsA(UsdGeom.Camera) for prim in stage.Traverse()) == 16
    texture = trained / "exports/main/texture.png"
    np.testing.assert_array_equal(np.asarray(Image.open(picture)), np.asarray(Image.open(texture)))
    instances = json.loads((trained / "exports/main/instances.json").read_text())
    labelled = {p.GetDisplayName() for p in stage.Traverse() if p.HasAPI("SemanticsLabelsAPI", "instance")}
    assert labelled == {entry["name"] for entry in instances}


def test_voxels_hold_the_ball_where_it_is(trained: Path) -> None:
    (path,) = export(trained, "voxels", resolution=24)
    with np.load(path, allow_pickle=False) as data:
        density, ids, matrix = data["density"], data["class_id"], data["world_from_voxel"]
        assert density.shape == (25, 25, 25)
        assert data["class_names"].tolist() == ["top", "bottom"]
        place = np.stack(np.meshgrid(*[np.arange(25.0)] * 3, indexing="ij"), -1) @ matrix[:3, :3].T + matrix[:3, 3]
        radius = np.linalg.norm(place, axis=-1)
        assert density[radius > 0.75].max() < 0.2 * np.median(density[(radius > 0.4) & (radius < 0.5)])
        shell = (radius > 0.42) & (radius < 0.52) & (np.abs(place[..., 2]) > 0.15) & (ids > 0)
        assert shell.sum() > 50
        assert (np.where(place[..., 2] > 0, 1, 2)[shell] == ids[shell]).mean() > 0.9
        assert data["color"][shell].std() > 10


def test_the_trained_field_as_a_graph(trained: Path) -> None:
    (path,) = export(trained, "onnx")
    model = onnx.load(path)
    props = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    assert props["class_names"] == ["top", "bottom"]
    angle = np.linspace(0, 6, 40)
    ring = np.stack([0.49 * np.cos(angle) * 0.9, 0.49 * np.sin(angle) * 0.9, 0.49 * 0.43 * np.ones(40)], 1)
    points = np.concatenate([ring, 2.0 * ring]).astype(np.float32)
    view = (-points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    density, color, classes = ReferenceEvaluator(model).run(None, {"points": points, "directions": view})
    assert np.median(density[:40]) > 10 * np.median(density[40:])
    assert (classes[:40].argmax(1) == 0).mean() > 0.9
    assert color.min() >= 0
    assert color.max() <= 1


TENSORRT = json.loads((Path(__file__).parent / "support" / "tensorrt_operators.json").read_text())
NAMES = {TensorProto.FLOAT: "FP32", TensorProto.INT64: "INT64", TensorProto.BOOL: "BOOL"}  # in that list


def untaken(model: onnx.ModelProto) -> list[str]:
    """Operators of a graph, with the types of what they read and give, that TensorRT's list does not have."""
    graph = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
    kinds = {one.name: one.data_type for one in graph.initializer}
    for value in (*graph.input, *graph.value_info, *graph.output):
        kinds[value.name] = value.type.tensor_type.elem_type
    found = set()
    for node in graph.node:
        taken = TENSORRT["operators"].get(node.op_type, [])
        # Of what is read the first may be of any type; others can be indices and axes.
        for name in (node.input[0], *node.output):
            if NAMES[kinds[name]] not in taken:
                found.add(f"{node.op_type} {NAMES[kinds[name]]}")
    return sorted(found)


def test_what_tensorrt_does_not_take_is_found() -> None:
    value = [onnx.helper.make_tensor_value_info(name, TensorProto.INT64, [3]) for name in "abc"]
    graph = onnx.helper.make_graph([onnx.helper.make_node("BitwiseXor", ["a", "b"], ["c"])], "g", value[:2], value[2:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)])
    assert untaken(model) == ["BitwiseXor INT64"]


WORLD = np.array([[2.4, -0.7, 0.0, 1.0], [0.7, 2.4, 0.0, 2.0], [0.0, 0.0, 2.5, 3.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("settings", "contracted"),
    [
        pytest.param({}, False, marks=pytest.mark.slow),
        ({}, True),
        pytest.param({"branch": "explicit"}, False, marks=pytest.mark.slow),
        pytest.param({"branch": "implicit"}, True, marks=pytest.mark.slow),
        pytest.param({"fusion": "concat", "appearance": 8}, True, marks=pytest.mark.slow),
        pytest.param({"blend_by": "density"}, False, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_graph_computes_what_the_field_does(settings: dict, contracted: bool) -> None:
    """Dense and hashed levels, every branch and fusion, a turned and scaled cube, at any place and direction."""
    torch.manual_seed(0)
    small = {"precision": "float32", "levels": 2, "coarsest": 8, "finest": 200, "table_log2": 12}  # one of each kind
    field = HybridField(FieldConfig(**small, **settings), classes=3, images=5, thinning=contracted)
    if field.grid is not None:
        field.grid.table.normal_(0, 0.5)
    if field.blend is not None:
        field.blend.evidence.uniform_(0, 3)
    if field.appearance is not None:
        torch.nn.init.normal_(field.appearance)
    field.set_progress(0.05, 0.2, 10**6)
    model = field_model(field, Box(WORLD, contracted))
    onnx.checker.check_model(model, full_check=True)
    assert untaken(model) == []
    assert TENSORRT["opsets"][0] <= model.opset_import[0].version <= TENSORRT["opsets"][1]
    random = np.random.default_rng(1)
    places = random.uniform(-1, 1, (200, 3)) * (2.5 if contracted else 1.0)
    directions = random.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    world = (places @ WORLD[:3, :3].T + WORLD[:3, 3]).astype(np.float32)
    turned = (directions @ WORLD[:3, :3].T / 2.5).astype(np.float32)
    asked = {"points": world, "directions": turned}
    density, color, classes = ReferenceEvaluator(model).run(None, asked)
    for found, again in zip((density, color, classes), InferenceSession(model.SerializeToString()).run(None, asked)):
        assert again == pytest.approx(found, rel=1e-3, abs=1e-4), "ONNX Runtime says the same"
    with torch.no_grad():
        geometry = field.geometry(grid_position(torch.from_numpy(places).float(), contracted))
        true_color = field.color(geometry, spherical_harmonics(torch.from_numpy(directions).float()))
        true_classes = torch.softmax(field.logits(geometry), 1)
    assert density == pytest.approx((geometry.density / 2.5).numpy(), rel=1e-3, abs=1e-6)
    assert color == pytest.approx(true_color.numpy(), abs=1e-4)
    assert classes == pytest.approx(true_classes.numpy(), abs=1e-4)


@pytest.mark.parametrize(
    ("to", "name"), [("voxels", "mesh.npz"), ("voxels", "mesh_coarse.npz"), ("transforms", "mesh.json")]
)
def test_no_export_takes_the_place_of_the_stored_mesh(tmp_path: Path, to: str, name: str) -> None:
    folder = court(tmp_path / "p")
    stored = folder / "exports" / "main" / name
    before = stored.read_bytes()
    with pytest.raises(SettingError, match=f"{name} is a file that the mesh"):
        export(folder, to, out=folder / "exports" / ".." / "exports" / "main" / name)
    assert stored.read_bytes() == before


def test_files_are_named_after_the_project_and_not_after_the_mesh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = court(tmp_path / "mesh")
    monkeypatch.setattr("fieldwork.nerfcore.export.verb.load_trained", lambda *_: None)
    monkeypatch.setattr(
        "fieldwork.nerfcore.export.verb.load_info", lambda *_: RunInfo.model_construct(label_revision=None)
    )
    monkeypatch.setattr("fieldwork.nerfcore.export.voxels.write_voxels", lambda *_: None)
    assert export(folder, "voxels") == [folder / "exports" / "main" / "mesh-voxels.npz"]
    (folder / "inside").mkdir()
    monkeypatch.chdir(folder / "inside")
    (path,) = export(Path(".."), "ply")
    assert path.name == "mesh.ply"


def test_a_mesh_from_before_the_project_was_aligned_anew_is_refused(tmp_path: Path) -> None:
    court(tmp_path / "p")
    export(tmp_path / "p", "ply", out=tmp_path / "before.ply")
    with edit_project(tmp_path / "p") as project:
        project.frame.world_from_sfm = np.diag([2.5, 2.5, 2.5, 1]).tolist()
    for kind in ("ply", "masks"):
        with pytest.raises(ProjectError, match="aligned anew"):
            export(tmp_path / "p", kind)
