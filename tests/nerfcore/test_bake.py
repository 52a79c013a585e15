"""Baked fields: against a formula and against the field they were baked from, on disk, and what may go wrong."""

from __future__ import annotations

import errno
import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.bake.blocks import (
    Blocks,
    finest_side,
    march_settings,
    read_blocks,
    seen_by,
    side_for,
    visible_grid,
)
from fieldwork.nerfcore.bake.colors import vertex_texels
from fieldwork.nerfcore.bake.fit import baked_field
from fieldwork.nerfcore.bake.verb import finest_blocks
from fieldwork.nerfcore.config import RunConfig
from fieldwork.nerfcore.data.camera_rays import CameraRays
from fieldwork.nerfcore.errors import Cancelled, DiskError, ProjectError, SettingError
from fieldwork.nerfcore.field.hybrid import Geometry
from fieldwork.nerfcore.kernels.traversal import MarchSettings
from fieldwork.nerfcore.kernels.voxel_field import TEXELS, VERTICES, cell_length, texels_of
from fieldwork.nerfcore.params import BakeParams, EvaluateParams, RenderParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render import baked
from fieldwork.nerfcore.render.baked import (
    MOST_ACROSS,
    BakedField,
    from_texture,
    load_baked,
    most_blocks,
    read_meta,
    texture_bytes,
    texture_shape,
    to_texture,
)
from fieldwork.nerfcore.render.image import render_view
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.render.run import load_info
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.sampling.render_grid import RenderGrid
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.live import shared_ball

from .test_rendering import BallField, ball_model, closed_form, view


class DirectedBall(BallField):
    """A ball whose red changes with the direction it is seen along, as degree 1 of the harmonics can."""

    def density(self, points: torch.Tensor) -> torch.Tensor:
        return self.geometry(points).density

    def color(self, geometry: Geometry, directions: torch.Tensor, codes: torch.Tensor | None = None) -> torch.Tensor:
        color = super().color(geometry, directions, codes).clone()
        color[:, 0] = 0.5 - 0.3 / 0.48860251 * directions[:, 3]  # 0.5 + 0.3 x
        return color


def bake_model(model: Model, side: int, cameras: int = 40) -> BakedField:
    camera = view()[0].resized(144, 120)
    angles = [2 * math.pi * number / cameras for number in range(cameras)]
    places = [np.array([2.4 * math.cos(a), 2.4 * math.sin(a), 1.5 * math.sin(3 * a)]) for a in angles]
    poses = np.stack([look_at(place, np.zeros(3)) for place in places])
    rays = CameraRays([camera] * cameras, poses, torch.device("cpu"))
    check = Reporter().check
    grid = visible_grid(model, model.render_grid(), rays, check)
    blocks = read_blocks(model, grid, side, check)
    settings = march_settings(model, side, 1.0)
    views = seen_by(blocks, rays, settings, True, check)
    texels, changes = vertex_texels(model, blocks, views, rays.center, check)
    field = baked_field(blocks, texels, changes, model.field.classes)
    return BakedField(field, settings)


def test_a_baked_ball_renders_to_its_closed_form() -> None:
    model = ball_model(64)
    model.field = DirectedBall()  # type: ignore[assignment]
    camera, pose = view()
    found = render_view(bake_model(model, 16), camera, pose, 1.0)
    _, opacity = closed_form(camera, pose, 1.0)
    assert np.abs(found.opacity - opacity).mean() < 0.01
    solid = opacity > 0.9
    assert solid.sum() > 100
    assert np.abs(found.picture.pixels[..., 1] / found.opacity.clip(1e-3) - 0.4)[solid].max() < 0.01
    assert (found.label([3, 7])[solid] == 7).all()
    field = render_view(model, camera, pose, 1.0)
    assert np.abs(found.depth - field.depth)[solid].max() < 0.05


class PlainBall(DirectedBall):
    """The same with one class only."""

    classes = 1

    def logits(self, geometry: Geometry) -> torch.Tensor:
        return torch.zeros(len(geometry.density), 1)


def test_a_field_with_one_class_names_no_other() -> None:
    model = ball_model(64)
    model.field = PlainBall()  # type: ignore[assignment]
    camera, pose = view()
    baked_ball = bake_model(model, 16)
    named = texels_of(baked_ball.field.vertices, TEXELS)[:, 1, ::2]
    assert named.max() == 0, "load_baked refuses classes that are not there"
    found = render_view(baked_ball, camera, pose, 1.0)
    solid = found.opacity > 0.9
    assert solid.sum() > 100
    assert (found.label([7])[solid] == 7).all()
    assert found.confidence()[solid] == pytest.approx(found.opacity[solid], abs=1e-3)


