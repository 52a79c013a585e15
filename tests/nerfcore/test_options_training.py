"""Each setting of `scene`, `loss` and `train` changes what its description says."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import LossConfig, SceneConfig
from fieldwork.nerfcore.data.box import choose_box
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import VOID
from fieldwork.nerfcore.errors import TrainingError
from fieldwork.nerfcore.field.encoding import spherical_harmonics
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.similarity import similarity_scale
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.render.image import background_of
from fieldwork.nerfcore.render.run import CPU_IMAGE_SIZE, GPU_IMAGE_SIZE, RunInfo
from fieldwork.nerfcore.train import losses, verb
from fieldwork.nerfcore.train import trainer as trainer_module
from fieldwork.nerfcore.train.composite_loss import composite_loss
from fieldwork.nerfcore.train.prepare import pixels_across, plan_run
from fieldwork.nerfcore.train.schedule import bias_correction
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.settings import config_of, trainer_of
from fieldwork.tests.nerfcore.test_visibility import ball as points_on_a_ball
from fieldwork.tests.nerfcore.test_visibility import half_ring
from fieldwork.tests.nerfcore.test_visibility import scene as scene_of
from PIL import Image


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("training") / "ball", views=9, side=24)


def planned(project: Path, device: str = "cpu", **settings: str) -> RunInfo:
    return plan_run(project, "draft", config_of(**settings), torch.device(device))[0]


# scene


def test_the_finest_level_has_a_vertex_for_each_pixel_of_a_panorama(ball: Path) -> None:
    scene, box = load_scene(ball), choose_box(load_scene(ball), SceneConfig(), True)
    lens = scene.views[0].camera
    width = round(2 * math.pi * lens.fx)  # as many pixels for an angle as the photos have
    around = Camera(model="EQUIRECTANGULAR", width=width, height=width // 2, fx=width / 2, fy=width / 2, cx=0, cy=0)
    panoramas = replace(scene, views=[replace(view, camera=around) for view in scene.views])
    across = [pixels_across(s, scene.train, box, 4096) for s in (scene, panoramas)]
    assert across[1] == pytest.approx(across[0], rel=0.01)


@pytest.mark.setting("scene.contraction")
def test_all_of_space_is_contracted_or_not(ball: Path) -> None:
    assert not planned(ball).contracted  # transparent photos: nothing is outside
    assert planned(ball, **{"scene.contraction": "on"}).contracted
    around = scene_of(half_ring(7, 3.0), points_on_a_ball(500, 2.9))
    assert choose_box(around, SceneConfig(), False).contracted
    assert not choose_box(around, SceneConfig(contraction="off"), False).contracted


@pytest.mark.setting("scene.image_size")
def test_photos_are_reduced_to_the_size_asked_for(ball: Path) -> None:
    trainer = trainer_of(ball, **{"scene.image_size": "32"})
    assert {camera.width for camera in trainer.store.cameras} == {24}  # never enlarged
    trainer = trainer_of(ball, **{"train.view_share": "0.3"})
    trainer.config.scene.image_size = 32
    large = ball_project(ball.parent / "large", views=4, side=64)
    assert {c.width for c in trainer_of(large, **{"scene.image_size": "32"}).store.cameras} == {32}
    assert planned(ball).image_size == CPU_IMAGE_SIZE
    assert planned(ball, "cuda").image_size == GPU_IMAGE_SIZE


@pytest.mark.setting("scene.background")
def test_the_background_of_training_and_of_pictures(ball: Path) -> None:
    learned, grey = [], []
    for choice in ("auto", "random", "white", "black"):
        settings = {"scene.background": choice}
        learned.append(trainer_of(ball, **settings).background)
        grey.append(background_of(planned(ball, **settings)))
    assert learned == [None, None, 1.0, 0.0]
    assert grey == [1.0, 1.0, 1.0, 0.0]


@pytest.mark.setting("scene.background")
def test_white_photos_are_learned_on_white(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What shows in empty pixels is the background that pictures will have."""
    prices = {}
    for choice in ("white", "black"):
        trainer = trainer_of(ball, **{"scene.background": choice})
        empty = (trainer.store.rgba[:, 3] == 0).nonzero()[:64, 0]
        batch = trainer.store.batch(empty)
        seen: list[torch.Tensor] = []

        def spy(part: Any, rendered: Any, background: torch.Tensor, *rest: Any, _seen=seen) -> Any:
            _seen.append(background)
            return composite_loss(part, rendered, background, *rest)

        monkeypatch.setattr(trainer_module, "composite_loss", spy)
        trainer.draw = lambda _batch=batch: _batch
        trainer._take(trainer._learn(0.0))
        prices[choice] = float(torch.cat(seen).mean())
    assert prices == {"white": 1.0, "black": 0.0}


