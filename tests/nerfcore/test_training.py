"""Training as a whole, on a tiny capture that a test draws itself."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import make_config, preset_names
from fieldwork.nerfcore.errors import Cancelled, DiskError, ProjectError, SettingError, TrainingError
from fieldwork.nerfcore.evaluate.speed import measure_speed
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.params import EvaluateParams, MeshParams, RenderParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import ImageRecord, PosedImage, Poses, Project, SemanticClass
from fieldwork.nerfcore.project.store import load_project, save_poses, save_project
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.render.run import read_checkpoint
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.train.checkpoint import write_checkpoint
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL
from PIL import Image


def draw_ball(camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An opaque ball of radius 0.5, red above and blue below z = 0: RGBA (H, W, 4) and labels 1, 2 (H, W)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    d = d / np.linalg.norm(d, axis=-1, keepdims=True) @ pose[:3, :3].T
    o = pose[:3, 3]
    b = d @ o
    root = b * b - (o @ o - 0.25)
    hit = root > 0
    z = o[2] + d[..., 2] * (-b - np.sqrt(np.maximum(root, 0)))
    rgba = np.zeros((*x.shape, 4), np.uint8)
    rgba[hit & (z > 0)] = (210, 60, 50, 255)
    rgba[hit & (z <= 0)] = (50, 80, 200, 255)
    return rgba, np.where(hit, np.where(z > 0, 1, 2), 0).astype(np.uint8)


@pytest.fixture(scope="module")
def tiny_project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """16 labelled views of the ball in a folder with spaces and umlauts."""
    folder = tmp_path_factory.mktemp("projekt") / "Kugel für Übung"
    camera = Camera(width=40, height=40, fx=55, fy=55, cx=20, cy=20)
    images, posed = [], []
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    for i in range(16):
        angle, height = 2 * math.pi * i / 16, 0.9 * math.sin(i * 2.4)
        pose = look_at(np.array([1.8 * math.cos(angle), 1.8 * math.sin(angle), height]), np.zeros(3))
        rgba, label = draw_ball(camera, pose)
        name = f"{i:02d}.png"
        Image.fromarray(rgba).save(folder / "images" / name)
        Image.fromarray(label).save(folder / "labels" / name)
        images.append(ImageRecord(name=name, file=f"images/{name}", label=f"labels/{name}", width=40, height=40))
        posed.append(PosedImage(name=name, camera=0, camera_to_world=pose.tolist()))
    classes = [
        SemanticClass(id=1, name="top", color=(0.8, 0.2, 0.2), priority=1.0),
        SemanticClass(id=2, name="bottom", color=(0.2, 0.3, 0.8), priority=1.0),
    ]
    save_project(folder, Project(images=images, classes=classes))
    save_poses(folder, Poses(source="test", cameras=[camera], images=posed), Points.empty())
    return folder


def train(
    folder: Path, run: str, steps: int, report: Reporter | None = None, resume: bool = False, **settings: str
) -> dict:
    params = TrainParams(
        project=folder, preset="draft", run=run, steps=steps, resume=resume,
        set={**SMALL, **{k.replace("__", "."): v for k, v in settings.items()}},
    )  # fmt: skip
    return run_verb("train", params, report or Reporter())


def tensors(folder: Path, run: str) -> dict[str, torch.Tensor]:
    return read_checkpoint(folder / "runs" / run / "field.safetensors", torch.device("cpu"))[0]


@pytest.fixture(scope="module")
def trained(tiny_project: Path) -> Path:
    train(tiny_project, "main", 400)
    return tiny_project


def test_a_short_training_learns_colours_classes_and_shape(trained: Path) -> None:
    result = run_verb("evaluate", EvaluateParams(project=trained), Reporter())
    assert result["images"] == 2
    assert result["background"] == "white"
    assert result["psnr"] > 20
    assert result["miou"] > 0.85
    assert result["lpips"] is None
    assert result["fps"] is result["ms_network"] is None  # a frame of 800×800 takes minutes of a large field on a CPU
    assert (trained / result["pictures"][0]).is_file()
    mesh = run_verb("mesh", MeshParams(project=trained, resolution=48), Reporter())
    assert set(mesh["classes"]) - {"void"} == {"top", "bottom"}
    # What no label reaches is void.
    area = {name: entry["area"] for name, entry in mesh["classes"].items()}
    assert area.get("void", 0) < 0.01 * sum(area.values())
    assert sum(area.values()) > 0.6 * np.pi  # of the ball's π, where two photos see it
    with np.load(trained / "exports" / "main" / "mesh.npz") as data:
        radius = np.linalg.norm(data["vertices"], axis=1)
        outward = (data["normals"] * data["vertices"]).sum(1)
        upper = data["vertices"][:, 2] > 0.1
        assert np.median(radius) == pytest.approx(0.5, abs=0.06)
        assert (outward > 0).mean() > 0.9
        assert (data["class_id"][upper] == 1).mean() > 0.9
    assert mesh["unseen"] < 0.05, "small holes"
    with np.load(trained / "exports" / "main" / "mesh.npz") as data:
        assert data["colors"][upper].mean(0)[0] > data["colors"][upper].mean(0)[2]


@pytest.mark.slow
def test_gaps_of_the_mesh_are_closed_on_request(trained: Path) -> None:
    from fieldwork.nerfcore.mesh.triangles import border_edges

    made = {}
    for width in (0.0, 8.0):
        result = run_verb("mesh", MeshParams(project=trained, resolution=48, close_gaps=width), Reporter())
        with np.load(trained / "exports" / "main" / "mesh.npz") as data:
            made[width] = result, len(border_edges(data["faces"])), dict(data)
    (plain, ends, _), (closed, fewer, arrays) = made.values()
    assert plain["unseen"] < 0.05
    assert fewer < ends
    assert closed["unseen"] > plain["unseen"]
    unseen, middle = arrays["unseen"], arrays["vertices"][arrays["faces"]].mean(1)
    assert len(unseen) == closed["faces"]
    assert np.median(np.linalg.norm(middle[unseen], axis=1)) == pytest.approx(0.5, abs=0.1)
    seen = [(1 - mesh["unseen"]) * sum(entry["area"] for entry in mesh["classes"].values()) for mesh in (plain, closed)]
    assert seen[1] == pytest.approx(seen[0], rel=0.05)


def test_speed_is_measured_on_request(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.evaluate.verb.measure_speed", partial(measure_speed, side=40))
    result = run_verb("evaluate", EvaluateParams(project=trained, speed=True), Reporter())
    assert result["fps_size"] == [40, 40]
    assert all(result[key] > 0 for key in ("fps", "spr", "ms_sampling", "ms_network"))


def test_a_textured_mesh_has_uvs_and_colours(trained: Path, tmp_path: Path) -> None:
    import trimesh

    out = tmp_path / "ball.glb"
    params = MeshParams(project=trained, resolution=32, texture=128, faces=600, out=out)
    result = run_verb("mesh", params, Reporter())
    assert result["faces"] <= 660
    assert result["texture"] == 128
    loaded = trimesh.load(out, force="mesh")
    assert loaded.visual.uv.shape[1] == 2
    with np.load(trained / "exports" / "main" / "mesh.npz") as data:
        assert data["uv"].shape == (len(data["faces"]), 3, 2)
    texture = np.array(Image.open(trained / "exports" / "main" / "texture.png"))
    assert texture.shape == (128, 128, 3)
    # Small photos need no more than the smallest texture.
    assert run_verb("mesh", params.model_copy(update={"texture": "auto"}), Reporter())["texture"] == 512
    with Image.open(trained / "exports" / "main" / "texture.png") as image:
        assert image.size == (512, 512)
    red, blue = (texture[..., 0] > texture[..., 2] + 50).mean(), (texture[..., 2] > texture[..., 0] + 50).mean()
    assert min(red, blue) > 0.2


def test_a_first_look_at_the_mesh_leaves_the_mesh_alone(trained: Path) -> None:
    record = trained / "exports" / "main" / "mesh.json"
    before = record.read_bytes() if record.is_file() else None
    steps = len(load_project(trained).provenance)
    result = run_verb("mesh", MeshParams(project=trained, preview=True), Reporter())
    with np.load(result["preview"]) as data:
        assert len(data["faces"]) == result["faces"] > 500
        radius = np.linalg.norm(data["vertices"], axis=1)
        assert abs(np.median(radius) - 0.5) < 3 * result["voxel"]
        sure = np.abs(data["vertices"][:, 2]) > 0.15
        ids = data["class_id"][sure]
        assert (np.where(data["vertices"][sure, 2] > 0, 1, 2) == ids).mean() > 0.9
        assert data["confidence"].min() > 0.3
    assert (record.read_bytes() if record.is_file() else None) == before
    assert len(load_project(trained).provenance) == steps


def test_split_meshes_have_one_part_a_class(trained: Path, tmp_path: Path) -> None:
    import trimesh

    out = tmp_path / "parts.glb"
    run_verb("mesh", MeshParams(project=trained, resolution=32, split="classes", out=out), Reporter())
    assert set(trimesh.load(out).geometry) - {"void"} == {"top", "bottom"}


def test_renders_have_all_passes(trained: Path, tmp_path: Path) -> None:
    import OpenImageIO as oiio

    passes = ["rgb", "depth", "semantic", "confidence", "normal"]
    result = run_verb(
        "render", RenderParams(project=trained, out=tmp_path, orbit=2, size=(32, 32), passes=passes), Reporter()
    )
    assert len(result["frames"]) == 2 * 6
    buffer = oiio.ImageBuf(str(tmp_path / "orbit_0000.exr"))
    names = list(buffer.spec().channelnames)
    assert {"R", "G", "B", "A", "Depth.Z", "Label.ID", "Confidence.V", "Normal.X"} <= set(names)
    pixels = buffer.get_pixels(oiio.FLOAT)
    assert pixels[16, 16, names.index("Depth.Z")] == pytest.approx(1.3, abs=0.25)
    assert pixels[16, 16, names.index("Label.ID")] in (1, 2)


def test_a_render_is_cancelled_within_a_picture(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a picture nor the finer grid before it is made to its end."""
    asked = []

    class StopsInThePicture(Reporter):
        def progress(self, fraction: float, message: str = "") -> None:
            super().progress(fraction, message)
            self.cancel()

    monkeypatch.setattr(Model, "refine", lambda model, pixels, check, rays: asked.append(check))
    report = StopsInThePicture()
    with pytest.raises(Cancelled):
        run_verb("render", RenderParams(project=trained, out=tmp_path, orbit=1, size=(32, 32)), report)
    assert asked == [report.check]
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_training_equals_an_uninterrupted_one(tiny_project: Path) -> None:
    train(tiny_project, "whole", 60)

    class StopAt(Reporter):
        def __init__(self, steps: int) -> None:
            super().__init__()
            self.left = steps

        def check(self) -> None:
            self.left -= 1
            if self.left < 0:
                raise Cancelled

    with pytest.raises(Cancelled):
        # the photos are loaded with one check each, then there is one check a step
        train(tiny_project, "parts", 60, StopAt(14 + 37))
    state = read_checkpoint(tiny_project / "runs" / "parts" / "field.safetensors", torch.device("cpu"))[1]
    assert 20 < state["steps"] < 60
    train(tiny_project, "parts", 60, resume=True)
    whole, parts = tensors(tiny_project, "whole"), tensors(tiny_project, "parts")
    assert whole.keys() == parts.keys()
    different = [name for name in whole if not torch.equal(whole[name], parts[name])]
    assert different == []


