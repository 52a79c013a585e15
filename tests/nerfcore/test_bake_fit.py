"""Baked fields that are fitted to their photos."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.bake import class_votes, fit
from fieldwork.nerfcore.bake.blocks import Blocks, vertex_points
from fieldwork.nerfcore.data.pixels import VOID, Batch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.kernels.voxel_field import VERTICES, cell_length
from fieldwork.nerfcore.kernels.voxel_march import march
from fieldwork.nerfcore.params import BakeParams, EvaluateParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.baked import voxels_folder
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.live import shared_ball
from PIL import Image

from .test_voxel_march import even_field, random_rays, settings


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(shared_ball(tmp_path_factory), tmp_path_factory.mktemp("fit") / "p"))


def baked(project: Path, monkeypatch: pytest.MonkeyPatch, rounds: int) -> dict:
    """What is lost by a coarse baked field."""
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.FINEST", 8)
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.RAYS", 50_000)
    monkeypatch.setattr(fit, "ROUNDS", rounds)
    run_verb("bake", BakeParams(project=project, memory=20), Reporter())
    return run_verb("evaluate", EvaluateParams(project=project, baked=True), Reporter())["lost"]


@pytest.mark.slow
def test_a_coarse_grid_loses_less_when_it_is_fitted(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, fitted = (baked(trained, monkeypatch, rounds) for rounds in (0, 4))
    print("lost, read and fitted:", read, fitted)
    assert fitted["psnr"] < read["psnr"] - 0.3
    assert fitted["miou"] < read["miou"] + 0.005


@pytest.mark.slow
def test_masked_pixels_leave_no_trace(trained: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Photos whose masked half is painted over after the training give the same baked field."""
    from fieldwork.nerfcore.project.store import load_project, save_project

    project = load_project(trained)
    (trained / "masks").mkdir(exist_ok=True)
    half = np.zeros((40, 40), np.uint8)
    half[:, :20] = 255
    for image in project.images:
        Image.fromarray(half).save(trained / "masks" / f"{image.name}.png")
        image.mask = f"masks/{image.name}.png"
    save_project(trained, project)
    found = []
    for paint in (False, True):
        if paint:
            for image in project.images:
                pixels = np.asarray(Image.open(trained / image.file)).copy()
                pixels[:, 20:] = (0, 255, 0, 255)
                Image.fromarray(pixels).save(trained / image.file)
        baked(trained, monkeypatch, 1)
        found.append(np.load(voxels_folder(trained, "main") / "T0.npy"))
    assert np.array_equal(*found)


def batch(colors: torch.Tensor, image: torch.Tensor) -> Batch:
    origins, directions = random_rays(len(colors))
    one, number = torch.ones(len(colors)), torch.zeros(len(colors), dtype=torch.long)
    return Batch(origins, directions, colors, one, number, image, number, one, one)


def test_photos_are_taken_as_bright_as_the_field_shows_them() -> None:
    field, here = even_field(200, torch.ones(8, 8, 8).nonzero()), settings(False)
    image = torch.arange(9000) % 3
    rays = batch(torch.zeros(9000, 3), image)
    seen = march(rays.origins, rays.directions, field, here)
    background = torch.full((9000, 3), 0.5)
    shown = seen.color + (1 - seen.opacity)[:, None] * background
    darker = torch.tensor([1.0, 0.7, 0.4])
    gains = fit.exposures(field, batch(shown * darker[image][:, None], image), background, here, 3)
    assert torch.allclose(gains[:2], (1 / darker[:2])[:, None].expand(2, 3), atol=0.03)
    assert torch.allclose(gains[2], torch.tensor(fit.EXPOSURES[1]), atol=1e-6), "no photo counts for more than that"