@pytest.mark.setting("scene.margin")
def test_the_margin_enlarges_the_box(ball: Path) -> None:
    sizes = [
        similarity_scale(np.array(planned(ball, **{"scene.margin": margin}).sfm_from_box)) for margin in ("1", "1.5")
    ]
    assert sizes[1] == pytest.approx(1.5 * sizes[0])


# loss


@pytest.mark.setting("loss.rgb", "loss.huber_delta")
def test_colour_errors_are_squared_or_bounded() -> None:
    zero = torch.zeros(1, 3)

    def price(error: float, **settings: Any) -> float:
        return float(losses.color_loss(zero + error, zero, LossConfig(**settings)))

    assert price(0.4, rgb="mse") == pytest.approx(4 * price(0.2, rgb="mse"))
    assert price(0.4, huber_delta=0.1) - price(0.3, huber_delta=0.1) == pytest.approx(0.1, rel=1e-4)
    assert price(0.04, huber_delta=0.1) == pytest.approx(4 * price(0.02, huber_delta=0.1))
    assert price(0.4, huber_delta=0.5) < price(0.4, huber_delta=0.1)


@pytest.mark.setting("loss.rgb_warmup")
def test_colour_errors_are_squared_in_the_first_steps(ball: Path) -> None:
    still = {"train.network_rate": "1e-9", "train.grid_rate": "1e-9", "loss.semantic_weight": "0"}
    prices = {}
    for warmup in (2, 0):
        trainer = trainer_of(ball, **still, **{"loss.rgb_warmup": str(warmup)})
        prices[warmup] = []
        for _ in range(3):
            trainer.step(0.0)
            prices[warmup].append(float(trainer.take_measured().loss))
    assert prices[2][0] > 1.2 * prices[0][0]  # large errors cost more squared
    assert prices[2][1] > 1.2 * prices[0][1]
    assert prices[2][2] == pytest.approx(prices[0][2], rel=1e-3)


@pytest.fixture(scope="module")
def priced(ball: Path) -> Callable[..., float]:
    """The loss of one rendered batch, with some settings of `loss` changed; without the distortion loss."""
    trainer = trainer_of(ball, **{"loss.distortion_weight": "0"})
    for _ in range(40):
        trainer.step(0.0)
    batch = trainer.store.batch(torch.arange(0, len(trainer.store), 7))
    rendered = trainer._render(batch, torch.full((len(batch.rgb),), 0.5), torch.full((len(batch.rgb) * 12,), 0.5))
    assert bool((batch.label != VOID).any())

    def price(progress: float = 1.0, **changes: Any) -> float:
        config = trainer.config.loss.model_copy(update=changes)
        total, _ = composite_loss(batch, rendered, torch.ones_like(batch.rgb), progress, config, trainer.model)
        return float(total.detach())

    return price


@pytest.mark.setting(
    "loss.rgb_weight",
    "loss.semantic_weight",
    "loss.distortion_weight",
    "loss.opacity_weight",
    "loss.entropy_ratio",
    "loss.regularization",
)
@pytest.mark.parametrize(
    ("name", "unit", "sign"),
    [
        ("rgb_weight", 1.0, 1),
        ("semantic_weight", 0.1, 1),
        ("distortion_weight", 1.0, 1),
        ("opacity_weight", 1.0, 1),
        ("entropy_ratio", 1.0, -1),  # the entropy is raised
        ("regularization", 1.0, -1),
    ],
)
def test_each_term_counts_in_proportion_to_its_weight(
    priced: Callable[..., float], name: str, unit: float, sign: int
) -> None:
    prices = [priced(**{name: factor * unit}) for factor in (0, 1, 2)]
    assert sign * (prices[1] - prices[0]) > 1e-5
    assert prices[2] - prices[1] == pytest.approx(prices[1] - prices[0], rel=1e-2)


@pytest.mark.setting("loss.entropy_start")
def test_the_entropy_term_begins_when_told(priced: Callable[..., float]) -> None:
    without = priced(entropy_ratio=0.0)
    assert priced(0.29, entropy_start=0.3, entropy_ratio=1.0) == without
    assert priced(0.31, entropy_start=0.3, entropy_ratio=1.0) < without


@pytest.mark.setting("loss.distortion_start")
def test_the_distortion_term_begins_when_told(priced: Callable[..., float]) -> None:
    without = priced(distortion_weight=0.0)
    assert priced(0.29, distortion_start=0.3, distortion_weight=1.0) == without
    assert priced(0.31, distortion_start=0.3, distortion_weight=1.0) > without


