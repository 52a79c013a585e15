"""Labels that are unsure, sparse or few: from files to the loss."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import VOID, PixelStore
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.images.labels import read_labels
from fieldwork.nerfcore.images.soft_labels import read_confidence, read_probabilities
from fieldwork.nerfcore.params import EvaluateParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.train.losses import semantic_loss
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.photos import folder_of, new
from PIL import Image


def probabilities() -> np.ndarray:
    """(200, 320, 3): class 1 at 0.9 on the left, class 2 at 0.6 on the right."""
    values = np.zeros((200, 320, 3), np.float32)
    values[:, :160] = (0.05, 0.9, 0.05)
    values[:, 160:] = (0.1, 0.3, 0.6)
    return values


def test_probability_maps_and_confidence_maps_become_labels_with_confidence(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    photos, labels = folder_of(tmp_path / "photos", 4), tmp_path / "maps"
    (labels / "confidence").mkdir(parents=True)
    np.save(labels / "p0.npy", probabilities())
    np.savez(labels / "p1.npz", probabilities())
    oiio.ImageBuf(probabilities()).write(str(labels / "p2.exr"))
    Image.fromarray(np.full((200, 320), 2, np.uint8)).save(labels / "p3.png")
    Image.fromarray(np.full((200, 320), 51, np.uint8)).save(labels / "confidence" / "p3.png")
    result = new(photos, tmp_path / "project", labels=labels)
    assert result["labelled"] == 4
    records = {record.name: record for record in load_project(tmp_path / "project").images}
    for name in ("p0", "p1", "p2"):
        label = np.asarray(Image.open(tmp_path / "project" / (records[name].label or "")))
        sure = np.asarray(Image.open(tmp_path / "project" / (records[name].confidence or "")))
        assert (label[:, :160] == 1).all()
        assert (label[:, 160:] == 2).all()
        assert np.unique(sure).tolist() == [153, 230]
    assert np.unique(np.asarray(Image.open(tmp_path / "project" / (records["p3"].confidence or "")))).tolist() == [51]


def test_pixels_without_any_probability_are_void(tmp_path: Path) -> None:
    values = probabilities()
    values[:100] = 0
    np.save(tmp_path / "p.npy", values)
    ids = read_labels(tmp_path / "p.npy", ignore_id=255)
    assert (ids[:100] == 255).all()
    assert np.unique(ids[100:]).tolist() == [1, 2]


@pytest.mark.parametrize(
    ("values", "reason"),
    [(np.ones((4, 4), np.float32), "height × width × classes"), (np.full((4, 4, 3), 2.0), "0…1"),
     (np.full((4, 4, 2), np.nan), "0…1")],
)  # fmt: skip
def test_what_is_no_probability_map_is_refused(tmp_path: Path, values: np.ndarray, reason: str) -> None:
    np.save(tmp_path / "x.npy", values)
    with pytest.raises(InputError, match=reason):
        read_probabilities(tmp_path / "x.npy")
    (tmp_path / "y.npy").write_bytes(b"no array")
    with pytest.raises(InputError, match="cannot be read"):
        read_confidence(tmp_path / "y.npy")


def test_confidence_maps_of_sixteen_bits(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 65535, 32896]], np.uint16)).save(tmp_path / "c.png")
    assert read_confidence(tmp_path / "c.png").tolist() == [[0, 255, 128]]


def test_unsure_labels_pull_less() -> None:
    predicted = torch.tensor([[0.5, 0.5], [0.5, 0.5]], requires_grad=True)
    target, valid = torch.tensor([0, 1]), torch.tensor([True, True])
    semantic_loss(predicted, target, valid, torch.tensor([1.0, 0.25])).backward()
    assert predicted.grad is not None
    assert float(predicted.grad[1, 1] / predicted.grad[0, 0]) == pytest.approx(0.25)
    # certain labels are as labels without confidence
    plain = semantic_loss(predicted, target, valid)
    assert torch.equal(plain, semantic_loss(predicted, target, valid, torch.ones(2)))


def with_wrong_labels(folder: Path, unsure: bool) -> Path:
    """The ball with swapped labels in 9 of 16 views; `unsure`: with confidence 0 there."""
    ball_project(folder, 16, 32)
    project = load_project(folder)
    (folder / "confidence").mkdir()
    for number, record in enumerate(project.images):
        wrong = number % 8 not in (0, 3, 6) and number != 1
        if wrong:
            label = np.asarray(Image.open(folder / (record.label or "")))
            swapped = np.array([0, 2, 1], np.uint8)[label]
            Image.fromarray(swapped).save(folder / (record.label or ""))
        if unsure:
            sure = np.full((32, 32), 0 if wrong else 255, np.uint8)
            Image.fromarray(sure).save(folder / "confidence" / f"{record.name}.png")
            record.confidence = f"confidence/{record.name}.png"
    save_project(folder, project)
    return folder


def miou(folder: Path, steps: int = 800, **settings: str) -> float:
    values = {**SMALL, "loss.semantic_weight": "0.2", **{k.replace("__", "."): v for k, v in settings.items()}}
    run_verb("train", TrainParams(project=folder, preset="draft", steps=steps, set=values), Reporter())
    return run_verb("evaluate", EvaluateParams(project=folder), Reporter())["miou"]


@pytest.mark.slow
def test_confidence_protects_from_wrong_labels(tmp_path: Path) -> None:
    trusted = miou(with_wrong_labels(tmp_path / "trusted", unsure=False))
    doubted = miou(with_wrong_labels(tmp_path / "doubted", unsure=True))
    assert doubted > 0.8
    assert doubted > trusted + 0.3


@pytest.mark.slow
def test_scribbles_in_a_few_images_label_the_whole(tmp_path: Path) -> None:
    """Two short strokes in four of the images; the held-out labels stay whole."""
    folder = ball_project(tmp_path / "ball", 16, 40)
    scene = load_scene(folder)
    project = load_project(folder)
    for number, index in enumerate(scene.train):
        record = next(r for r in project.images if r.name == scene.views[index].name)
        if number % 4:
            record.label = None
            continue
        path = folder / (record.label or "")
        label = np.asarray(Image.open(path))
        kept = np.zeros_like(label)
        for row in np.linspace(0, 39, 12).astype(int):
            kept[row, 14:26] = label[row, 14:26]
        Image.fromarray(kept).save(path)
    save_project(folder, project)
    store = PixelStore(load_scene(folder), scene.train, [1, 2], np.eye(4), 400, torch.device("cpu"), Reporter())
    assert float((store.label != VOID).float().mean()) < 0.05
    assert make_config("draft").loss.semantic_weight > 0
    assert miou(folder) > 0.6