def opaque_ball() -> Model:
    model = ball_model(64)
    model.field = DirectedBall()  # type: ignore[assignment]
    model.field.strength = 200.0  # type: ignore[assignment]
    model.occupancy.mean *= 50
    model.occupancy.rebuild()
    return model


def test_colours_are_those_seen_along_the_ray() -> None:
    camera, _ = view()
    field = bake_model(opaque_ball(), 16)
    for side, red in ((1, 0.2), (-1, 0.8)):
        found = render_view(field, camera, look_at(np.array([2.4 * side, 0.1, 0.2]), np.zeros(3)), 1.0)
        solid = found.opacity > 0.99
        assert solid.sum() > 300
        assert np.abs(found.picture.pixels[..., 0] - red)[solid].mean() < 0.06


def test_what_no_camera_sees_is_left_out() -> None:
    """The back of an opaque ball that all cameras see from one side."""
    model = opaque_ball()
    camera, _ = view()
    poses = np.stack([look_at(np.array([2.4, y, 0.0]), np.zeros(3)) for y in (-0.2, 0.0, 0.2)])
    rays = CameraRays([camera] * 3, poses, torch.device("cpu"))
    grid = visible_grid(model, model.render_grid(), rays, Reporter().check)
    n = grid.settings.resolution
    before, after = (g.cells[:, 0].view(n, n, n) > 0 for g in (model.render_grid(), grid))
    assert int(after[..., n // 2 :].sum()) > 100
    assert int(after[..., : n // 4].sum()) == 0
    assert int(before[..., : n // 4].sum()) > 100


def test_textures_hold_every_block() -> None:
    texels = np.random.default_rng(0).integers(0, 256, (77, VERTICES, VERTICES, VERTICES, 4)).astype(np.uint8)
    texture = to_texture(texels)
    x, y, z = texture_shape(77)
    assert texture.shape == (z * VERTICES, y * VERTICES, x * VERTICES, 4)
    assert np.array_equal(from_texture(texture, 77), texels)
    # block 26 is the second of the second layer's … row: x runs fastest
    assert np.array_equal(texture[:VERTICES, :VERTICES, VERTICES : 2 * VERTICES], texels[1])
    for blocks in (0, 1, 8, 9, 6000, MOST_ACROSS**3):
        shape = texture_shape(blocks)
        assert max(shape) <= MOST_ACROSS
        assert math.prod(shape) >= blocks


@pytest.mark.parametrize("memory", [3e6, 2e7, 1e8, 1e9])
def test_memory_is_kept_to(memory: float) -> None:
    most = most_blocks(memory, 64)
    assert most > 0
    assert texture_bytes(most, 64) <= memory
    assert most == MOST_ACROSS**3 or texture_bytes(most + 1, 64) > memory
    assert 28 <= side_for(4 * most, 64, most) <= 40
    assert 58 <= side_for(most, 64, most) < 64


def train(folder: Path, steps: int, resume: bool = False, **settings: str) -> None:
    asked = {**SMALL, **{name.replace("__", "."): value for name, value in settings.items()}}
    params = TrainParams(project=folder, preset="draft", steps=steps, set=asked, resume=resume)
    run_verb("train", params, Reporter())


@pytest.mark.parametrize("memory", [3e6, 30e6, 100e6])
@pytest.mark.parametrize("crowded", [(), (74,), (76, 75)])
def test_the_grid_is_as_fine_as_fits(crowded: tuple[int, ...], memory: float) -> None:
    """However the number of blocks jumps with the side: memory is used, and never more than there is."""
    sides = []

    def seen(side: int) -> Blocks:
        sides.append(side)
        count = round(2.4 * side**2 * (1.3 if side in crowded else 1.0))
        return Blocks(side, torch.zeros(count, 3, dtype=torch.long), torch.zeros(0, dtype=torch.uint8))

    found = finest_blocks(seen, 96, memory)
    assert texture_bytes(len(found), found.side) <= memory
    assert len(found) >= 0.75 * most_blocks(memory, found.side)
    assert len(sides) <= 5


def test_an_empty_field_is_baked() -> None:
    assert len(finest_blocks(lambda side: Blocks(side, torch.zeros(0, 3), torch.zeros(0)), 96, 100e6)) == 0


@pytest.mark.parametrize("contracted", [False, True])
def test_cells_are_no_finer_than_a_quarter_of_the_nearest_pixel(contracted: bool) -> None:
    n = 16
    cells = torch.zeros(n**3, 2)
    cells[(n // 2 * n + n // 2) * n + n // 2, 0] = 1.0  # its middle is beside the origin
    grid = RenderGrid(cells, torch.zeros(0), MarchSettings(n, 0.1, contracted=contracted))
    place = (0.5 / n) * (4 if contracted else 2)
    centers = torch.tensor([[place, place, place - 2.0], [place, place, place + 5.0]])
    side = finest_side(grid, centers, torch.tensor([0.01, 0.003]))  # 0.02 and 0.015 wide
    assert cell_length(side, contracted) == pytest.approx(0.015 / 4, rel=0.02)
    assert finest_side(replace(grid, cells=torch.zeros(n**3, 2)), centers, torch.ones(2)) == 1


@pytest.fixture(autouse=True, scope="module")
def coarse() -> Iterator[None]:
    """Grids small enough for tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fieldwork.nerfcore.bake.verb.FINEST", 16)
        patch.setattr("fieldwork.nerfcore.bake.verb.RAYS", 50_000)
        patch.setattr("fieldwork.nerfcore.bake.fit.ROUNDS", 2)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(shared_ball(tmp_path_factory), tmp_path_factory.mktemp("baked") / "p"))


@pytest.fixture
def copied(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "p"))


def test_a_baked_field_measures_like_the_field(trained: Path) -> None:
    result = run_verb("evaluate", EvaluateParams(project=trained, baked=True), Reporter())
    assert result["psnr"] > 20
    assert -5 < result["lost"]["psnr"] < 1, "fitted to the photos, it may be better than a field of few steps"
    assert abs(result["lost"]["miou"]) < 0.02
    stored = json.loads((trained / "runs" / "main" / "metrics.json").read_text())
    assert stored["test"]["psnr"] == pytest.approx(result["psnr"] + result["lost"]["psnr"], abs=2e-3)
    assert stored["test_baked"]["psnr"] == result["psnr"]
    assert (trained / result["pictures"][0]).is_file()


def test_the_loss_is_not_known_before_the_field_was_measured(copied: Path) -> None:
    shutil.rmtree(copied / "runs" / "main" / "evaluation")
    result = run_verb("evaluate", EvaluateParams(project=copied, baked=True), Reporter())
    assert result["lost"] == {"psnr": None, "miou": None}


def test_renders_have_all_passes_but_one(trained: Path, tmp_path: Path) -> None:
    import OpenImageIO as oiio

    asked = RenderParams(
        project=trained,
        out=tmp_path,
        orbit=2,
        size=(32, 32),
        baked=True,
        passes=["rgb", "depth", "semantic", "confidence", "normal"],
    )
    assert len(run_verb("render", asked, Reporter())["frames"]) == 2 * 6
    buffer = oiio.ImageBuf(str(tmp_path / "orbit_0000.exr"))
    names = list(buffer.spec().channelnames)
    pixels = buffer.get_pixels(oiio.FLOAT)
    assert pixels[16, 16, names.index("Depth.Z")] == pytest.approx(1.3, abs=0.25)
    assert pixels[16, 16, names.index("Label.ID")] in (1, 2)
    with pytest.raises(SettingError, match="unknown"):
        run_verb("render", asked.model_copy(update={"passes": ["unknown"]}), Reporter())
    with pytest.raises(SettingError, match="--speed"):
        run_verb("evaluate", EvaluateParams(project=trained, baked=True, speed=True), Reporter())


def test_less_memory_gives_coarser_cells(copied: Path) -> None:
    fine = read_meta(baked.voxels_folder(copied, "main"))
    result = run_verb("bake", BakeParams(project=copied, memory=2), Reporter())
    coarse = read_meta(baked.voxels_folder(copied, "main"))
    assert result["memory_mb"] <= 2
    assert result["cells"] == coarse.side * 8 < fine.side * 8
    assert result["blocks"] == coarse.blocks > 0
    files = {Path(file).name for file in result["files"]}
    assert files == {path.name for path in baked.voxels_folder(copied, "main").iterdir()}


@pytest.mark.slow
def test_a_contracted_field_without_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.FINEST", 32)
    project = ball_project(tmp_path / "p", views=24)
    train(project, 200, scene__contraction="on", loss__semantic_weight="0")
    run_verb("evaluate", EvaluateParams(project=project), Reporter())
    run_verb("bake", BakeParams(project=project, memory=20), Reporter())
    info = load_info(project, "main")
    assert info.contracted
    field = load_baked(project, "main", info)
    assert field.classes == 0
    assert field.settings.contracted
    result = run_verb("evaluate", EvaluateParams(project=project, baked=True), Reporter())
    assert -5 < result["lost"]["psnr"] < 1.5
    assert result["lost"]["miou"] is None
    asked = RenderParams(project=project, out=tmp_path / "r", orbit=1, size=(16, 16), baked=True)
    assert len(run_verb("render", asked, Reporter())["frames"]) == 4


def test_an_empty_field_is_baked_with_a_warning(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.bake.blocks.LEAST_OPACITY", 2.0)
    report = Reporter()
    assert run_verb("bake", BakeParams(project=copied), report)["blocks"] == 0
    assert any("nothing" in warning for warning in report.warnings)
    out = load_baked(copied, "main", load_info(copied, "main"))(torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]))
    assert float(out.opacity) == 0


def loading(project: Path) -> BakedField:
    return load_baked(project, "main", load_info(project, "main"))


@pytest.mark.parametrize("name", ["meta.json", "index.npy", "lut.npy", "T0.npy", "T1.npy", "T2.npy", "T4.npy"])
@pytest.mark.parametrize("damage", ["truncated", "garbage", "empty", "gone"])
def test_damaged_files_are_named(copied: Path, name: str, damage: str) -> None:
    path = baked.voxels_folder(copied, "main") / name
    content = path.read_bytes()
    changed = {"truncated": content[: len(content) * 2 // 3], "garbage": b"\x93NUMPY\x07" + content[20:], "empty": b""}
    path.unlink() if damage == "gone" else path.write_bytes(changed[damage])
    with pytest.raises(ProjectError) as caught:
        loading(copied)
    assert "fieldwork bake" in caught.value.hint
    if (name, damage) != ("meta.json", "gone"):
        assert name in caught.value.message


def test_an_index_or_classes_beyond_what_is_there_are_refused(copied: Path) -> None:
    folder = baked.voxels_folder(copied, "main")
    index = np.load(folder / "index.npy")
    np.save(folder / "index.npy", np.where(index > 0, index + 1, index))
    with pytest.raises(ProjectError, match="blocks that are not there"):
        loading(copied)
    np.save(folder / "index.npy", index)
    texels = np.load(folder / "T1.npy")
    texels[..., 2] = 9
    np.save(folder / "T1.npy", texels)
    with pytest.raises(ProjectError, match="classes that are not there"):
        loading(copied)


def test_a_run_that_was_trained_further_must_be_baked_again(copied: Path) -> None:
    assert loading(copied).classes == 2
    train(copied, 310, resume=True)
    with pytest.raises(ProjectError, match="another training") as caught:
        run_verb("render", RenderParams(project=copied, out=copied / "r", orbit=1, baked=True), Reporter())
    assert "fieldwork bake" in caught.value.hint
    run_verb("bake", BakeParams(project=copied, memory=10), Reporter())
    assert loading(copied).classes == 2


def test_a_run_without_a_checkpoint_or_baked_field(copied: Path) -> None:
    shutil.rmtree(baked.voxels_folder(copied, "main"))
    with pytest.raises(ProjectError, match="no baked field"):
        loading(copied)
    (copied / "runs" / "main" / "field.safetensors").unlink()
    with pytest.raises(ProjectError, match="checkpoint"):
        run_verb("bake", BakeParams(project=copied), Reporter())
    with pytest.raises(ProjectError, match="no run"):
        run_verb("bake", BakeParams(project=copied, run="other"), Reporter())


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_full_disk_keeps_the_earlier_one(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = baked.voxels_folder(copied, "main")
    before, beside = contents(folder), sorted(path.name for path in folder.parent.iterdir())
    save, written = np.save, []

    def full(file, values) -> None:
        written.append(values)
        if len(written) == 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        save(file, values)

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(DiskError, match="No space"):
        run_verb("bake", BakeParams(project=copied, memory=10), Reporter())
    assert contents(folder) == before
    assert sorted(path.name for path in folder.parent.iterdir()) == beside


@pytest.mark.parametrize("after", [0, 3, 20, 60])
def test_a_cancel_keeps_the_earlier_one(copied: Path, after: int) -> None:
    class Stops(Reporter):
        left = after

        def check(self) -> None:
            self.left -= 1
            if self.left < 0:
                self.cancel()
            super().check()

    folder = baked.voxels_folder(copied, "main")
    before = contents(folder)
    with pytest.raises(Cancelled):
        run_verb("bake", BakeParams(project=copied, memory=10), Stops())
    assert contents(folder) == before


def test_more_classes_than_a_byte_tells_apart_are_refused(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.MOST_CLASSES", 1)
    with pytest.raises(SettingError, match="2 classes"):
        run_verb("bake", BakeParams(project=copied), Reporter())


def test_the_same_field_is_baked_the_same(copied: Path) -> None:
    folder = baked.voxels_folder(copied, "main")
    before = contents(folder)
    run_verb("bake", BakeParams(project=copied, memory=20), Reporter())
    assert contents(folder) == before


def test_settings_of_the_march_are_those_of_the_model() -> None:
    config = RunConfig.model_validate({"sampling": {"resolution": 16}})
    for contracted in (False, True):
        model = Model(config, 0, 0, contracted)
        settings = march_settings(model, 32, 1.0)
        assert settings.contracted is contracted
        assert settings.step == pytest.approx((4 if contracted else 2) / 256)
