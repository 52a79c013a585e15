"""Features of photos on the surface: filters for texture, and models such as DINOv2 that users bring."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.labels.models import load
from fieldwork.nerfcore.labels.photo_features import ANSWERS, spread, texture_filters, uplifted
from fieldwork.nerfcore.labels.preparation import FOLDER, Preparation, ensured, prepare
from fieldwork.nerfcore.labels.tokens import TokenModel
from fieldwork.nerfcore.params import LabelPrepareParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import run_folder
from fieldwork.tests.nerfcore.support import onnx_models as tiny
from fieldwork.tests.nerfcore.test_labels import ball, two_strokes  # noqa: F401
from fieldwork.tests.nerfcore.test_labels import spread as propagated


def halves(width: int = 90, height: int = 60) -> np.ndarray:
    """A picture whose left half is red, its right one blue."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[:, : width // 2, 0] = picture[:, width // 2 :, 2] = 255
    return picture


@pytest.mark.parametrize(
    "make",
    [
        tiny.dino,
        lambda path: tiny.dino(path, patch=16, others=1),
        lambda path: tiny.dino(path, others=0, side=56),
        tiny.feature_map,
    ],
    ids=["dinov2 with registers", "patches of 16", "one size", "a map"],
)
def test_tokens_of_patches_lie_where_their_patches_do(tmp_path: Path, make) -> None:
    found = TokenModel(load(make(tmp_path / "m.onnx"))).features(halves())
    assert found.shape[2] == 8
    assert np.abs(found).max() < 100, "class and register tokens are left out"
    rows, columns = found.shape[:2]
    assert rows <= columns
    left, right = found[:, : columns // 2 - 1], found[:, columns // 2 + 1 :]
    assert (left[..., 0] > left[..., 2]).all()
    assert (right[..., 0] < right[..., 2]).all()


def test_models_of_another_kind_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected inputs"):
        TokenModel(load(tiny.sam_decoder(tmp_path / "d.onnx")))
    with pytest.raises(InputError, match="no token for each patch"):
        TokenModel(load(tiny.dino(tmp_path / "m.onnx", patch=10))).features(halves())


def test_filters_tell_texture_from_plain(tmp_path: Path) -> None:
    lab = np.zeros((48, 64, 3), np.float32)
    lab[..., 0] = 50
    lab[:, 32:, 0] += np.random.default_rng(0).normal(0, 10, (48, 32))
    found = texture_filters(lab)
    assert found.shape == (48, 64, ANSWERS)
    assert np.abs(found[:, :12, 0]).max() < 1e-3
    assert found[:, 52:, 0].mean() > 1


def test_values_are_brought_to_the_surfels_that_pixels_show() -> None:
    surfel = np.array([[0, 0, 1], [-1, 1, 1]])
    values = np.arange(6, dtype=np.float32).reshape(2, 3, 1)
    found = uplifted(3, [(surfel, values), (np.full((2, 3), -1), values)])
    np.testing.assert_allclose(found[:, 0], [0.5, 11 / 3, 0])
    wide = spread(np.array([[[0.0], [1.0]]]), 2, 4)
    np.testing.assert_allclose(wide[..., 0], [[0, 0.25, 0.75, 1]] * 2)


def of(folder: Path) -> Preparation:
    return Preparation(run_folder(folder, "main") / FOLDER)


def test_a_model_adds_columns_and_stays_until_another_is_given(ball: Path, tmp_path: Path) -> None:  # noqa: F811
    assert of(ball).photo_features.shape[1] == ANSWERS
    model = tiny.dino(tmp_path / "m.onnx")
    told = prepare(LabelPrepareParams(project=ball, surfels=3000, features=model), Reporter())
    assert not told["reused"]
    assert of(ball).photo_features.shape[1] > ANSWERS
    assert np.isfinite(of(ball).photo_features).all()
    assert prepare(LabelPrepareParams(project=ball, surfels=3000, features=model), Reporter())["reused"]
    _, reused = ensured(ball, "main", Reporter())
    assert reused, "nobody asked for another one"
    two_strokes(ball)
    assert propagated(ball)["marks"] == 2
    fewer, reused = ensured(ball, "main", Reporter(), 2000)
    assert not reused
    assert fewer.photo_features.shape[1] > ANSWERS, "made anew with the model of before"
    model.unlink()
    again, _ = ensured(ball, "main", Reporter(), 3000)
    assert again.photo_features.shape[1] == ANSWERS, "its file is gone"


def test_a_model_that_does_not_fit_leaves_the_preparation(
    ball: Path,  # noqa: F811
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    model = tiny.sam_decoder(tmp_path / "d.onnx")
    assert main(["label", "prepare", str(ball), "--features", str(model), "--json"]) != 0
    assert "expected inputs" in json.loads(capfd.readouterr().out)["error"]["message"]
    assert main(["label", "prepare", str(ball), "--features", str(tmp_path / "no.onnx"), "--json"]) != 0
    assert of(ball).photo_features.shape[1] == ANSWERS
