"""Image-space initialisation: who sees what, what is written, and how training takes it up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.errors import Cancelled, InputError
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.run import PIXEL_FEATURES, read_checkpoint
from fieldwork.nerfcore.train.voxel_init import (
    GAIN,
    Sighting,
    dense_levels,
    initialise,
    reduce_photos,
    sightings,
    statistics,
)
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.settings import trainer_of
from fieldwork.tests.nerfcore.test_rendering import RADIUS, ball_model

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("init") / "ball")


def test_a_photo_sees_the_near_side_of_a_ball_and_not_the_far_one(ball: Path) -> None:
    scene = load_scene(ball)
    store = PixelStore(scene, list(range(16)), [1, 2], np.eye(4), 40, CPU, Reporter())
    model = ball_model(16)
    model.field.strength = 500.0
    photos = reduce_photos(model, store, lambda: None)
    generator = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=1)
    points = normal * RADIUS
    found = sightings(photos, points, torch.full((2000,), 0.06))
    for index, sighting in enumerate(found):
        towards = torch.nn.functional.normalize(store.rays.center[index] - points, dim=1)
        facing = (normal * towards).sum(1)
        seen = torch.zeros(2000, dtype=torch.bool)
        seen[sighting.vertex] = True
        assert seen[facing > 0.25].float().mean() > 0.98
        assert not seen[facing < -0.4].any()  # in between, a pixel of the silhouette shows what is beside the ball
    # Through empty space everything in the picture is seen.
    model.field.strength = 0.0
    free = sightings(reduce_photos(model, store, lambda: None), points, torch.full((2000,), 0.06))
    assert len(free[0].vertex) > 1.6 * len(found[0].vertex)


def test_statistics_are_mean_and_variance_over_the_photos_that_see_a_vertex() -> None:
    features = [torch.full((3, 1, 2), value) for value in (0.2, 0.4, 0.9)]
    features[0][:, 0, 1] = torch.tensor([1.0, 0.0, 0.5])
    one = torch.tensor([0])
    seen = [Sighting(torch.tensor([0, 1]), torch.tensor([0, 1])), Sighting(one, one), Sighting(torch.tensor([1]), one)]
    found = statistics(features, seen, 4)
    mean = torch.tensor([[0.3, 0.3, 0.3], [0.95, 0.45, 0.7]])
    variance = torch.tensor([[0.01], [(0.05**2 + 0.45**2 + 0.2**2) / 3]])
    both = torch.cat([mean, variance], 1)
    assert torch.allclose(found[:2], (both - both.mean(0)) / both.std(0, correction=0), atol=1e-3)
    assert not found[2:].any()
    assert not statistics(features, [seen[1]], 4).any()  # one photo has no variance


@pytest.mark.parametrize("kind", ["rgb_stats", pytest.param("cnn", marks=pytest.mark.slow)])
def test_only_seen_vertices_of_dense_levels_are_written(ball: Path, kind: str) -> None:
    trainer = trainer_of(ball, **{"field.voxel_init": kind, "field.voxel_init_step": "20"})
    for _ in range(20):
        trainer.step(0.1)
    grid = trainer.model.field.grid
    assert grid is not None
    levels = dense_levels(grid)
    assert 0 < len(levels) < len(grid.levels)
    before = grid.table.clone()

    def learn() -> None:
        trainer._take(trainer._learn(0.1))

    network = initialise(trainer.model, trainer.store, learn, lambda: None)
    assert (network is None) == (kind == "rgb_stats")
    change = grid.table - before
    dense = torch.zeros(len(change), dtype=torch.bool)
    for resolution, first in levels:
        dense[first : first + resolution**3] = True
        written = change[first : first + resolution**3]
        moved = written.abs().sum(1) > 0
        assert moved.float().mean() > 0.05
        assert torch.allclose(written[moved].std(0, correction=0), torch.full((4,), GAIN), rtol=0.05)
    assert not change[~dense].any()
    assert not grid.gradient.any()
    assert not grid.touched.any()


@pytest.mark.slow
def test_a_network_learns_features_that_lower_the_loss(ball: Path) -> None:
    trainer = trainer_of(ball, **{"field.voxel_init": "cnn", "field.voxel_init_step": "1000"})
    for _ in range(60):
        trainer.step(0.1)

    def learn() -> None:
        trainer._take(trainer._learn(0.1))

    def loss() -> float:
        trainer.generator.manual_seed(5)
        trainer.take_measured()
        for _ in range(6):
            learn()
        return float(trainer.measured.loss)

    before = loss()
    initialise(trainer.model, trainer.store, learn, lambda: None)
    assert loss() < before


def test_a_stopped_initialisation_leaves_the_grid_as_it_was(ball: Path) -> None:
    trainer = trainer_of(ball, **{"field.voxel_init": "cnn", "field.voxel_init_step": "1000"})
    for _ in range(20):
        trainer.step(0.1)
    grid = trainer.model.field.grid
    assert grid is not None
    before, left = grid.table.clone(), [40]

    def check() -> None:
        left[0] -= 1
        if left[0] < 0:
            raise Cancelled

    with pytest.raises(Cancelled):
        initialise(trainer.model, trainer.store, lambda: trainer._take(trainer._learn(0.1)), check)
    assert torch.equal(grid.table, before)


def train(project: Path, run: str, steps: int, resume: bool = False, report: Reporter | None = None, **settings: str):
    values = {**SMALL, "field.voxel_init_step": "12", **{k.replace("__", "."): v for k, v in settings.items()}}
    params = TrainParams(project=project, preset="draft", run=run, steps=steps, set=values, resume=resume)
    run_verb("train", params, report or Reporter())
    return read_checkpoint(project / "runs" / run / "field.safetensors", CPU)[0]


@pytest.mark.setting("field.voxel_init", "field.voxel_init_step")
@pytest.mark.parametrize("kind", ["rgb_stats", pytest.param("cnn", marks=pytest.mark.slow)])
def test_a_run_that_stops_before_its_initialisation_catches_up_on_it(ball: Path, kind: str) -> None:
    whole = train(ball, "whole", 20, field__voxel_init=kind)
    plain = train(ball, "plain", 20)
    assert not torch.equal(whole["model.field.grid.table"], plain["model.field.grid.table"])

    class StopAt(Reporter):
        left = 14 + 8  # a check for each photo, then one a step

        def check(self) -> None:
            self.left -= 1
            if self.left < 0:
                raise Cancelled

    with pytest.raises(Cancelled):
        train(ball, "parts", 20, report=StopAt(), field__voxel_init=kind)
    parts = train(ball, "parts", 20, resume=True)
    assert [name for name in whole if not torch.equal(whole[name], parts[name])] == []


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"field__voxel_init_step": "4"}, "ends after 4 steps, before step 4"),
        ({"field__branch": "implicit"}, "no level of the grid"),
        ({"field__coarsest": "40", "field__table_log2": "10"}, "no level of the grid"),
        ({"field__voxel_init_step": "3"}, None),
    ],
)
def test_an_initialisation_without_effect_is_told(ball: Path, settings: dict[str, str], words: str | None) -> None:
    report = Reporter()
    train(ball, "useless", 4, report=report, **{"field__voxel_init": "rgb_stats", **settings})
    told = [warning for warning in report.warnings if "voxel_init has no effect" in warning]
    assert len(told) == (words is not None)
    assert words is None or words in told[0]


@pytest.mark.slow
@pytest.mark.setting("field.voxel_init_weights")
def test_weights_of_one_run_serve_another_and_missing_ones_are_named(ball: Path) -> None:
    train(ball, "first", 14, field__voxel_init="cnn")
    weights = ball / "runs" / "first" / PIXEL_FEATURES
    assert weights.is_file()
    again = train(ball, "second", 14, field__voxel_init="cnn", field__voxel_init_weights=str(weights))
    plain = train(ball, "plain", 14)
    assert not torch.equal(again["model.field.grid.table"], plain["model.field.grid.table"])
    with pytest.raises(InputError, match=r"nothing\.safetensors"):
        train(ball, "third", 14, field__voxel_init="cnn", field__voxel_init_weights=str(ball / "nothing.safetensors"))
