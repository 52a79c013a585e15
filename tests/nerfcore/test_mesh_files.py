"""What mesh files say about colour, read back by other programs' readers."""

from __future__ import annotations

import json
import struct
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.data.scene import ClassInfo
from fieldwork.nerfcore.errors import DiskError
from fieldwork.nerfcore.mesh import usd
from fieldwork.nerfcore.mesh.features import features_of
from fieldwork.nerfcore.mesh.files import write_surface
from fieldwork.nerfcore.mesh.instances import Instance
from fieldwork.nerfcore.mesh.parts import texture_of
from fieldwork.nerfcore.mesh.surface import Surface, class_table
from PIL import Image
from pxr import Usd, UsdGeom

# sRGB → linear by IEC 61966-2-1, to six digits.
LINEAR = {0: 0.0, 10: 0.003035, 128: 0.215861, 188: 0.502886, 200: 0.577580, 255: 1.0}
COLORS = np.array([[0, 10, 128], [188, 200, 255], [255, 0, 10], [128, 188, 200]], np.uint8)


def square() -> Surface:
    """A unit square of two triangles and two classes."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    classes = np.array([1, 2, 1, 2], np.int32)
    return Surface(vertices, faces, normals, COLORS, classes, np.array([1, 2], np.int32))


def plain(*names: str):
    return features_of(square(), [ClassInfo(n, name, (0, 0, 0)) for n, name in enumerate(names, 1)], 0)


def texture(level: int):
    surface = square()
    picture = np.full((8, 8, 3), level, np.uint8)
    picture[:4] = (200, 10, 128)
    return texture_of(surface.faces, surface.vertices[surface.faces][..., :2].astype(np.float32), picture)


def glb(path: Path) -> tuple[dict, bytes]:
    """The JSON and the binary chunk of a GLB file."""
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def accessor(tree: dict, blob: bytes, index: int) -> np.ndarray:
    found = tree["accessors"][index]
    view = tree["bufferViews"][found["bufferView"]]
    kind = {5121: np.uint8, 5123: np.uint16, 5126: np.float32}[found["componentType"]]
    width = {"VEC3": 3, "VEC4": 4}[found["type"]]
    begin = view.get("byteOffset", 0) + found.get("byteOffset", 0)
    values = np.frombuffer(blob, kind, found["count"] * width, begin).reshape(-1, width)
    assert values.dtype.kind == "f" or found["normalized"]
    return values if values.dtype.kind == "f" else values / np.iinfo(kind).max


@pytest.mark.parametrize("textured", [True, False])
def test_glb_has_a_matt_material_of_the_plain_colour(tmp_path: Path, textured: bool) -> None:
    (path,) = write_surface(tmp_path / "a.glb", square(), plain(), "none", texture(50) if textured else None)
    tree, _ = glb(path)
    (primitive,) = tree["meshes"][0]["primitives"]
    material = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
    assert material["baseColorFactor"] == [1, 1, 1, 1]
    assert material["metallicFactor"] == 0
    assert material["roughnessFactor"] == 1
    assert ("baseColorTexture" in material) == textured
    assert ("COLOR_0" in primitive["attributes"]) == (not textured)
    if textured:
        loaded = trimesh.load(path, force="mesh")
        pixels = np.asarray(loaded.visual.material.baseColorTexture.convert("RGB"))
        assert pixels[0, 0].tolist() == [200, 10, 128]
        assert pixels[7, 7].tolist() == [50, 50, 50]


@pytest.mark.parametrize("split", ["none", "classes"])
def test_vertex_colours_are_linear_in_glb(tmp_path: Path, split: str) -> None:
    (path,) = write_surface(tmp_path / "a.glb", square(), plain("a", "b"), split)
    tree, blob = glb(path)
    assert len(tree["meshes"]) == 1 + (split == "classes")
    for mesh in tree["meshes"]:
        attributes = mesh["primitives"][0]["attributes"]
        assert {"POSITION", "NORMAL", "COLOR_0", "_FEATURE_ID_0"} <= set(attributes)
        places = accessor(tree, blob, attributes["POSITION"])
        colors = accessor(tree, blob, attributes["COLOR_0"])[:, :3]
        for place, color in zip(places, colors):
            vertex = int(np.linalg.norm(square().vertices[:, [0, 2, 1]] * [1, 1, -1] - place, axis=1).argmin())
            assert color == pytest.approx([LINEAR[value] for value in COLORS[vertex].tolist()], abs=2e-5)


def test_vertex_colours_are_linear_in_usd(tmp_path: Path) -> None:
    path, *_ = write_surface(tmp_path / "a.usda", square(), plain(), "none")
    stage = Usd.Stage.Open(str(path))
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    wanted = [[LINEAR[value] for value in color] for color in COLORS.tolist()]
    assert np.array(mesh.GetDisplayColorAttr().Get()) == pytest.approx(np.array(wanted), abs=1e-6)


def test_vertex_colours_are_srgb_in_ply_and_obj(tmp_path: Path) -> None:
    for kind in ("ply", "obj"):
        path, *_ = write_surface(tmp_path / f"a.{kind}", square(), plain(), "none")
        loaded = trimesh.load(path, process=False)
        assert loaded.visual.vertex_colors[:, :3].tolist() == COLORS.tolist()


@pytest.mark.parametrize("name", ["b", "Kugel ü 2"])
def test_two_textured_obj_in_one_folder(tmp_path: Path, name: str) -> None:
    first = write_surface(tmp_path / "a.obj", square(), plain(), "none", texture(50))
    second = write_surface(tmp_path / f"{name}.obj", square(), plain(), "none", texture(90))
    assert len(first) == len(second) == 3
    assert not set(first) & set(second)
    for files, level in ((first, 50), (second, 90)):
        assert all(path.is_file() for path in files)
        material = trimesh.load(files[0], force="mesh").visual.material
        assert np.asarray(material.image.convert("RGB"))[7, 7].tolist() == [level] * 3
        assert material.diffuse[:3].tolist() == [255, 255, 255]
        text = next(path for path in files if path.suffix == ".mtl").read_text()
        assert "Kd 1.0" in text
        assert "Ks 0.0" in text
    names = {line for files in (first, second) for line in files[0].read_text().splitlines() if "usemtl" in line}
    assert len(names) == 2


def test_split_obj_keeps_the_textures_of_its_parts(tmp_path: Path) -> None:
    files = write_surface(tmp_path / "a.obj", square(), plain("x", "y"), "classes", texture(50))
    assert len(set(files)) == 6
    for path in files:
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert image.getpixel((7, 7)) == (50, 50, 50)


def test_a_thing_that_is_called_as_a_class_is_not_one_with_the_rest_of_that(tmp_path: Path) -> None:
    surface = replace(square(), face_instance=np.array([1, 0], np.uint32))
    classes = [ClassInfo(1, "chair", (0, 0, 0)), ClassInfo(2, "table", (0, 0, 0))]
    features = features_of(surface, classes, 0, [Instance(1, "table", 1, 0.5, (0, 0, 0))])
    assert {name: faces.tolist() for name, faces in features.groups("instances").items()} == {
        "table": [0],
        "table.000": [1],
    }
    assert list(features.groups("classes")) == ["chair", "table"]
    write_surface(tmp_path / "a.glb", surface, features, "instances")
    assert [mesh["name"] for mesh in glb(tmp_path / "a.glb")[0]["meshes"]] == ["table", "table.000"]


def test_areas_of_void_and_of_a_class_of_its_name_are_added() -> None:
    found = class_table(square(), {1: "void", 2: "void"})
    assert found == {"void": {"faces": 2, "area": pytest.approx(1)}}


def test_areas_of_small_things_have_their_digits() -> None:
    small = replace(square(), vertices=square().vertices * 0.0123)
    assert class_table(small, {1: "a"})["a"] == {"faces": 1, "area": pytest.approx(0.0123**2 / 2, rel=1e-5)}


def test_usd_is_made_where_it_comes_to_and_leaves_nothing_where_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind, beside in {"usdc": ["a_texture.png"], "usdz": []}.items():
        out = tmp_path / kind
        written = write_surface(out / f"a.{kind}", square(), plain(), "none", texture(50))
        assert [path.name for path in written] == [f"a.{kind}", *beside]
        assert set(out.iterdir()) == set(written)
        assert Usd.Stage.Open(str(written[0])) is not None
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "full"))  # a disk that has no room
    assert len(write_surface(tmp_path / "plain.usdz", square(), plain(), "none")) == 1
    monkeypatch.setattr(usd.UsdUtils, "CreateNewUsdzPackage", lambda *_: False)
    (tmp_path / "b").mkdir()
    (tmp_path / "b/a.usdz").write_bytes(b"earlier")
    with pytest.raises(DiskError, match=r"USD cannot be written to .*/b\."):
        write_surface(tmp_path / "b/a.usdz", square(), plain(), "none")
    assert [path.read_bytes() for path in (tmp_path / "b").iterdir()] == [b"earlier"]
