"""Scraps are not shown as success: every stage judges what it made."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.evaluate.verb import evaluate
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.images.picture import Picture
from fieldwork.nerfcore.mesh.photos import Photo
from fieldwork.nerfcore.mesh.shown import shown_share
from fieldwork.nerfcore.mesh.verb import mesh
from fieldwork.nerfcore.mesh.visibility import PosedCamera
from fieldwork.nerfcore.params import EvaluateParams, MeshParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.render.image import Frame
from fieldwork.nerfcore.streams import print_json
from fieldwork.nerfcore.train.verb import train
from fieldwork.nerfcore.verdict import (
    evaluate_verdict,
    mesh_verdict,
    poses_verdict,
    train_verdict,
    verdict,
    worst,
)
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.reconstructed import triangle
from PIL import Image


def curve(*psnr: float) -> list[dict[str, float]]:
    return [{"step": i + 1, "psnr": value} for i, value in enumerate(np.interp(np.arange(100) / 99, [0, 0.5, 1], psnr))]


def test_the_worst_finding_comes_first() -> None:
    assert verdict([]) == {"level": "good", "reasons": []}
    assert verdict([("weak", "a"), ("failed", "b")]) == {"level": "failed", "reasons": ["b", "a"]}
    chain = {"poses": verdict([]), "train": verdict([("weak", "a")]), "new": None, "mesh": verdict([("failed", "b")])}
    assert worst(chain) == {"level": "failed", "reasons": ["mesh: b", "train: a"]}


def test_a_training_that_hardly_began() -> None:
    result = {"steps": 72, "seconds": 90.0, "psnr_train": 15.0}
    found = train_verdict(result, curve(8, 12, 15), warmup=256, steps=20000)
    assert found["level"] == "failed"
    assert all(words in found["reasons"][0] for words in ("72 steps", "256", "5 min", "6.9 h", "limit of time"))


def test_a_training_that_was_cut_off() -> None:
    result = {"steps": 3000, "seconds": 240.0, "psnr_train": 25.0}
    found = train_verdict(result, curve(10, 22, 26), 256, 20000)
    assert found["level"] == "weak"
    assert "4 min more" in found["reasons"][0]
    assert train_verdict(result, curve(10, 25, 25.5), 256, 20000)["level"] == "good"
    assert train_verdict({**result, "steps": 20000}, curve(10, 22, 26), 256, 20000)["level"] == "good"
    assert train_verdict({**result, "psnr_train": 5.8}, [], 256, 20000)["level"] == "failed"
    assert train_verdict({**result, "psnr_train": 16.0}, [], 256, 20000)["level"] == "weak"


def test_held_out_photos() -> None:
    good = {"split": "test", "psnr": 27.0, "opacity": 0.98, "depth_spread": 2.0, "miou": 0.8}
    assert evaluate_verdict(good, 29.0, opaque=True, labelled=True)["level"] == "good"
    for change, words, level in (
        ({"psnr": 9.0}, "do not resemble", "failed"),
        ({"psnr": 20.0}, "9.0 dB worse", "weak"),
        ({"opacity": 0.4}, "fog", "weak"),
        ({"opacity": 0.1}, "fog", "failed"),
        ({"depth_spread": 1.001}, "hardly differ", "weak"),
        ({"miou": 0.1}, "mIoU 0.10", "weak"),
    ):
        found = evaluate_verdict({**good, **change}, 29.0, opaque=True, labelled=True)
        assert found["level"] == level
        assert words in found["reasons"][0]
    assert (
        evaluate_verdict({**good, "opacity": 0.1, "miou": None}, 29.0, opaque=False, labelled=False)["level"] == "good"
    )
    before_sky = [evaluate_verdict({**good, "opacity": o}, 29.0, False, True, True) for o in (0.1, 0.001)]
    assert [found["level"] for found in before_sky] == ["good", "failed"]
    assert "empty" in before_sky[1]["reasons"][0]
    assert evaluate_verdict({**good, "split": "train", "psnr": 20.0}, 29.0, True, True)["level"] == "good"


@pytest.mark.parametrize(
    ("split", "compared", "words"),
    [("test", 1, "one photo was"), ("test", 2, "2 photos were"), ("test", 3, ""), ("train", 1, "")],
)
def test_figures_of_few_photos_say_so(split: str, compared: int, words: str) -> None:
    good = {"split": split, "psnr": 27.0, "opacity": 0.98, "depth_spread": 2.0, "miou": 0.8, "images": compared}
    found = evaluate_verdict(good, 29.0, opaque=True, labelled=True)
    assert found["level"] == "good"
    assert [words in reason for reason in found["reasons"]] == ([True] if words else [])
    coarse = evaluate_verdict({**good, "psnr": 9.0}, 29.0, opaque=True, labelled=True)
    assert coarse["level"] == "failed"
    assert "do not resemble" in coarse["reasons"][0]


def test_meshes_and_poses() -> None:
    assert [mesh_verdict(share)["level"] for share in (0.001, 0.05, 0.5)] == ["failed", "weak", "good"]
    assert [poses_verdict(n, 60)["level"] for n in (20, 49, 60)] == ["failed", "weak", "good"]
    assert "49 of 60" in poses_verdict(49, 60)["reasons"][0]


def test_photos_that_contradict_each_other() -> None:
    """Of two groups of ten, each of which agrees with itself, photos of one match three of the other wrongly; a single
    pair may be an accident, two of many as well."""
    good = [(f"good{i}", 9, 0) for i in range(20)]
    assert poses_verdict(20, 20, good)["level"] == "good"
    one = [("odd", 10, 1), ("even", 9, 1), *good]
    assert poses_verdict(22, 22, one)["level"] == "good"
    few = [("odd", 10, 1), ("even", 9, 1)]
    assert poses_verdict(22, 22, few)["level"] == "good"
    two = [("odd", 10, 2), ("even", 9, 2)]
    assert poses_verdict(22, 22, [*two, *good])["level"] == "weak"
    many = [(f"good{i}", 20, 0) for i in range(60)]
    assert poses_verdict(62, 62, [*two, *many])["level"] == "good"
    alike = [(f"alike{i}", 12, 3) for i in range(18)]
    found = poses_verdict(20, 20, [("fine", 9, 0), ("few", 1, 1), *alike[:17], ("worst", 12, 9), ("other", 14, 2)])
    assert found["level"] == "weak"
    (reason,) = found["reasons"]
    assert reason.startswith("31 of 120 pairs")
    assert "most often those of worst, alike0, alike1, alike2: parts that look alike" in reason


@pytest.mark.parametrize(("side", "share"), [(1.0, 0.25), (2.0, 1.0), (0.0, 0.0)])
def test_the_share_of_a_photo_that_shows_a_mesh(side: float, share: float) -> None:
    """A square before a camera whose view is 2 × 2 at its distance."""
    camera = Camera(width=100, height=100, fx=50, fy=50, cx=50, cy=50)
    photo = Photo(PosedCamera(camera, np.eye(4)), lambda: np.zeros((100, 100, 4), np.uint8))
    h = side / 2
    vertices = np.array([[-h, -h, 1], [h, -h, 1], [h, h, 1], [-h, h, 1]])
    faces = np.array([[0, 2, 1], [0, 3, 2]]) if side else np.zeros((0, 3), int)
    assert shown_share([photo], vertices, faces) == pytest.approx(share, abs=0.03)
    assert shown_share([photo], vertices, faces[:, ::-1]) == 0  # seen from behind


def test_scraps_are_told_at_the_command_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    project = ball_project(tmp_path / "p")
    settings = [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]
    assert main(["train", str(project), "--steps", "2", *settings, "--json", "--strict"]) == 3
    out, err = capfd.readouterr()
    answer = json.loads(out)
    assert answer["verdict"]["level"] == "failed"
    assert "Only 2 steps" in answer["verdict"]["reasons"][0]
    assert "Only 2 steps" in err
    assert main(["evaluate", str(project), "--json"]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert answer["verdict"]["level"] in ("weak", "failed")
    assert 0 <= answer["opacity"] <= 1


def test_a_mesh_of_scraps_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = ball_project(tmp_path / "p")
    train(TrainParams(project=project, preset="draft", steps=2, set=SMALL), Reporter())
    whole = triangle()
    scraps = replace(whole, vertices=whole.vertices * np.float32(0.01))
    monkeypatch.setattr("fieldwork.nerfcore.mesh.verb.build", lambda *_: scraps)
    result = mesh(MeshParams(project=project), Reporter())
    assert result["shown"] < 0.02
    assert result["verdict"]["level"] == "failed"
    assert "The mesh fills" in result["verdict"]["reasons"][0]


def test_what_is_judged_of_renders_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A field that is fog, with depths from 1 to 3 where it is not."""
    project = ball_project(tmp_path / "p")
    train(TrainParams(project=project, preset="draft", steps=2, set=SMALL), Reporter())

    def fog(model: object, camera: Camera, *_: object, **__: object) -> Frame:
        pixels = np.zeros((camera.height, camera.width, 4), np.float32)
        pixels[: camera.height // 4] = 0.8
        shape = pixels.shape[:2]
        depth = np.broadcast_to(np.linspace(1, 3, camera.width, dtype=np.float32), shape)
        return Frame(
            Picture(pixels, "srgb", "associated"), 1.0, depth, None, np.zeros((*shape, 3)), unknown=np.zeros(shape)
        )

    monkeypatch.setattr("fieldwork.nerfcore.evaluate.verb.render_view", fog)
    result = evaluate(EvaluateParams(project=project), Reporter())
    assert result["opacity"] == pytest.approx(0.2, abs=1e-4)
    assert result["depth_spread"] == pytest.approx(2.9 / 1.1, rel=0.01)


def test_photos_of_which_a_mask_leaves_nothing_are_not_compared(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    project = ball_project(tmp_path / "p")
    train(TrainParams(project=project, preset="draft", steps=2, set=SMALL), Reporter())
    hide(project, "08")
    assert main(["evaluate", str(project), "--json"]) == 0
    result = json.loads(capfd.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert result["images"] == 1
    assert result["psnr"] > 0
    assert any("08" in text for text in result["warnings"])
    hide(project, "00")
    with pytest.raises(InputError, match="leave nothing"):
        evaluate(EvaluateParams(project=project), Reporter())


def test_what_a_mask_leaves_out_counts_for_no_score(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Renders that are like the photos but for the left half, where a mask is black."""
    project = ball_project(tmp_path / "p")
    train(TrainParams(project=project, preset="draft", steps=2, set=SMALL), Reporter())
    photo = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    mask = np.repeat([[0, 255]], 20, axis=1).repeat(40, axis=0).astype(np.uint8)
    for name in ("00", "08"):
        hide(project, name)
        Image.fromarray(photo).save(project / "images" / f"{name}.png")
        Image.fromarray(mask).save(project / "masks" / f"{name}.png")

    def other_on_the_left(model: object, camera: Camera, *_: object, **__: object) -> Frame:
        pixels = np.ones((camera.height, camera.width, 4), np.float32)
        pixels[..., :3] = np.where(mask[..., None] > 0, photo, 255 - photo) / np.float32(255)
        depth, none = np.ones(mask.shape, np.float32), np.zeros((*mask.shape, 3))
        return Frame(Picture(pixels, "srgb", "associated"), 1.0, depth, None, none, unknown=np.zeros(mask.shape))

    monkeypatch.setattr("fieldwork.nerfcore.evaluate.verb.render_view", other_on_the_left)
    result = evaluate(EvaluateParams(project=project), Reporter())
    assert result["psnr"] > 90
    assert result["ssim"] > 0.75  # of the whole picture a third of that


def hide(project: Path, name: str) -> None:
    """Give a photo a mask that is black everywhere."""
    (project / "masks").mkdir(exist_ok=True)
    with edit_project(project) as edited:
        image = next(image for image in edited.images if image.name == name)
        image.mask = f"masks/{name}.png"
        Image.new("L", (image.width, image.height), 0).save(project / image.mask)


def test_results_on_stdout_are_json(capfd: pytest.CaptureFixture[str]) -> None:
    print_json({"a": [1.5, float("nan")], "ü": float("inf")}, sys.stdout)
    assert capfd.readouterr().out == '{"a": [1.5, null], "ü": null}\n'