def test_a_training_goes_on_on_another_kind_of_device(tiny_project: Path) -> None:
    """Its generator of random numbers has a state of another size there."""
    train(tiny_project, "moved", 5)
    path = tiny_project / "runs" / "moved" / "field.safetensors"
    saved, state = read_checkpoint(path, torch.device("cpu"))
    write_checkpoint(path, {**saved, "generator": torch.zeros(16, dtype=torch.uint8)}, state)
    assert train(tiny_project, "moved", 8, resume=True)["steps"] == 8


def test_cancel_takes_less_than_two_seconds_and_leaves_a_checkpoint(tiny_project: Path) -> None:
    asked: list[float] = []

    class Stopping(Reporter):
        """Is cancelled half a second after the first step, however long it takes until then."""

        def progress(self, fraction: float, message: str = "") -> None:
            if not asked and message.startswith("step"):
                asked.append(math.inf)
                threading.Timer(0.5, self.stop).start()

        def stop(self) -> None:
            asked[0] = time.monotonic()
            self.cancel()

    report = Stopping()
    with pytest.raises(Cancelled):
        train(tiny_project, "cancelled", 100000, report)
    assert time.monotonic() - asked[0] < 2.0
    assert (tiny_project / "runs" / "cancelled" / "field.safetensors").is_file()


