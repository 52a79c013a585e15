"""What is behind the field as colours of directions: where it is read, what it learns, and how pictures show it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from fieldwork.nerfcore.config import RunConfig, make_config
from fieldwork.nerfcore.data.box import box_poses
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.errors import ProjectError, SettingError
from fieldwork.nerfcore.field.environment import NAMED, Environment
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.contraction import grid_position, horizon, thinning
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.images.picture import linear_to_srgb
from fieldwork.nerfcore.kernels.device import use_device
from fieldwork.nerfcore.kernels.voxel_field import VoxelRays
from fieldwork.nerfcore.labels.accept import with_head_of
from fieldwork.nerfcore.params import BakeParams, EvaluateParams, RenderParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.render.baked import load_baked
from fieldwork.nerfcore.render.image import Frame, render_view
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.render.panorama import Panorama, panorama
from fieldwork.nerfcore.render.run import Trained, load_trained
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.train.background import INFINITE
from fieldwork.nerfcore.train.composite_loss import composite_loss
from fieldwork.nerfcore.train.infinity import between_points, share_at_infinity
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project, draw
from fieldwork.tests.nerfcore.support.sky import looking, sky, under_the_sky
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

STEPS = 500
CLEARED = {"loss.environment_weight": "0.01"}  # so few steps need a higher price


@dataclass(frozen=True)
class Seen:
    """A trained run under the sky, and what a camera far from those of the photos sees of it."""

    project: Path
    trained: Trained
    frame: Frame
    ball: np.ndarray
    sky: np.ndarray


def trained_under_the_sky(folder: Path, named: str | None = None, **settings: str) -> Seen:
    project = under_the_sky(folder, named)
    values = {**SMALL, **CLEARED, **{name.replace("__", "."): value for name, value in settings.items()}}
    run_verb("train", TrainParams(project=project, preset="draft", steps=STEPS, set=values), Reporter())
    trained = load_trained(project, "main")
    scene = load_scene(project)
    camera, pose = scene.views[0].camera, look_at(np.array([1.3, 1.5, 0.2]), np.zeros(3))
    moved = trained.info.box(load_project(project)).box_from_world @ pose
    moved[:3, :3] = pose[:3, :3]
    frame = render_view(trained.model, camera, moved, 0.0)
    _, label, _ = draw(camera, pose)
    return Seen(project, trained, frame, label > 0, sky(looking(camera, pose)))


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return trained_under_the_sky(tmp_path_factory.mktemp("sky") / "p")


coordinate = st.floats(-20, 20)


@given(st.tuples(coordinate, coordinate, coordinate).filter(lambda p: max(map(abs, p)) > 1e-3))
def test_thinning_is_how_much_shorter_space_becomes_outwards(place: tuple[float, float, float]) -> None:
    """Of a step away from the middle: by the difference of grid positions, in the cube 1."""
    p = torch.tensor([place], dtype=torch.float64)
    u = grid_position(p, True)
    step = 1e-6 * p
    moved = (grid_position(p + step, True) - u).abs().amax() * 4
    inside = float(p.abs().max()) < 1 - 1e-5
    outside = float(p.abs().max()) > 1 + 1e-5
    if inside or outside:
        assert float(thinning(u)[0]) == pytest.approx(float(moved / step.abs().amax()), rel=1e-4)


def test_rays_end_at_the_horizon_wherever_they_begin() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator, dtype=torch.float64), dim=1)
    far = grid_position(origins + 1e9 * directions, True)
    assert torch.allclose(far, horizon(directions), atol=1e-6)


def test_captures_under_the_sky_have_an_environment(tmp_path: Path) -> None:
    project = under_the_sky(tmp_path / "p")
    info, scene = plan_run(project, "draft", RunConfig(), torch.device("cpu"))
    assert info.config.scene.background == "environment"
    assert info.contracted
    labels = [np.asarray(Image.open(path)) for path in (project / "labels").iterdir()]
    beside = float(np.mean([label == 0 for label in labels]))
    # Few: where one camera sees past the ball, others mostly see it.
    assert INFINITE < share_at_infinity(scene) <= beside


def test_transparent_photos_say_nothing_of_what_is_behind_them(tmp_path: Path) -> None:
    config = make_config("draft", {"scene.background": "environment"})
    with pytest.raises(SettingError, match=r"scene\.background"):
        plan_run(ball_project(tmp_path / "p"), "draft", config, torch.device("cpu"))


def test_what_has_a_place_is_not_at_infinity(tmp_path: Path) -> None:
    """The same colours before each camera, whichever way it looks; and a photo alone, or two."""
    project = under_the_sky(tmp_path / "p")
    scene = load_scene(project)
    assert share_at_infinity(replace(scene, train=scene.train[:2])) == 0
    first = Image.open(project / "images" / "00.png")
    for path in (project / "images").iterdir():
        first.save(path)
    assert share_at_infinity(load_scene(project)) < INFINITE


@pytest.mark.parametrize(("name", "far"), [("Night sky", True), ("Himmel", True), ("天空", True), ("Ceiling", False)])
def test_what_has_the_name_of_a_thing_is_no_sky_where_cameras_look_around(tmp_path: Path, name: str, far: bool) -> None:
    scene = load_scene(under_the_sky(tmp_path / "p", name, outward=True, above_a_floor=True))
    assert (share_at_infinity(scene) > INFINITE) is far


def test_walls_of_a_room_are_alike_below_the_horizon_too(tmp_path: Path) -> None:
    """Cameras that look around: white walls look as a sky does, but on all sides."""
    outside, room = (load_scene(under_the_sky(tmp_path / str(k), outward=True, above_a_floor=k)) for k in (True, False))
    assert share_at_infinity(outside) > INFINITE
    assert share_at_infinity(room) == 0


def test_what_lies_between_points_is_not_at_infinity(tmp_path: Path) -> None:
    """A plain floor has the same colour from everywhere, like a sky, but points of its joints around it."""
    scene = load_scene(under_the_sky(tmp_path / "p"))
    alone = share_at_infinity(replace(scene, points=Points.empty()))
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def points(radius: float) -> Points:
        return Points(radius * directions, np.zeros((2000, 3), np.uint8), np.zeros(2000))

    assert share_at_infinity(replace(scene, points=points(0.3))) == alone  # of the ball
    assert share_at_infinity(replace(scene, points=points(30))) == 0
    in_a_line = replace(points(1), xyz=np.linspace([-1, 0, 0], [1, 0, 0], 2000))
    assert share_at_infinity(replace(scene, points=in_a_line)) == alone


def test_points_behind_a_panorama_have_things_between_them() -> None:
    panorama_ = Camera(model="EQUIRECTANGULAR", width=64, height=32, fx=32, fy=32, cx=32, cy=16)
    band = np.array([[np.sin(a), h, np.cos(a)] for a in np.linspace(-3.1, 3.1, 60) for h in (-0.5, 0.5)])
    between = between_points(View("all around", panorama_, np.eye(4), Path()), band).reshape(32, 64)
    assert between[16].all()  # the horizon, also at both ends of the picture
    assert not between[[0, -1]].any()


def test_the_sky_is_learned_and_the_field_stays_empty_before_it(seen: Seen) -> None:
    beside = ~seen.ball
    assert seen.trained.info.config.scene.background == "environment"
    assert seen.frame.opacity[beside].mean() < 0.1
    assert seen.frame.opacity[seen.ball].mean() > 0.9
    error = seen.frame.color[beside] - seen.sky[beside]
    assert -10 * math.log10((error**2).mean()) > 27
    assert np.isnan(seen.frame.depth[beside]).mean() > 0.5


@pytest.mark.slow
def test_without_an_environment_the_sky_is_somewhere(tmp_path: Path) -> None:
    filled = trained_under_the_sky(tmp_path / "p", scene__background="random")
    assert filled.frame.opacity[~filled.ball].mean() > 0.9


def test_an_environment_without_labels_is_void(seen: Seen) -> None:
    ids = seen.trained.info.class_ids
    assert seen.trained.model.environment is not None
    assert float(seen.trained.model.environment.labelled) < NAMED
    label = seen.frame.label(ids)
    assert (label[~seen.ball] == 0).mean() > 0.9
    assert (label[seen.ball] > 0).mean() > 0.9


@pytest.mark.slow
def test_an_environment_with_labels_has_its_class(tmp_path: Path) -> None:
    found = trained_under_the_sky(tmp_path / "p", named="sky")
    label = found.frame.label(found.trained.info.class_ids)
    assert (label[~found.ball] == 3).mean() > 0.9
    assert (label[found.ball] == 3).mean() < 0.1
    assert np.abs(found.frame.probabilities.sum(-1) - 1).max() < 0.05


def test_pictures_show_the_environment_and_layers_keep_it_apart(seen: Seen, tmp_path: Path) -> None:
    run_verb("render", RenderParams(project=seen.project, out=tmp_path, test=True), Reporter())
    name = next(tmp_path.glob("*.exr"))
    layers = oiio.ImageBuf(str(name))
    names, pixels = list(layers.spec().channelnames), layers.get_pixels(oiio.FLOAT)
    alpha = pixels[..., names.index("A")]
    picture = np.asarray(Image.open(name.with_suffix(".png"))).astype(float) / 255
    empty = alpha < 0.02
    assert empty.mean() > 0.2
    environment = pixels[..., [names.index(f"Environment.{c}") for c in "RGB"]]
    assert np.abs(linear_to_srgb(environment) - picture)[empty].max() < 0.03
    camera = load_scene(seen.project).views[int(name.stem)]
    true = sky(looking(camera.camera, camera.camera_to_world))
    assert np.abs(picture - true)[empty].mean() < 0.08
    assert pixels[..., names.index("R")][empty].max() < 0.02


def test_the_verdict_knows_that_the_rest_is_sky(seen: Seen) -> None:
    result = run_verb("evaluate", EvaluateParams(project=seen.project), Reporter())
    assert result["opacity"] < 0.6
    assert not any("fog" in reason or "empty" in reason for reason in result["verdict"]["reasons"])


def test_only_rays_that_were_rendered_teach_the_environment(tmp_path: Path) -> None:
    """With too small a capacity rays that meet the ball are left out; they do not show the sky."""
    project = under_the_sky(tmp_path / "p")
    config = make_config("draft", SMALL)
    info, scene = plan_run(project, "draft", config, use_device())
    trainer = make_trainer(project, info, scene, use_device(), Reporter())
    model = trainer.model
    model.fixed_capacity = True
    batch = trainer.store.batch(torch.arange(256))
    for capacity, visible in ((16, 1.0), (256, 0.01)):  # of rays, of visible samples
        model.host_visible_share = visible
        rendered = model.render(batch.origins, batch.directions, 12, capacity=capacity)
        assert rendered.environment is not None
        dropped = (rendered.samples.t_first >= 0) & (rendered.opacity == 0)
        assert int(dropped.sum()) > 100
        assert bool((rendered.environment.weight[dropped] == 0).all())
        assert float(rendered.environment.weight.detach().max()) > 0
        rendered.environment.color.retain_grad()
        loss, _ = composite_loss(batch, rendered, torch.zeros(256, 3), 0.0, config.loss, model)
        loss.backward()
        gradient = rendered.environment.color.grad
        assert gradient is not None
        assert bool((gradient[dropped] == 0).all())
        assert float(gradient[~dropped].abs().max()) > 0


@pytest.mark.setting("loss.environment_weight")
def test_opacity_before_an_environment_has_a_price(tmp_path: Path) -> None:
    project = under_the_sky(tmp_path / "p")
    prices = {}
    for background in ("environment", "random"):
        config = make_config("draft", {**SMALL, "scene.background": background})
        info, scene = plan_run(project, "draft", config, use_device())
        trainer = make_trainer(project, info, scene, use_device(), Reporter())
        batch = trainer.store.batch(torch.arange(200))
        rendered = trainer.model.render(batch.origins, batch.directions, 12)
        for weight in (0.0, 0.5):
            loss = config.loss.model_copy(update={"environment_weight": weight})
            total, _ = composite_loss(batch, rendered, torch.zeros(200, 3), 0.0, loss, trainer.model)
            prices[background, weight] = float(total.detach())
        opacity = float(rendered.opacity.detach().mean())
        assert opacity > 0.01
        price = 0.5 * opacity if background == "environment" else 0.0
        assert prices[background, 0.5] - prices[background, 0.0] == pytest.approx(price, rel=1e-3, abs=1e-6)


def test_pictures_read_the_environment_only_where_it_shows() -> None:
    model = Model(make_config("draft", {**SMALL, "scene.background": "environment"}), 3, 4, True).eval()
    environment = model.environment
    assert environment is not None
    environment.labelled.fill_(1.0)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    opacity = torch.linspace(0, 1, 50)
    with torch.no_grad():
        whole = environment.rays(model.field, directions, 1 - opacity)
        part = environment.visible_rays(model.field, directions, opacity, 0.5, True)
    shown = opacity < 0.5
    assert torch.allclose(part.color[shown], whole.color[shown], atol=1e-5)
    assert part.probabilities is not None
    assert whole.probabilities is not None
    assert torch.allclose(part.probabilities[shown], whole.probabilities[shown], atol=1e-5)
    assert float(part.color[~shown].abs().max()) == float(part.probabilities[~shown].abs().max()) == 0


@pytest.mark.parametrize(("share", "named"), [(0.0, False), (0.2, False), (0.8, True), (1.0, True)])
def test_the_environment_is_named_as_often_as_other_pixels(share: float, named: bool) -> None:
    """A tenth of all pixels is labelled; of those behind the field `share` times as many."""
    environment, generator = Environment(), torch.Generator().manual_seed(0)
    for _ in range(200):
        labelled = torch.rand(4000, generator=generator) < 0.1 * share
        environment.observe(torch.ones(4000), labelled, 0.1)
        environment.observe(torch.zeros(4000), torch.ones(4000), 0.1)  # nothing of it is seen
    assert float(environment.labelled) == pytest.approx(share, abs=0.1)
    assert (float(environment.labelled) > NAMED) == named


@pytest.mark.slow
def test_baked_fields_have_the_environment_too(seen: Seen, tmp_path: Path) -> None:
    run_verb("bake", BakeParams(project=seen.project, memory=20), Reporter())
    baked = load_baked(seen.project, "main", seen.trained.info)
    project = load_project(seen.project)
    scene = load_scene(seen.project)
    poses = box_poses(scene.views, seen.trained.info.box(project).box_from_world)
    share = 0.0  # which photo sees most beside the ball depends on the field
    for view, pose in zip(scene.views, poses):
        field, frame = (render_view(shown, view.camera, pose, 0.0) for shown in (seen.trained.model, baked))
        beside = (frame.opacity < 0.02) & (field.opacity < 0.02)
        share = max(share, float(beside.mean()))
        assert np.abs(frame.color - field.color)[beside].max(initial=0) < 0.05
    assert share > 0.2
    (seen.project / "runs" / "main" / "voxels" / "environment.npy").unlink()
    with pytest.raises(ProjectError, match=r"environment\.npy is damaged"):
        load_baked(seen.project, "main", seen.trained.info)


def test_a_panorama_is_read_where_it_was_drawn() -> None:
    """In all directions, across its border and at the poles; classes and void."""
    torch.manual_seed(0)
    # The finest octaves of an untrained field change within a pixel.
    smooth = {"scene.background": "environment", "field.precision": "float32", "field.octaves": "2"}
    model = Model(make_config("draft", {**SMALL, **smooth}), 3, 4, True).eval()
    assert model.environment is not None
    assert model.field.grid is not None
    model.field.grid.table.normal_(0, 0.3)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    directions[:4] = torch.tensor([[-1.0, 1e-7, 0], [-1.0, -1e-7, 0], [0, 0, 1.0], [0, 0, -1.0]])
    nothing = torch.zeros(500)
    rays = VoxelRays(torch.zeros(500, 3), nothing, nothing, torch.zeros(500, 3))
    for labelled in (0.0, 1.0):
        model.environment.labelled.fill_(labelled)
        with torch.no_grad():
            true = model.environment.rays(model.field, directions, 1 - nothing)
        picture = panorama(model, lambda: None, 512)
        found = Panorama(picture, 3, torch.device("cpu")).behind(directions, rays)
        assert float((found.color - true.color).abs().max()) < 0.006
        assert true.probabilities is not None
        assert found.probabilities is not None
        assert bool((found.weight == 1).all())
        if labelled:
            same = found.probabilities.argmax(1) == true.probabilities.argmax(1)
            assert float(same.float().mean()) > 0.95
        else:
            assert not found.probabilities.any()


def test_new_classes_do_not_name_the_environment() -> None:
    """Those of marks are on surfaces, whatever label maps the run was trained with."""
    config = make_config("draft", {**SMALL, "scene.background": "environment"})
    before, fresh = Model(config, 3, 4, True), Model(config, 2, 4, True)
    assert before.environment is not None
    before.environment.labelled.fill_(1.0)
    made = with_head_of(fresh, before.state_dict())
    assert made.environment is not None
    assert float(made.environment.labelled) == 0
    assert torch.equal(made.field.density_head.weights[0], before.field.density_head.weights[0])


def test_runs_remember_their_environment(seen: Seen) -> None:
    config = json.loads((seen.project / "runs" / "main" / "config.json").read_text())
    assert config["config"]["scene"]["background"] == "environment"
    again = load_trained(seen.project, "main").model
    poses = box_poses(load_scene(seen.project).views, seen.trained.info.box(load_project(seen.project)).box_from_world)
    camera = load_scene(seen.project).views[3].camera
    first, second = (render_view(model, camera, poses[3], 0.0).color for model in (seen.trained.model, again))
    assert np.array_equal(first, second)
