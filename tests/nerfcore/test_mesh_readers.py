"""Mesh files, opened again by programs that did not write them: classes, instances, places, colours, cameras."""

from __future__ import annotations

import json
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import DiskError
from fieldwork.nerfcore.geometry.cameras import project
from fieldwork.nerfcore.geometry.similarity import transform_points
from fieldwork.nerfcore.mesh import usd
from fieldwork.nerfcore.mesh.features import features_of
from fieldwork.nerfcore.mesh.files import write_surface
from fieldwork.tests.nerfcore.support import gltf_validator
from fieldwork.tests.nerfcore.support import painted_box as box
from PIL import Image
from pxr import Gf, Usd, UsdGeom, UsdSemantics, UsdShade

SPLITS = {"none": 1, "classes": 3, "instances": 4}


def write(path: Path, split: str = "none", textured: bool = True) -> list[Path]:
    return write_surface(path, box.surface(), box.features(), split, box.texture() if textured else None, [box.VIEW])


def read_glb(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def values(tree: dict, blob: bytes, index: int) -> np.ndarray:
    """An accessor as glTF 2.0 has it, with its stride."""
    found = tree["accessors"][index]
    view = tree["bufferViews"][found["bufferView"]]
    kind = np.dtype({5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[found["componentType"]])
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[found["type"]]
    stride = view.get("byteStride", kind.itemsize * width)
    begin = view.get("byteOffset", 0) + found.get("byteOffset", 0)
    return np.ndarray((found["count"], width), kind, blob, begin, (stride, kind.itemsize))


def table(tree: dict, blob: bytes) -> dict[str, list]:
    """The columns of the property table, as EXT_structural_metadata has them."""
    metadata = tree["extensions"]["EXT_structural_metadata"]
    (found,) = metadata["propertyTables"]
    kinds = metadata["schema"]["classes"][found["class"]]["properties"]

    def view(index: int) -> bytes:
        place = tree["bufferViews"][index]
        assert place["byteOffset"] % 8 == 0
        return blob[place["byteOffset"] : place["byteOffset"] + place["byteLength"]]

    columns = {}
    for name, entry in found["properties"].items():
        data = view(entry["values"])
        if kinds[name]["type"] == "STRING":
            ends = np.frombuffer(view(entry["stringOffsets"]), "<u4")
            columns[name] = [data[a:b].decode() for a, b in zip(ends[:-1], ends[1:])]
        else:
            dtype = {"UINT8": "u1", "UINT32": "<u4"}[kinds[name]["componentType"]]
            columns[name] = np.frombuffer(data, dtype).reshape(found["count"], -1).tolist()
    return columns


@pytest.mark.parametrize("split", SPLITS)
def test_glb_says_class_and_instance_of_each_face(tmp_path: Path, split: str) -> None:
    (path,) = write(tmp_path / "a.glb", split)
    tree, blob = read_glb(path)
    columns = table(tree, blob)
    assert columns["class_name"] == ["void", "Säule 1", "gold", "gold"]
    assert columns["instance_name"] == ["", "", "gold.001", "gold.002"]
    assert columns["color"][2] == [204, 179, 0]
    assert set(tree["extensionsUsed"]) == {"EXT_mesh_features", "EXT_structural_metadata"}
    assert len(tree["meshes"]) == SPLITS[split]
    known = {tuple(np.sort(face).tolist()): n for n, face in enumerate(box.surface().faces)}
    seen = set()
    for mesh in tree["meshes"]:
        (primitive,) = mesh["primitives"]
        (ids,) = primitive["extensions"]["EXT_mesh_features"]["featureIds"]
        assert ids == {"featureCount": 4, "attribute": 0, "propertyTable": 0, "label": "surface"}
        feature = values(tree, blob, primitive["attributes"]["_FEATURE_ID_0"])
        assert feature.dtype.kind == "u"
        places = values(tree, blob, primitive["attributes"]["POSITION"]) * [1, 1, -1]
        away = np.linalg.norm(places[:, None, [0, 2, 1]] - box.surface().vertices, axis=2)
        assert away.min(1).max() < 1e-6
        for corners in values(tree, blob, primitive["indices"]).reshape(-1, 3):
            face = known[tuple(np.sort(away[corners].argmin(1)).tolist())]
            (row,) = set(feature[corners, 0].tolist())
            assert columns["class_id"][row] == [box.FACE_CLASS[face]]
            assert columns["instance"][row] == [box.FACE_INSTANCE[face]]
            seen.add(face)
    assert len(seen) == 12


@pytest.mark.parametrize("textured", [True, False])
@pytest.mark.parametrize("split", SPLITS)
def test_the_gltf_validator_finds_nothing(tmp_path: Path, split: str, textured: bool) -> None:
    if not gltf_validator.is_there():
        pytest.skip(gltf_validator.MISSING)
    (path,) = write(tmp_path / "a.glb", split, textured)
    report = gltf_validator.report_of(path)
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0, report["issues"]["messages"]
    # What it does not know of, it says so.
    unknown = {m["code"] for m in report["issues"]["messages"] if m["severity"] == gltf_validator.HINT}
    assert unknown <= {"UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"}
    assert report["info"]["totalTriangleCount"] == 12


@pytest.mark.parametrize("ending", ["usdc", "usda", "usdz"])
@pytest.mark.parametrize("split", SPLITS)
def test_usd_says_class_and_instance_of_each_face(tmp_path: Path, split: str, ending: str) -> None:
    path, *beside = write(tmp_path / f"Säule 1.{ending}", split)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetDisplayName() == "Säule 1"
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert len(meshes) == SPLITS[split]
    ours, seen = box.surface(), []
    for mesh in meshes:
        points = np.array(mesh.GetPointsAttr().Get())
        corners = points[np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)]
        faces = [int(np.abs(ours.vertices[ours.faces] - c).max((1, 2)).argmin()) for c in corners]
        np.testing.assert_array_equal(ours.vertices[ours.faces][faces], corners)
        seen += faces
        primvars = UsdGeom.PrimvarsAPI(mesh)
        assert list(primvars.GetPrimvar("class_id").Get()) == box.FACE_CLASS[faces].tolist()
        check_subsets(mesh, np.array(faces))
        st = np.array(primvars.GetPrimvar("st").ComputeFlattened()).reshape(-1, 3, 2)
        texels = (st.mean(1) * [1, -1] * box.SIZE + [0, box.SIZE]).astype(int)
        np.testing.assert_array_equal(picture(path, beside)[texels[:, 1], texels[:, 0]], box.face_colors()[faces])
    assert sorted(seen) == list(range(12))


def test_classes_may_be_called_as_other_parts_of_a_usd(tmp_path: Path) -> None:
    classes = [replace(c, name=name) for c, name in zip(box.CLASSES, ("Materials", "Cameras"))]
    features = features_of(box.surface(), classes, 0)
    path, *_ = write_surface(tmp_path / "a.usdc", box.surface(), features, "classes", box.texture(), [box.VIEW])
    stage = Usd.Stage.Open(str(path))
    faces = {
        prim.GetDisplayName(): len(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get())
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Mesh)
    }
    assert faces == {"void": 2, "Materials": 6, "Cameras": 4}
    (camera,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    (materials, cameras) = (stage.GetPrimAtPath(f"/a/{name}") for name in ("Materials", "Cameras"))
    assert materials.IsA(UsdGeom.Scope)
    assert len(materials.GetChildren()) == 3
    assert cameras.GetChildren() == [camera]


def check_subsets(mesh: UsdGeom.Mesh, faces: np.ndarray) -> None:
    """The subsets of a mesh that has these faces of the box."""
    classes, instances = np.zeros(len(faces), int), np.zeros(len(faces), int)
    numbers = {"void": 0, "Säule 1": 3, "gold": 7}
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        prim, chosen = subset.GetPrim(), list(subset.GetIndicesAttr().Get())
        (label,) = UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()
        if subset.GetFamilyNameAttr().Get() == "instance":
            (name,) = UsdSemantics.LabelsAPI(prim, "instance").GetLabelsAttr().Get()
            instances[chosen] = int(name.removeprefix("gold."))
            continue
        classes[chosen] = numbers[label]
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        assert material.GetPrim().GetDisplayName() == label
        shader = material.ComputeSurfaceSource()[0]
        assert shader.GetInput("metallic").Get() == 0
        assert shader.GetInput("roughness").Get() == 1
    assert classes.tolist() == box.FACE_CLASS[faces].tolist()
    assert instances.tolist() == box.FACE_INSTANCE[faces].tolist()
    valid, reason = UsdGeom.Subset.ValidateFamily(mesh, UsdGeom.Tokens.face, UsdShade.Tokens.materialBind)
    assert valid, reason


def picture(path: Path, beside: list[Path]) -> np.ndarray:
    """The texture beside a USD file, or in it."""
    if path.suffix != ".usdz":
        (place,) = beside
        return np.asarray(Image.open(place).convert("RGB"))
    with zipfile.ZipFile(path) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".png"))
        with archive.open(name) as file:
            return np.asarray(Image.open(file).convert("RGB"))