@pytest.mark.setting("loss.semantic_weight")
def test_without_semantics_there_are_no_classes(ball: Path) -> None:
    trainer = trainer_of(ball, **{"loss.semantic_weight": "0"})
    assert trainer.model.field.semantic_head is None
    assert planned(ball, **{"loss.semantic_weight": "0"}).class_ids == []


def test_more_classes_than_labels_can_hold_are_refused(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball", views=3, side=32)
    saved = load_project(project)
    saved.classes = [SemanticClass(id=i, name=f"class {i}", color=(0.5, 0.5, 0.5)) for i in range(1, 257)]
    save_project(project, saved)
    every = 1 + np.arange(32 * 32).reshape(32, 32) % 256
    for path in (project / "labels").iterdir():
        Image.fromarray(every.astype(np.uint16)).save(path)
    with pytest.raises(TrainingError, match="hold 256 classes; a field tells at most 255 apart"):
        planned(project)
    assert planned(project, **{"loss.semantic_weight": "0"}).class_ids == []
    saved.classes.pop()
    save_project(project, saved)
    assert len(planned(project).class_ids) == 255


@pytest.mark.setting("loss.sparsity_weight", "loss.sparsity", "loss.sparsity_scale")
def test_density_at_random_points_has_a_price(ball: Path) -> None:
    def price(**settings: str) -> float:
        trainer = trainer_of(ball, **{f"loss.{name}": value for name, value in settings.items()})
        trainer._take(trainer._learn(0.0))
        return float(trainer.measured.loss)

    free = price(sparsity_weight="0")
    once, twice = (price(sparsity_weight=w) - free for w in ("0.5", "1"))
    assert once > 1e-3
    assert twice == pytest.approx(2 * once, rel=1e-3)
    assert price(sparsity_weight="0.5", sparsity_scale="0.1") - free == pytest.approx(2 * once, rel=0.1)
    density = torch.tensor([0.5, 3.0])
    expected = {
        "exponential": (1 - torch.exp(-0.05 * density)).mean(),
        "cauchy": torch.log(1 + 2 * density**2).mean(),
        "l1": density.mean(),
    }
    for kind, value in expected.items():
        assert float(losses.sparsity_loss(density, LossConfig(sparsity=kind))) == pytest.approx(float(value))  # type: ignore[arg-type]


# train


@pytest.mark.setting("train.steps")
def test_a_run_without_limits_has_the_steps_of_its_settings(ball: Path) -> None:
    params = TrainParams(project=ball, preset="draft", run="steps", set={**SMALL, "train.steps": "7"})
    assert run_verb("train", params, Reporter())["steps"] == 7


@pytest.mark.slow
@pytest.mark.setting("train.batch_start", "train.batch_samples", "train.max_rays")
def test_batches_grow_from_one_size_to_the_other_and_stay_below_the_most_rays(ball: Path) -> None:
    def samples(progress: float, **settings: str) -> float:
        trainer = trainer_of(ball, **{f"train.{name}": value for name, value in settings.items()})
        for _ in range(24):
            trainer.step(progress)
        trainer.take_measured()
        for _ in range(8):
            trainer.step(progress)
        measured = trainer.take_measured()
        return measured.samples / measured.steps

    sizes = {"batch_start": "1000", "batch_samples": "4000"}
    assert samples(0.0, **sizes) == pytest.approx(1000, rel=0.15)
    assert samples(0.5, **sizes) == pytest.approx(2000, rel=0.15)
    assert samples(1.0, **sizes) == pytest.approx(4000, rel=0.15)
    assert samples(1.0, **sizes, max_rays="64") <= 64 * 12


@pytest.mark.setting("train.grid_rate", "train.network_rate", "train.decay")
def test_first_steps_are_as_long_as_the_rates(ball: Path) -> None:
    trainer = trainer_of(ball, **{"train.grid_rate": "0.02", "train.network_rate": "0.003", "train.decay": "0.5"})
    grid, weight = trainer.model.field.grid, trainer.model.field.density_head.weights[0]
    assert grid is not None
    before = grid.table.clone(), weight.detach().clone()
    trainer.step(0.8)  # past ½ and ¾
    moved = float((grid.table - before[0]).abs().max()), float((weight.detach() - before[1]).abs().max())
    assert bias_correction(1) == pytest.approx(1.0)
    assert moved[0] == pytest.approx(0.02 * 0.5**2, rel=0.02)
    assert moved[1] == pytest.approx(0.003 * 0.5**2, rel=0.02)


def test_training_begins_with_colours_that_are_the_same_from_everywhere(ball: Path) -> None:
    ways = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=1)

    @torch.no_grad()
    def spread(trainer: Trainer) -> float:
        """The largest difference of the colours that a point has in many directions."""
        field = trainer.model.field
        color = field.color(field.geometry(torch.full((64, 3), 0.5)), spherical_harmonics(ways))
        return float((color.amax(0) - color.amin(0)).max())

    trainer = trainer_of(ball)
    assert spread(trainer) == 0
    for _ in range(3):
        trainer.step(0.0)
    assert spread(trainer) > 1e-3


