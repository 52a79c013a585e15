"""Gaussian splats for other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.progress import Reporter

from .support.film import SIDE, H, W, ball, store, take

__all__ = ["ball", "store"]


def test_splats_look_like_the_baked_field(ball: Path, store: FieldStore) -> None:
    """Read by another library, and drawn here as circles, the nearest over the others."""
    import trimesh
    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    (path,) = run_verb("export", ExportParams(project=ball, to="splats"), Reporter())["files"]
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
    field = take(ball, store, ["Combined"], {"baked": True})["Combined"]
    assert np.abs((1 - left) - field[..., 3]).mean() < 0.05
    inner = field[..., 3] > 0.99
    srgb = np.where(
        field[..., :3] > 0.0031308, 1.055 * field[..., :3].clip(1e-9) ** (1 / 2.4) - 0.055, 12.92 * field[..., :3]
    )
    assert np.abs(picture - srgb)[inner].mean() < 0.06


def test_splats_need_a_baked_field(ball: Path, tmp_path: Path) -> None:
    import shutil

    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    project = Path(shutil.copytree(ball, tmp_path / "p"))
    shutil.rmtree(project / "runs" / "main" / "voxels")
    with pytest.raises(ProjectError, match="no baked field"):
        run_verb("export", ExportParams(project=project, to="splats"), Reporter())