def test_usd_without_a_texture_shows_linear_vertex_colours(tmp_path: Path) -> None:
    (path,) = write(tmp_path / "a.usda", textured=False)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(next(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)))
    linear = np.array(mesh.GetDisplayColorAttr().Get())
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb * 255, box.surface().colors, atol=0.01)
    shader = next(UsdShade.Shader(p) for p in stage.Traverse() if p.GetName() == "Color")
    assert shader.GetInput("varname").Get() == "displayColor"


def test_usd_cameras_see_what_ours_see(tmp_path: Path) -> None:
    path, *_ = write(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(path))
    (prim,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    assert prim.GetDisplayName() == "IMG 1"
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    points = box.surface().vertices.astype(float)
    ours = project(box.VIEW.camera, transform_points(np.linalg.inv(box.VIEW.camera_to_world), points))
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    clip = np.array([list(matrix.Transform(Gf.Vec3d(*point.tolist()))) for point in points])
    theirs = (clip[:, :2] * [1, -1] + 1) / 2 * [box.VIEW.camera.width, box.VIEW.camera.height]
    np.testing.assert_allclose(theirs, ours, atol=1e-3)


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_usd_that_finds_no_room_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    (tmp_path / f"a.{ending}").write_text("before")
    (tmp_path / "file").touch()

    def without_folder(stage: Usd.Stage, *_: object) -> None:
        layer = stage.GetRootLayer()
        layer.identifier = str(tmp_path / "file" / Path(layer.identifier).name)

    monkeypatch.setattr(usd, "_cameras", without_folder)
    with pytest.raises(DiskError, match="USD cannot be written to"):
        write(tmp_path / f"a.{ending}", textured=False)
    assert {path.name for path in tmp_path.iterdir()} == {f"a.{ending}", "file"}
    assert (tmp_path / f"a.{ending}").read_text() == "before"


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_usd_cameras_show_all_of_a_surface_whatever_the_unit(tmp_path: Path, unit: float) -> None:
    pose = box.VIEW.camera_to_world.copy()
    pose[:3, 3] *= unit
    whole, view = (
        replace(box.surface(), vertices=box.surface().vertices * unit),
        replace(box.VIEW, camera_to_world=pose),
    )
    path, *_ = write_surface(tmp_path / "a.usdc", whole, box.features(), "none", views=[view])
    stage = Usd.Stage.Open(str(path))
    (camera,) = (UsdGeom.Camera(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    near, far = camera.GetClippingRangeAttr().Get()
    depth = transform_points(np.linalg.inv(pose), whole.vertices.astype(float))[:, 2]
    assert near < depth.min()
    assert depth.max() < far


def test_obj_groups_are_the_features(tmp_path: Path) -> None:
    path, *_ = write(tmp_path / "a.obj")
    groups: dict[str, int] = {}
    for line in path.read_text("utf-8").splitlines():
        if line.startswith("g "):
            groups[name := line[2:]] = 0
        elif line.startswith("f "):
            groups[name] += 1
    assert groups == {"void": 2, "Säule_1": 6, "gold.001": 2, "gold.002": 2}
    assert len(trimesh.load(path, force="mesh", process=False).faces) == 12


def test_a_backslash_in_a_name_takes_no_face_from_an_obj(tmp_path: Path) -> None:
    classes = [replace(c, name=name) for c, name in zip(box.CLASSES, ("stone\\", "a \\ b"))]
    path, *_ = write_surface(tmp_path / "a.obj", box.surface(), features_of(box.surface(), classes, 0), "none")
    groups = [line for line in path.read_text("utf-8").splitlines() if line.startswith("g ")]
    assert groups == ["g void", "g stone_", "g a_b.001", "g a_b.002"]
    assert len(trimesh.load(path, force="mesh", process=False).faces) == 12


def test_long_names_of_classes_are_cut_for_files(tmp_path: Path) -> None:
    classes = [replace(c, name=300 * "long " + c.name) for c in box.CLASSES]
    files = write_surface(tmp_path / "a.ply", box.surface(), features_of(box.surface(), classes, 0), "classes")
    assert len(set(files)) == 3
    assert sum(len(trimesh.load(path, process=False).faces) for path in files) == 12


def test_ply_says_class_and_instance_of_each_face(tmp_path: Path) -> None:
    (path,) = write(tmp_path / "a.ply")
    face = trimesh.load(path, process=False).metadata["_ply_raw"]["face"]["data"]
    assert face["face_class"].ravel().tolist() == box.FACE_CLASS.tolist()
    assert face["face_instance"].ravel().tolist() == box.FACE_INSTANCE.tolist()


def test_many_features_have_their_numbers_all_the_same(tmp_path: Path) -> None:
    """More rows than 16 bits can count."""
    count = 65540
    one = box.surface()
    many = replace(
        one,
        faces=np.tile(one.faces, (count // 12 + 1, 1))[:count],
        face_class=np.full(count, 7),
        face_instance=np.arange(count),
    )
    (path,) = write_surface(tmp_path / "a.glb", many, features_of(many, box.CLASSES, 0), "none")
    tree, blob = read_glb(path)
    feature = values(tree, blob, tree["meshes"][0]["primitives"][0]["attributes"]["_FEATURE_ID_0"])
    assert set(feature[:, 0].tolist()) == set(range(count))
    assert table(tree, blob)["instance_name"][-1] == f"gold.{count - 1}"
