"""Gaussian splats for other programs."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.progress import Reporter

from .support import gltf_validator
from .support.film import SIDE, H, W, ball, store, take

__all__ = ["ball", "store"]


@pytest.fixture(scope="module")
def exported(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the ball, into which exports may go."""
    return Path(shutil.copytree(ball, tmp_path_factory.mktemp("splats") / "ball"))


def test_splats_look_like_the_baked_field(exported: Path, store: FieldStore) -> None:
    """Read by another library, and drawn here as circles, the nearest over the others."""
    import trimesh
    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    path, _ = run_verb("export", ExportParams(project=exported, to="splats"), Reporter())["files"]
    assert Path(path).name == "ball-splats.ply"
    data = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    names = list(data) if isinstance(data, dict) else list(data.dtype.names)
    assert names[:3] == ["x", "y", "z"]
    assert names[-2:] == ["class_id", "class_probability"]
    values = {name: np.asarray(data[name]).reshape(-1) for name in names}
    place = np.stack([values[axis] for axis in "xyz"], 1)
    solid = values["opacity"] > 0
    radius = np.linalg.norm(place[solid], axis=1)
    assert np.median(radius) == pytest.approx(0.5, abs=0.08)
    high = (radius > 0.45) & (np.abs(place[solid][:, 2]) > 0.1)
    assert (np.where(place[solid][high, 2] > 0, 1, 2) == values["class_id"][solid][high]).mean() > 0.85
    # The picture from the side.
    way = place - SIDE[:3, 3]
    order = np.argsort(way[:, 1])
    unit = way / np.linalg.norm(way, axis=1, keepdims=True)
    basis = 0.4886025119029199 * np.stack([-unit[:, 1], unit[:, 2], -unit[:, 0]], 1)
    rest = np.stack([values[f"f_rest_{n}"] for n in range(9)], 1).reshape(-1, 3, 3)
    color = 0.5 + 0.28209479177387814 * np.stack([values[f"f_dc_{n}"] for n in range(3)], 1)
    color = (color + np.einsum("nck,nk->nc", rest, basis)).clip(0, 1)
    x, y = 120 * way[:, 0] / way[:, 1] + W / 2, H / 2 - 120 * way[:, 2] / way[:, 1]
    sigma = 120 * np.exp(values["scale_0"]) / way[:, 1]
    peak = 1 / (1 + np.exp(-values["opacity"]))
    picture, left = np.zeros((H, W, 3)), np.ones((H, W))
    rows, columns = np.mgrid[0:H, 0:W] + 0.5
    for n in order:
        near = max(int(3 * sigma[n]) + 1, 2)
        part = np.s_[max(int(y[n]) - near, 0) : int(y[n]) + near, max(int(x[n]) - near, 0) : int(x[n]) + near]
        distance = (columns[part] - x[n]) ** 2 + (rows[part] - y[n]) ** 2
        alpha = peak[n] * np.exp(-distance / (2 * sigma[n] ** 2))
        picture[part] += (left[part] * alpha)[..., None] * color[n]
        left[part] *= 1 - alpha
    field = take(exported, store, ["Combined"], {"baked": True})["Combined"]
    assert np.abs((1 - left) - field[..., 3]).mean() < 0.05
    inner = field[..., 3] > 0.99
    srgb = np.where(
        field[..., :3] > 0.0031308, 1.055 * field[..., :3].clip(1e-9) ** (1 / 2.4) - 0.055, 12.92 * field[..., :3]
    )
    assert np.abs(picture - srgb)[inner].mean() < 0.06


def test_splats_need_a_baked_field(ball: Path, tmp_path: Path) -> None:
    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    project = Path(shutil.copytree(ball, tmp_path / "p"))
    shutil.rmtree(project / "runs" / "main" / "voxels")
    with pytest.raises(ProjectError, match="no baked field"):
        run_verb("export", ExportParams(project=project, to="splats"), Reporter())


def test_splats_as_gltf_are_those_of_the_ply(exported: Path, tmp_path: Path) -> None:
    """Read by other libraries: trimesh, and where there is node with it, the validator of Khronos."""
    import json

    import trimesh
    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    out = tmp_path / "castle.ply"
    ply, glb = run_verb("export", ExportParams(project=exported, to="splats", out=out), Reporter())["files"]
    assert Path(glb).name == "castle-splats.glb", "castle.glb is rather its mesh"
    points = trimesh.load(ply).metadata["_ply_raw"]["vertex"]["data"]
    cloud = next(iter(trimesh.load(glb).geometry.values()))
    expected = np.stack([np.asarray(points[axis]).reshape(-1) for axis in "xzy"], 1) * [1, 1, -1]
    assert cloud.vertices == pytest.approx(expected, abs=1e-5), "y is up"
    raw = Path(glb).read_bytes()
    length = int.from_bytes(raw[12:16], "little")
    tree, data = json.loads(raw[20 : 20 + length]), raw[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"

    def read(name: str) -> np.ndarray:
        accessor = tree["accessors"][primitive["attributes"][name]]
        view = tree["bufferViews"][accessor["bufferView"]]
        values = np.frombuffer(data, "<f4", view["byteLength"] // 4, view["byteOffset"])
        return values.reshape(accessor["count"], -1)

    of_ply = {name: np.asarray(points[name]).reshape(-1) for name in points.dtype.names}
    kind = "KHR_gaussian_splatting:"
    assert read(kind + "OPACITY")[:, 0] == pytest.approx(1 / (1 + np.exp(-of_ply["opacity"])), abs=1e-5)
    assert read(kind + "SCALE")[:, 1] == pytest.approx(np.exp(of_ply["scale_2"]), rel=1e-5)
    assert read("_CLASS_ID")[:, 0].tolist() == of_ply["class_id"].tolist()
    # The colour from a direction, in both axes.
    way = np.array([0.48, -0.6, 0.64])
    c1, basis = 0.4886025119029199, lambda d: np.array([-d[1], d[2], -d[0]])
    rest = np.stack([of_ply[f"f_rest_{n}"] for n in range(9)], 1).reshape(-1, 3, 3)
    turned = np.stack([read(f"{kind}SH_DEGREE_1_COEF_{n}") for n in range(3)], 2)
    there, here = (c1 * part @ basis(d) for part, d in ((rest, way), (turned, np.array([0.48, 0.64, 0.6]))))
    assert here == pytest.approx(there, abs=1e-5)
    if gltf_validator.is_there():
        report = gltf_validator.report_of(glb)
        # Version 2.0.0-dev.3.10 does not know the extension, whose attributes' names have a colon.
        own = "/attributes/KHR_gaussian_splatting:"
        wrong = [
            m for m in report["issues"]["messages"] if m["severity"] == gltf_validator.ERROR and own not in m["pointer"]
        ]
        assert wrong == []