@pytest.mark.setting("train.pose_rate")
def test_cameras_move_at_their_rate(ball: Path) -> None:
    moved = {}
    for rate in ("0.001", "0.01"):
        trainer = trainer_of(ball, **{"train.refine_poses": "true", "train.pose_start": "0", "train.pose_rate": rate})
        trainer.step(0.0)
        assert trainer.poses is not None
        moved[rate] = float(trainer.poses.correction.detach().abs().max())
    assert moved["0.01"] == pytest.approx(10 * moved["0.001"], rel=0.1)
    assert trainer_of(ball).poses is None


@pytest.mark.setting("train.checkpoint_every", "train.preview_every")
def test_checkpoints_and_previews_come_as_often_as_asked(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[int] = []
    original = verb.save_checkpoint

    def save(path: Path, trainer: Trainer, state: dict) -> None:
        saved.append(trainer.steps)
        original(path, trainer, state)

    class Listener(Reporter):
        def __init__(self) -> None:
            super().__init__()
            self.previews = 0

        def event(self, kind: str, **data: Any) -> None:
            self.previews += kind == "preview"

    def run(name: str, report: Reporter, seconds: str) -> None:
        values = {**SMALL, "train.checkpoint_every": seconds, "train.preview_every": seconds}
        run_verb("train", TrainParams(project=ball, preset="draft", run=name, steps=10, set=values), report)

    monkeypatch.setattr(verb, "save_checkpoint", save)
    monkeypatch.setattr(verb, "PREVIEW_PAUSE", 0)
    often, rarely = Listener(), Listener()
    run("often", often, "0.001")
    assert saved == [*range(1, 11), 10]  # after every step, and at the end
    assert often.previews == 10
    saved.clear()
    run("rarely", rarely, "1000")
    assert saved == [10]
    assert rarely.previews == 0


@pytest.mark.setting("train.seed")
def test_a_seed_repeats_a_run_and_another_one_does_not(ball: Path) -> None:
    tables = []
    for seed in ("3", "3", "4"):
        trainer = trainer_of(ball, **{"train.seed": seed})
        for _ in range(3):
            trainer.step(0.0)
        assert trainer.model.field.grid is not None
        tables.append(trainer.model.field.grid.table)
    assert torch.equal(tables[0], tables[1])
    assert not torch.equal(tables[0], tables[2])


@pytest.mark.setting("train.labelled_share", "train.label_noise", "train.noise", "train.view_share")
def test_photos_and_labels_are_spoiled_as_much_as_asked(ball: Path) -> None:
    clean = trainer_of(ball).store
    labelled = clean.label != VOID
    assert bool((trainer_of(ball, **{"train.labelled_share": "0"}).store.label == VOID).all())
    half = trainer_of(ball, **{"train.labelled_share": "0.5"}).store
    with_labels = [bool((half.label[a:b] != VOID).any()) for a, b in zip(half.first[:-1], half.first[1:])]
    assert sum(with_labels) == round(0.5 * len(clean.views))
    noisy = trainer_of(ball, **{"train.label_noise": "0.4"}).store
    changed = float((noisy.label != clean.label)[labelled].float().mean())
    assert changed == pytest.approx(0.4 / 2, abs=0.04)  # half of the random labels are right by chance
    assert torch.equal(noisy.label[~labelled], clean.label[~labelled])
    grainy = trainer_of(ball, **{"train.noise": "0.05"}).store
    middle = ((clean.rgba[:, :3] > 60) & (clean.rgba[:, :3] < 195)).all(1)
    error = (grainy.rgba[middle, :3].float() - clean.rgba[middle, :3].float()).std() / 255
    assert float(error) == pytest.approx(0.05, rel=0.1)
    assert torch.equal(grainy.rgba[:, 3], clean.rgba[:, 3])
    assert len(trainer_of(ball, **{"train.view_share": "0.5"}).store.views) == math.ceil(0.5 * len(clean.views))
