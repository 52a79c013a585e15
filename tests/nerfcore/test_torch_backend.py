"""Training through the torch backend, as on ROCm and MPS, on CPU tensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.evaluate.refit import refit_camera
from fieldwork.nerfcore.film import training_view
from fieldwork.nerfcore.film.fields import described
from fieldwork.nerfcore.kernels import runtime
from fieldwork.nerfcore.kernels.device import Kernels, using_kernels
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.fused import unsupported
from fieldwork.nerfcore.train.pose_refinement import write_poses
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import config_of, trainer_of
from fieldwork.tests.nerfcore.support.sky import under_the_sky
from fieldwork.tests.nerfcore.support.viewing import perspective
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_project(tmp_path_factory.mktemp("torch") / "ball", views=9, side=32)


class DoublePrecision(TorchDispatchMode):
    """Lists the operations that give float64, which Apple's GPUs do not have."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if any(isinstance(x, torch.Tensor) and x.dtype == torch.float64 and x.dim() > 0 for x in tree_leaves(out)):
            self.found.append(func.overloadpacket.__name__)
        return out


class AwayFromTheHost(TorchFunctionMode):
    """Lets no tensor become float64 before it was brought to the host, as if all were on a device that has none."""

    def __init__(self) -> None:
        super().__init__()
        self.here: list[torch.Tensor] = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func is torch.Tensor.double and not any(args[0] is x for x in self.here):
            raise TypeError("the device has no float64")
        out = func(*args, **(kwargs or {}))
        if func is torch.Tensor.cpu:
            self.here.append(out)
        return out


def train(project: Path, kernels: Kernels, steps: int, **settings: str) -> Trainer:
    with using_kernels(kernels):
        trainer = trainer_of(project, **settings)
        for step in range(steps):
            trainer.step(step / steps)
        return trainer


@pytest.mark.slow
def test_the_torch_backend_trains_as_well_as_warp(ball: Path) -> None:
    found = {}
    for kernels in ("warp", "torch"):
        trainer = train(ball, kernels, 160)
        trainer.take_measured()
        with using_kernels(kernels):
            for _ in range(10):
                trainer.step(1.0)
        found[kernels] = trainer.take_measured().psnr
    assert found["warp"] > 17
    assert found["torch"] == pytest.approx(found["warp"], abs=0.7)


@pytest.mark.parametrize(
    "settings",
    [
        {"loss.distortion_start": "0", "loss.opacity_weight": "0.01", "sampling.outline_rays": "0.3"},
        pytest.param(
            {"train.refine_poses": "true", "train.pose_start": "0", "scene.contraction": "on"}, marks=pytest.mark.slow
        ),
        pytest.param(
            {"field.fusion": "blend", "sampling.importance": "boundary", "sampling.pdf": "literal"},
            marks=pytest.mark.slow,
        ),
        pytest.param({"scene.background": "environment", "scene.contraction": "on"}, marks=pytest.mark.slow),
    ],
    ids=["losses", "poses", "literal", "environment"],
)
def test_the_torch_backend_needs_neither_warp_nor_double_precision(
    ball: Path, settings: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = under_the_sky(tmp_path / "p") if "scene.background" in settings else ball

    def launched(*args, **kwargs) -> None:
        raise AssertionError("a Warp kernel was launched")

    with using_kernels("torch"):
        trainer = trainer_of(project, **settings)
        monkeypatch.setattr(runtime.wp, "launch", launched)
        monkeypatch.setattr(runtime.wp, "from_torch", launched)
        with DoublePrecision() as doubles:
            for step in range(36):
                trainer.step(0.5 + step / 100)
            pictures = trainer.model.eval()
            pictures.refine()
            batch = trainer.store.batch(torch.arange(100))
            with torch.no_grad():
                out = pictures.render(batch.origins, batch.directions, 16, grid=pictures.render_grid())
        assert unsupported(trainer.model) == "the torch backend has no such kernel"
    assert doubles.found == []
    assert bool(torch.isfinite(out.color).all())
    assert trainer.take_measured().psnr > 5


def test_what_the_host_makes_of_a_training_is_brought_to_it_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lengths of rays, refined and fitted poses, and pictures for viewports, all made in double precision."""
    project = ball_project(tmp_path / "ball", views=6, side=16, depth=True)
    settings = {"loss.depth_weight": "0.1", "train.refine_poses": "true", "train.pose_start": "0"}
    info, scene = plan_run(project, "draft", config_of(**settings), torch.device("cpu"))
    with AwayFromTheHost():
        trainer = make_trainer(project, info, scene, torch.device("cpu"), Reporter())
        assert trainer.depths is not None
        assert len(trainer.depths) > 0
        assert trainer.poses is not None
        write_poses(
            tmp_path / "poses.json", trainer.poses, trainer.store.rays, info.images, np.array(info.sfm_from_box)
        )
        camera, pose = trainer.store.cameras[0], np.eye(4)
        nothing = np.zeros((camera.height, camera.width), bool)
        photo = np.zeros((camera.height, camera.width, 3), np.uint8)
        found = refit_camera(trainer.model, camera, pose, photo, nothing, 0.0, lambda: None)
    assert np.allclose(found, pose)
    item = {"name": "ball", "project": project, "scene_from_capture": np.eye(4).tolist()}
    clip = np.linalg.inv(perspective((0, -1.2, 0))).tolist()
    asked = {"number": 1, "width": 8, "height": 8, "scene_from_clip": clip, "file": tmp_path / "view.pixels"}
    field = described(trainer.model, project, "main", info, scene)
    request = training_view.LiveRequest.model_validate({**asked, "field": item})
    rays = training_view.view_rays(request, 8, 8)  # of the host
    monkeypatch.setattr(training_view, "view_rays", lambda *_: rays)
    with AwayFromTheHost():
        color, depth = training_view.view_picture(field, request, 8, 8)
    assert color.shape == (8, 8, 4)
    assert bool(((depth >= 0) & (depth <= 1)).all())


@pytest.mark.parametrize(("kernels", "cut"), [("warp", True), ("torch", False)])
def test_a_batch_is_cut_into_shards_where_host_threads_share_it(ball: Path, kernels: Kernels, cut: bool) -> None:
    """Elsewhere each shard would wait for the one before it."""
    with using_kernels(kernels):
        trainer = trainer_of(ball)
        shards = trainer._shard_tasks(trainer.draw(), 0.5)
    assert (len(shards) > 1) == cut


def test_both_backends_make_the_same_picture(ball: Path) -> None:
    trainer = train(ball, "warp", 60)
    batch = trainer.store.batch(torch.arange(0, len(trainer.store), 7))
    found = {}
    for kernels in ("warp", "torch"):
        with using_kernels(kernels), torch.no_grad():
            out = trainer.model.render(batch.origins, batch.directions, 16)
            found[kernels] = torch.cat([out.color, out.opacity[:, None], out.depth[:, None], out.probabilities], 1)
    difference = (found["warp"] - found["torch"]).abs()
    assert float(difference.mean()) < 2e-3
    assert float((difference.amax(1) > 0.02).float().mean()) < 0.02