class Labelled:
    """Pixels whose rays meet the side x = −1 of the cube: class 1 where y < 0, else 2."""

    def __init__(self, label: int | None = None, confidence: float = 1.0) -> None:
        generator = torch.Generator().manual_seed(3)
        self.origins = torch.rand(3000, 3, generator=generator) * 1.9 - 0.95
        self.origins[:, 0] = -3
        self.label = torch.where(self.origins[:, 1] < 0, 1, 2) if label is None else torch.full((3000,), label)
        self.confidence = torch.full((3000,), confidence)

    def __len__(self) -> int:
        return len(self.origins)

    def random_pixels(self, count: int, generator: torch.Generator) -> torch.Tensor:
        return torch.randint(0, len(self), (count,), generator=generator)

    def batch(self, pixels: torch.Tensor) -> Batch:
        along = torch.tensor([1.0, 0.0, 0.0]).expand(len(pixels), 3).contiguous()
        one = torch.ones(len(pixels))
        label, confidence = self.label[pixels], self.confidence[pixels]
        return Batch(self.origins[pixels], along, one[:, None].expand(-1, 3), one, label, label, label, confidence, one)


def voted(photos: Labelled) -> tuple[torch.Tensor, torch.Tensor]:
    """Places (N, 3) in the cube of the vertices of an opaque one, and their classes (N, 3), read as 0 with 0.6 and else 3."""
    side = 2
    places = torch.ones(side, side, side).nonzero()
    blocks = Blocks(side, places, torch.full((len(places) * VERTICES**3,), 255, dtype=torch.uint8))
    texels = torch.zeros(len(blocks.roots), 2, 4, dtype=torch.uint8)
    texels[:, 1, :3] = torch.tensor([0, 153, 3])
    step = replace(settings(False), resolution=8 * side, step=cell_length(side, False))
    class_votes.vote(blocks, texels, 4, photos, step, lambda: None)  # pyright: ignore[reportArgumentType]
    return vertex_points(places, side) * 2 - 1, texels[:, 1, :3].long()


def test_vertices_take_the_classes_of_the_labels_they_are_seen_with() -> None:
    place, found = voted(Labelled())
    front, inner = place[:, 0] < -0.999, place[:, 0] > -0.7
    within = (place[:, 1:].abs() < 0.9).all(1)
    for chosen, label in ((place[:, 1] < -0.1, 1), (place[:, 1] > 0.1, 2)):
        seen = found[front & within & chosen]
        assert len(seen) > 50
        assert (seen[:, 0] == label).all()
        assert (seen[:, 1] > 153).all()
        assert (seen[:, 2] == 0).all(), "what was read comes after it"
    between = found[front & within & (place[:, 1] == 0)]
    assert ((between[:, 0] > 0) & (between[:, 2] > 0) & (between[:, 1] < 200)).all(), "on the border both have a part"
    assert (found[inner] == torch.tensor([0, 153, 3])).all(), "what no ray meets is as it was read"
    # Blocks that share a vertex say the same of it.
    twice = (front & (place[:, 1] == 0) & (place[:, 2] == 0)).nonzero()[:, 0]
    assert len(twice) == 4
    assert (found[twice] == found[twice[0]]).all()


@pytest.mark.parametrize("photos", [Labelled(label=VOID), Labelled(confidence=0.0)])
def test_pixels_without_a_sure_label_change_nothing(photos: Labelled) -> None:
    _, found = voted(photos)
    assert (found == torch.tensor([0, 153, 3])).all()


def test_vertices_between_blocks_are_one() -> None:
    places = torch.tensor([[1, 1, 1], [2, 1, 1], [5, 5, 5]])
    blocks = Blocks(8, places, torch.zeros(3 * VERTICES**3, dtype=torch.uint8))
    same, count = fit.shared_vertices(blocks)
    assert count == 3 * VERTICES**3 - VERTICES**2
    cubes = same.view(3, VERTICES, VERTICES, VERTICES)
    assert torch.equal(cubes[0, :, :, -1], cubes[1, :, :, 0])


def test_a_cancel_is_heard(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report, plain = Reporter(), fit.exposures

    def cancelled(*arguments):
        report.cancel()
        return plain(*arguments)

    monkeypatch.setattr(fit, "exposures", cancelled)
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.FINEST", 8)
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.RAYS", 5_000)
    with pytest.raises(Cancelled):
        run_verb("bake", BakeParams(project=trained), report)