def test_a_killed_training_goes_on_from_its_last_checkpoint(tiny_project: Path) -> None:
    """`fieldwork train` dies by SIGKILL; the project stays readable and --resume finishes the run."""
    settings = [f"--set={k}={v}" for k, v in {**SMALL, "train.checkpoint_every": "0.3"}.items()]
    command = [
        sys.executable,
        "-m",
        "fieldwork.nerfcore",
        "train",
        str(tiny_project),
        "--run",
        "killed",
        "--preset=draft",
    ]
    checkpoint = tiny_project / "runs" / "killed" / "field.safetensors"
    process = subprocess.Popen([*command, *settings, "--steps=100000", "--quiet"])
    deadline = time.monotonic() + 120
    while not checkpoint.is_file() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    assert process.wait() == -9
    steps = read_checkpoint(checkpoint, torch.device("cpu"))[1]["steps"]
    assert steps > 0
    result = train(tiny_project, "killed", steps + 5, resume=True)
    assert result["steps"] == steps + 5
    assert not list(checkpoint.parent.glob(".field*"))


def test_a_full_disk_ends_with_a_sentence_and_keeps_the_old_checkpoint(
    tiny_project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    from fieldwork.nerfcore.train import checkpoint

    train(tiny_project, "full", 10)
    path = tiny_project / "runs" / "full" / "field.safetensors"
    before = path.read_bytes()

    def no_room(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_file", no_room)
    with pytest.raises(DiskError, match="No space left"):
        train(tiny_project, "full", 20, resume=True)
    assert path.read_bytes() == before


def test_a_damaged_checkpoint_is_named(tiny_project: Path) -> None:
    train(tiny_project, "damaged", 5)
    path = tiny_project / "runs" / "damaged" / "field.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ProjectError, match=r"field\.safetensors is damaged"):
        run_verb("evaluate", EvaluateParams(project=tiny_project, run="damaged"), Reporter())


@pytest.mark.parametrize(
    ("stage", "name", "value"),
    [("field", "levels", 4), ("sampling", "resolution", 16), ("train", "refine_poses", True)],
)
def test_a_training_whose_settings_were_edited_cannot_go_on(
    tiny_project: Path, stage: str, name: str, value: object
) -> None:
    train(tiny_project, "edited", 5)
    path = tiny_project / "runs" / "edited" / "config.json"
    info = json.loads(path.read_text())
    info["config"][stage][name] = value
    path.write_text(json.dumps(info))
    with pytest.raises(ProjectError, match=r"field\.safetensors holds a field of another shape than config\.json"):
        train(tiny_project, "edited", 10, resume=True)


def test_a_missing_run_is_named(tiny_project: Path) -> None:
    with pytest.raises(ProjectError, match="no run “nothing”"):
        run_verb("evaluate", EvaluateParams(project=tiny_project, run="nothing"), Reporter())


def test_one_image_is_not_enough(tiny_project: Path, tmp_path: Path) -> None:
    project = json.loads((tiny_project / "project.json").read_text())
    poses = json.loads((tiny_project / "poses" / "poses.json").read_text())
    project["images"], poses["images"] = project["images"][:1], poses["images"][:1]
    (tmp_path / "poses").mkdir()
    (tmp_path / "images").symlink_to(tiny_project / "images")
    (tmp_path / "labels").symlink_to(tiny_project / "labels")
    (tmp_path / "project.json").write_text(json.dumps(project))
    (tmp_path / "poses" / "poses.json").write_text(json.dumps(poses))
    with pytest.raises(TrainingError, match="1 posed training image"):
        train(tmp_path, "main", 5)


@pytest.mark.parametrize(
    "setting",
    [
        {"field__branch": "explicit"},
        {"field__branch": "implicit"},
        {"field__fusion": "blend"},
        pytest.param({"field__blend_by": "density"}, marks=pytest.mark.slow),
        pytest.param({"field__appearance": "4"}, marks=pytest.mark.slow),
        pytest.param({"sampling__pdf": "uniform"}, marks=pytest.mark.slow),
        {"sampling__pdf": "literal"},
        pytest.param({"sampling__importance": "boundary"}, marks=pytest.mark.slow),
        {"render__accumulate": "logits"},
        {"loss__rgb": "mse"},
        pytest.param({"loss__sparsity": "cauchy"}, marks=pytest.mark.slow),
        pytest.param({"loss__distortion_weight": "0"}, marks=pytest.mark.slow),
        pytest.param({"loss__opacity_weight": "0.01"}, marks=pytest.mark.slow),
        pytest.param({"loss__detach_weights": "true"}, marks=pytest.mark.slow),
        pytest.param({"scene__background": "white"}, marks=pytest.mark.slow),
        {"scene__contraction": "on"},
        pytest.param({"train__labelled_share": "0.2"}, marks=pytest.mark.slow),
        pytest.param({"train__label_noise": "0.3"}, marks=pytest.mark.slow),
        pytest.param({"train__noise": "0.05"}, marks=pytest.mark.slow),
        pytest.param({"train__view_share": "0.5"}, marks=pytest.mark.slow),
    ],
    ids=lambda s: "-".join(f"{k}={v}" for k, v in s.items()),
)
def test_every_choice_changes_what_is_learned_and_stays_finite(tiny_project: Path, setting: dict[str, str]) -> None:
    if not (tiny_project / "runs" / "default" / "field.safetensors").is_file():
        train(tiny_project, "default", 40)
    result = train(tiny_project, "choice", 40, **setting)
    assert math.isfinite(result["psnr_train"])
    ours, default = tensors(tiny_project, "choice"), tensors(tiny_project, "default")
    assert all(bool(torch.isfinite(t).all()) for t in ours.values() if t.is_floating_point())
    same = [n for n in default if n in ours and ours[n].shape == default[n].shape and torch.equal(ours[n], default[n])]
    assert "model.field.density_head.weights.0" not in same


def test_settings_are_checked() -> None:
    assert preset_names() == ["draft", "high", "standard"]
    with pytest.raises(SettingError, match=r"field\.colour"):
        make_config("standard", {"field.colour": "red"})
    with pytest.raises(SettingError, match=r"train\.steps"):
        make_config("standard", {"train.steps": "-1"})
    with pytest.raises(SettingError, match="no preset “best”"):
        make_config("best")


def test_the_settings_page_is_up_to_date() -> None:
    import importlib.util

    script = Path(__file__).with_name("make_settings.py")
    spec = importlib.util.spec_from_file_location("make_settings", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.TARGET.read_text(encoding="utf-8") == module.settings_page()
