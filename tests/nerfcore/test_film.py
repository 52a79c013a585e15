"""Frames for Blender: lenses, passes, Cryptomatte, objects in front, and the engine's requests for them."""

from __future__ import annotations

import json
import queue
import struct
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.engine import protocol as rpc
from fieldwork.nerfcore.engine.frames import Frames
from fieldwork.nerfcore.errors import Cancelled, InputError, ProjectError
from fieldwork.nerfcore.film.cryptomatte import Coverage, id_bits, id_of, manifest, murmur3
from fieldwork.nerfcore.film.exposure import Exposure, expose, surface_normals
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.film.lens_rays import camera_directions, on_aperture, scene_rays
from fieldwork.nerfcore.film.shared_file import HEADER, SharedFile
from fieldwork.nerfcore.film.shot import Aperture, Lens, Shot
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.instances import Instance, write_instances
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.live import live_ball
from pydantic import ValidationError

W, H = 96, 64
ABOVE = np.eye(4)
ABOVE[2, 3] = 2.0  # looks down at the ball
SIDE = np.array([[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # looks along y at it, z is up


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return live_ball(tmp_path_factory.mktemp("film") / "ball")


@pytest.fixture(scope="module")
def store() -> FieldStore:
    return FieldStore()


def lens(pose: np.ndarray = SIDE, **more: Any) -> dict[str, Any]:
    plain = {"kind": "perspective", "width": W, "height": H, "scale": (120, 120), "center": (W / 2, H / 2)}
    return {**plain, "clip": (0.1, 100), "poses": [pose.tolist()], **more}


def take(ball: Path, store: FieldStore, passes: list[str], item: Any = (), **more: Any) -> dict[str, np.ndarray]:
    """Passes of a shot, first row on top."""
    return {name: pixels[::-1] for name, pixels in taken(ball, store, passes, item, **more).passes.items()}


def taken(ball: Path, store: FieldStore, passes: list[str], item: Any = (), **more: Any) -> Exposure:
    field = {"name": "Ball", "project": ball, "scene_from_capture": np.eye(4).tolist(), **dict(item)}
    shot = {"lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": passes, "file": "none", **more}
    return expose(Shot.model_validate(shot), store, Reporter())


# Lenses


def test_a_perspective_lens_is_the_pinhole_of_the_engine() -> None:
    camera = Camera(width=W, height=H, fx=90, fy=80, cx=41, cy=37)
    from fieldwork.nerfcore.geometry.cameras import rays

    pixels = np.random.default_rng(0).uniform(0, 60, (50, 2))
    expected, _ = rays(camera, pixels)
    own = Lens.model_validate(lens(scale=(90, 80), center=(41, 37)))
    _, found = camera_directions(own, torch.tensor(pixels, dtype=torch.float32))
    assert np.allclose(found.numpy() * [1, -1, -1], expected, atol=1e-6)


def test_panoramas_look_where_cycles_looks() -> None:
    full = Lens.model_validate(
        lens(kind="equirectangular", longitudes=(-np.pi, np.pi), latitudes=(-np.pi / 2, np.pi / 2))
    )
    points = torch.tensor([[W / 2, H / 2], [0.75 * W, H / 2], [W / 4, H / 2], [W / 2, 0.0]])
    _, found = camera_directions(full, points)
    ahead, right, left, up = [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0]
    assert np.allclose(found.numpy(), [ahead, right, left, up], atol=1e-6)
    half = Lens.model_validate(lens(kind="equirectangular", longitudes=(-np.pi / 2, np.pi / 2), latitudes=(0, 1.0)))
    _, found = camera_directions(half, torch.tensor([[0.0, H], [W, H]]))
    assert np.allclose(found.numpy(), [left, right], atol=1e-6)
    fish = Lens.model_validate(lens(kind="equidistant", angle=np.pi))
    _, found = camera_directions(fish, torch.tensor([[W / 2, H / 2], [W, H / 2], [W / 2, 0.0], [0.0, 0.0]]))
    assert np.allclose(found[:3].numpy(), [ahead, right, up], atol=1e-6)
    assert found[3].isnan().all()
    solid = Lens.model_validate(lens(kind="equisolid", angle=np.pi, focal=10.5, sensor=(36, 24)))
    _, found = camera_directions(solid, torch.tensor([[W / 2 + W / 36 * 10.5, H / 2]]))
    # r = 2 f sin(θ / 2) with r = f
    assert np.allclose(found.numpy(), [[np.sin(np.pi / 3), 0, -np.cos(np.pi / 3)]], atol=1e-6)


def test_an_aperture_keeps_what_is_in_focus_and_has_its_shape() -> None:
    aperture = Aperture(radius=0.2, focus=3.0)
    own = Lens.model_validate(lens(aperture=aperture.model_dump()))
    chance = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    pixels = torch.tensor([[20.0, 11.0]]).expand(500, 2)
    origins, directions = scene_rays(own, pixels, chance)
    _, straight = scene_rays(own, pixels[:1])
    sharp = torch.tensor(SIDE[:3, 3]).float() + straight[0] * 3 / straight[0, 1]
    length = ((sharp - origins) * directions).sum(1, keepdim=True)
    assert (origins + directions * length - sharp).abs().max() < 1e-5
    assert (origins - origins.mean(0)).norm(dim=1).max() > 0.15
    for blades in (3, 6):
        one = Aperture(radius=1, focus=1, blades=blades)
        u, v = torch.rand(2, 4000, generator=torch.Generator().manual_seed(1))
        places = on_aperture(one, u, v)
        radius = places.norm(dim=1)
        assert radius.max() <= 1 + 1e-6
        # A regular polygon has a corner at the angle 0 and reaches the circle there, and cos(π / n) in between.
        angle = torch.atan2(places[:, 1], places[:, 0]) % (2 * np.pi / blades)
        middle = (angle - np.pi / blades).abs() < 0.05
        assert radius[middle].max() < np.cos(np.pi / blades) + 0.01


def test_a_shutter_spreads_rays_over_the_poses() -> None:
    later = SIDE.copy()
    later[0, 3] = 1.0
    own = Lens.model_validate({**lens(), "poses": [SIDE.tolist(), later.tolist()]})
    chance = torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.25], [0.5, 0.5, 1.0]])
    origins, _ = scene_rays(own, torch.tensor([[W / 2, H / 2]]).expand(3, 2), chance)
    assert np.allclose(origins[:, 0].numpy(), [0, 0.25, 1], atol=1e-6)
    middle, _ = scene_rays(own, torch.tensor([[W / 2, H / 2]]))
    assert float(middle[0, 0]) == pytest.approx(0.5)


# Passes


@pytest.mark.parametrize("baked", [False, True])
def test_passes_are_those_of_the_ball(ball: Path, store: FieldStore, baked: bool) -> None:
    wanted = ["Combined", "Depth", "Position", "Normal", "Class Index", "Class Color", "Confidence"]
    found = take(ball, store, wanted, {"baked": baked}, samples=4)
    middle = (H // 2, W // 2)
    assert found["Combined"][(*middle, 3)] > 0.95
    assert found["Combined"][2, 2, 3] < 0.05
    assert found["Depth"][(*middle, 0)] == pytest.approx(1.5, abs=0.08)
    assert found["Depth"][2, 2, 0] == pytest.approx(1e10)
    assert found["Position"][middle] == pytest.approx([0, -0.5, 0], abs=0.08)
    solid = found["Combined"][..., 3] > 0.99
    assert found["Normal"][solid].mean(0) == pytest.approx([0, -0.8, 0], abs=0.15)
    assert np.linalg.norm(found["Normal"][solid], axis=1) == pytest.approx(np.ones(solid.sum()), abs=1e-4)
    assert found["Class Index"][H // 2 - 12, W // 2, 0] == 1
    assert found["Class Index"][H // 2 + 12, W // 2, 0] == 2
    red, blue = found["Class Color"][H // 2 - 12, W // 2], found["Class Color"][H // 2 + 12, W // 2]
    assert red[:3] == pytest.approx([0.604, 0.033, 0.033], abs=0.05)  # sRGB 0.8, 0.2, 0.2 as light
    assert blue[2] > 0.5
    assert found["Confidence"][H // 2 - 12, W // 2, 0] > 0.8
    assert found["Confidence"][2, 2, 0] == 0


def test_the_field_and_the_baked_field_look_alike(ball: Path, store: FieldStore) -> None:
    field, baked = (take(ball, store, ["Combined"], {"baked": b})["Combined"] for b in (False, True))
    assert np.abs(field - baked).mean() < 0.02


def test_the_transform_of_the_object_moves_scales_and_turns_the_field(ball: Path, store: FieldStore) -> None:
    """Twice as large, twice as far: the same picture, at twice the depth; upside down: classes change places."""
    plain = take(ball, store, ["Combined", "Depth", "Class Index"])
    double = np.diag([2.0, 2, 2, 1])
    far = lens(double @ SIDE @ np.diag([0.5, 0.5, 0.5, 1]))
    large = take(ball, store, ["Combined", "Depth"], {"scene_from_capture": double.tolist()}, lens=far)
    assert np.abs(large["Combined"] - plain["Combined"]).max() < 0.01
    solid = plain["Combined"][..., 3] > 0.9
    assert large["Depth"][solid] == pytest.approx(2 * plain["Depth"][solid], rel=1e-3)
    turned = np.diag([1.0, -1, -1, 1])
    over = take(ball, store, ["Class Index"], {"scene_from_capture": turned.tolist()})
    assert over["Class Index"][H // 2 - 12, W // 2, 0] == 2
    assert over["Class Index"][H // 2 + 12, W // 2, 0] == 1


@pytest.mark.parametrize("baked", [False, True])
def test_clipping_and_crop_boxes_cut_exactly(ball: Path, store: FieldStore, baked: bool) -> None:
    plain = take(ball, store, ["Combined"], {"baked": baked})["Combined"][..., 3]
    near = take(ball, store, ["Combined", "Depth"], {"baked": baked}, lens=lens(clip=(2.0, 100)))
    assert near["Depth"][near["Depth"] < 1e9].min() >= 2.0
    far = take(ball, store, ["Combined"], {"baked": baked}, lens=lens(clip=(0.1, 1.4)))["Combined"][..., 3]
    assert plain.max() > 0.95
    assert far.max() < 0.05
    # The right half of the world, up to z = 0.
    crop = np.diag([1.0, 1, 1, 1])
    crop[:3, 3] = 1, 0, -1
    cut = take(ball, store, ["Combined"], {"baked": baked, "crop": crop.tolist()})["Combined"][..., 3]
    assert np.abs(cut - plain)[H // 2 + 2 :, W // 2 + 2 :].max() < 0.12
    assert cut[: H // 2 - 6].max() < 0.05
    assert cut[:, : W // 2 - 2].max() < 0.05


@pytest.mark.parametrize("baked", [False, True])
def test_hidden_classes_show_what_is_behind(ball: Path, store: FieldStore, baked: bool) -> None:
    plain = take(ball, store, ["Combined"], {"baked": baked})["Combined"][..., 3]
    above, below = np.s_[: H // 2 - 4], np.s_[H // 2 + 2 :]
    only = {"baked": baked, "classes": {1: {"opacity": 0.0}}}
    found = take(ball, store, ["Combined", "Class Index"], only)
    opacity = found["Combined"][..., 3]
    # Inside of the ball, where no photo looks, the field is of any class.
    assert opacity[above].sum() < 0.4 * plain[above].sum()
    assert np.abs(opacity - plain)[below].mean() < 0.02
    index = found["Class Index"][opacity > 0.5]
    assert (index == 1).mean() < 0.06
    dim = {"baked": baked, "classes": {1: {"opacity": 0.1}}}
    dimmed = take(ball, store, ["Combined"], dim)["Combined"][..., 3]
    assert opacity[above].sum() < dimmed[above].sum() < plain[above].sum()


def test_tints_and_the_slider_recolour(ball: Path, store: FieldStore) -> None:
    upper = (H // 2 - 12, W // 2)
    green = {1: {"tint": 1.0, "color": (0.0, 1.0, 0.0)}, 2: {"color": (0.0, 0.0, 1.0)}}
    tinted = take(ball, store, ["Combined"], {"classes": green})["Combined"]
    plain = take(ball, store, ["Combined"])["Combined"]
    assert tinted[upper][1] > 0.9
    assert tinted[upper][0] < 0.05
    assert tinted[H // 2 + 12, W // 2] == pytest.approx(plain[H // 2 + 12, W // 2], abs=0.03)
    labels = take(ball, store, ["Combined"], {"look": 1.0})["Combined"]
    assert labels[upper][:3] == pytest.approx([0.604, 0.033, 0.033], abs=0.03)
    sure = take(ball, store, ["Combined"], {"look": 2.0})["Combined"]
    assert sure[upper][0] == pytest.approx(sure[upper][2], abs=1e-4)
    assert sure[upper][0] > 0.7


def test_of_several_fields_the_nearest_is_before_the_others(ball: Path, store: FieldStore) -> None:
    behind = np.eye(4)
    behind[:3, 3] = 0.3, 1.5, 0
    fields = [
        {"name": name, "project": ball, "scene_from_capture": matrix.tolist(), "look": look}
        for name, matrix, look in (("Back", behind, 1.0), ("Front", np.eye(4), 0.0))
    ]
    both = take(ball, store, ["Combined", "Depth", "CryptoAsset00"], fields=fields)
    one = take(ball, store, ["Combined", "Depth"])
    solid = one["Combined"][..., 3] > 0.999
    assert np.abs(both["Combined"] - one["Combined"])[solid].max() < 0.01
    assert both["Depth"][solid] == pytest.approx(one["Depth"][solid], rel=1e-4)
    ids = both["CryptoAsset00"][..., 0]
    assert (ids[solid] == np.float32(id_of("Front"))).all()
    assert (ids == np.float32(id_of("Back"))).sum() > 20


def test_a_border_is_a_part_of_the_whole_picture(ball: Path, store: FieldStore) -> None:
    whole = take(ball, store, ["Combined"])["Combined"]
    part = take(ball, store, ["Combined"], border=(30, 12, 70, 40))["Combined"]
    assert np.abs(part - whole[12:40, 30:70]).max() < 1e-4


def test_a_world_is_behind_all(ball: Path, store: FieldStore) -> None:
    found = take(ball, store, ["Combined"], world=(0.2, 0.4, 0.6))["Combined"]
    assert found[2, 2] == pytest.approx([0.2, 0.4, 0.6, 1.0], abs=0.01)
    assert found[..., 3] == pytest.approx(np.ones((H, W)), abs=1e-5)


def test_normals_face_the_camera_and_stop_at_borders() -> None:
    y, x = np.mgrid[0:8, 0:8].astype(float)
    position = np.stack([x, -y, np.where(x < 4, 0.0, -5.0)], -1)
    position[0, 0] = np.nan
    ahead = np.broadcast_to([0.0, 0.0, -1.0], position.shape)
    normal = surface_normals(position, ahead)
    assert normal[4, 3] == pytest.approx([0, 0, 1])
    assert normal[4, 4] == pytest.approx([0, 0, 1])
    assert normal[0, 0] == pytest.approx([0, 0, 0])
    assert normal[0, 1] == pytest.approx([0, 0, 1])


# Cryptomatte


def test_ids_are_those_of_the_specification() -> None:
    assert murmur3(b"hello") == 0x248BFA47
    assert murmur3(b"bunny") == 0x13851A76
    assert murmur3("Straße ü".encode()) == murmur3("Straße ü".encode())
    for name in (f"name{n}" for n in range(3000)):
        assert id_bits(name) >> 23 & 255 not in (0, 255)
        assert np.isfinite(id_of(name))
    assert struct.pack("<f", id_of("bunny")) == struct.pack("<I", 0x13851A76)
    assert json.loads(manifest(["bunny"])) == {"bunny": "13851a76"}


def test_coverage_is_ranked_and_adds_up() -> None:
    coverage = Coverage(2)
    one, other = np.float32(id_of("one")), np.float32(id_of("other"))
    for number in range(4):
        ids = np.array([one if number else other, 0], np.float32)
        coverage.add(ids, np.array([0.25, 0.25], np.float32))
    first, second = coverage.ranked(4)
    assert first[0] == pytest.approx([one, 0.75, other, 0.25])
    assert (first[1] == 0).all()
    assert (second == 0).all()


def test_matte_of_a_class_is_its_share_of_the_pixel(ball: Path, store: FieldStore) -> None:
    passes = ["Combined", "CryptoMaterial00", "CryptoObject00", "CryptoAsset00"]
    found = take(ball, store, passes, samples=16)
    pixels = found["CryptoMaterial00"]
    top, bottom = (np.float32(id_of(name)) for name in ("top", "bottom"))
    matte = {name: sum(np.where(pixels[..., k] == i, pixels[..., k + 1], 0) for k in (0, 2)) for name, i in
             (("top", top), ("bottom", bottom))}  # fmt: skip
    assert matte["top"][H // 2 - 12, W // 2] > 0.95
    assert matte["bottom"][H // 2 - 12, W // 2] == 0
    solid = found["Combined"][..., 3] > 0.99
    assert (matte["top"] + matte["bottom"])[solid].mean() > 0.97
    assert (matte["top"] + matte["bottom"] <= found["Combined"][..., 3] + 1e-3).all()
    # Without a mesh that tells instances apart, a class of an object is one.
    assert found["CryptoObject00"][H // 2 - 12, W // 2, 0] == np.float32(id_of("Ball.top"))


def test_instances_are_those_of_the_mesh(ball: Path, store: FieldStore, tmp_path: Path) -> None:
    import shutil

    project = Path(shutil.copytree(ball, tmp_path / "p"))
    folder = project / "exports" / "main"
    folder.mkdir(parents=True)
    points = np.array([[x, -0.5, z] for x in (-0.3, 0.3) for z in (0.2, -0.2)])
    vertices = np.concatenate([points + shift for shift in ([0, 0, 0.02], [0.02, 0, -0.02], [-0.02, 0, -0.02])])
    arrays = {
        "vertices": vertices,
        "faces": np.arange(12).reshape(3, 4).T,
        "normals": vertices * 0,
        "colors": np.zeros((12, 3), np.uint8),
        "class_id": np.ones(12, np.int32),
        "face_class": np.array([1, 2, 1, 2]),
        "face_instance": np.array([1, 0, 2, 0], np.uint32),
    }
    np.savez(folder / "mesh.npz", **arrays)
    write_instances(folder, [Instance(n + 1, name, 1, 1.0, (0, 0, 0)) for n, name in enumerate(("left", "right"))])
    exposure = taken(project, store, ["CryptoObject00"])
    pixels = exposure.passes["CryptoObject00"][::-1]
    assert pixels[H // 2 - 10, W // 2 - 12, 0] == np.float32(id_of("left"))
    assert pixels[H // 2 - 10, W // 2 + 12, 0] == np.float32(id_of("right"))
    assert {"left", "right"} <= json.loads(exposure.manifests["CryptoObject"]).keys()


# Objects


def plate(folder: Path, y: float, edge: float) -> Path:
    """A plate at a distance, left of a slanted edge."""
    vertices = np.array([[-5, y, -5], [edge - 0.2, y, -5], [edge + 0.2, y, 5], [-5, y, 5]])
    np.savez(folder / "plate.npz", vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    return folder / "plate.npz"


def over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a + (1 - a[..., 3:]) * b


@pytest.mark.parametrize("y", [-1.0, -0.1, 1.0])
def test_composited_objects_are_exact_at_edges(ball: Path, store: FieldStore, tmp_path: Path, y: float) -> None:
    """Before, within and behind the field: against the mean over samples of what each shows, with 64 of them."""
    file, paint = plate(tmp_path, y, 0.05), np.array([0.9, 0.3, 0.1, 1.0])
    wanted = ["FieldFront", "FieldBehind"]
    found = take(ball, store, wanted, samples=64, occluders=file)
    # What a renderer of objects gives with the same samples: the share of the samples that meet the plate.
    truth, objects = np.zeros((H, W, 4)), np.zeros((H, W, 4))
    from fieldwork.nerfcore.film.exposure import STEPS2

    for number in range(64):
        dx, dy = ((0.5 + number * step) % 1 for step in STEPS2)
        moved = lens(center=(W / 2 + 0.5 - dx, H / 2 + 0.5 - dy))
        one = take(ball, store, [*wanted, "Combined"], lens=moved, occluders=file)
        x = (np.arange(W) + dx - W / 2) / 120 * (y + 2)
        z = (H / 2 - np.arange(H) - dy) / 120 * (y + 2)
        hit = x[None] < 0.05 + 0.04 * z[:, None]
        painted = np.where(hit[..., None], paint, 0)
        objects += painted / 64
        truth += over(one["Combined"], painted) / 64
    mixed = over(found["FieldFront"], over(objects, found["FieldBehind"]))
    edge = (objects[..., 3] > 0.02) & (objects[..., 3] < 0.98)
    assert edge.sum() > H / 2
    assert np.abs(mixed - truth)[..., :3][edge].mean() < 1 / 255
    assert np.abs(mixed - truth)[..., :3].mean() < 1 / 255
    # Z Combine, which knows one depth a pixel, is worse: the pixel is one or the other.
    if y == -1.0:
        assert found["FieldBehind"][H // 2, W // 2 - 8, 3] > 0.9, "what is behind an object is kept for glass"
        assert found["FieldFront"][H // 2, W // 2 - 8, 3] < 0.05


# The engine


def test_shots_that_make_no_sense_are_refused(ball: Path) -> None:
    field = {"name": "Ball", "project": ball, "scene_from_capture": np.eye(4).tolist()}
    good = {"lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": ["Combined"], "file": "none"}
    Shot.model_validate(good)
    for wrong in (
        {"border": (0, 0, W + 1, H)},
        {"border": (5, 0, 5, H)},
        {"passes": ["Colour"]},
        {"passes": []},
        {"samples": 0},
        {"fields": []},
        {"lens": lens(poses=[])},
    ):
        with pytest.raises(ValidationError):
            Shot.model_validate({**good, **wrong})


def test_a_field_that_is_scaled_to_nothing_is_named(ball: Path, store: FieldStore) -> None:
    with pytest.raises(ProjectError, match="Ball"):
        take(ball, store, ["Combined"], {"scene_from_capture": np.diag([0.0, 1, 1, 1]).tolist()})


class Answers:
    """What the frames of an engine send."""

    def __init__(self) -> None:
        self.messages: queue.Queue[dict[str, Any]] = queue.Queue()
        self.seen: list[dict[str, Any]] = []
        self.frames = Frames(self.messages.put)

    def ask(self, number: int, **params: Any) -> None:
        self.frames.ask(rpc.Request(number, "frame", params))

    def answer(self, number: int, seconds: float = 120) -> dict[str, Any]:
        end = time.monotonic() + seconds
        while True:
            message = self.messages.get(timeout=end - time.monotonic())
            self.seen.append(message)
            if message.get("id") == number:
                return message


def request(ball: Path, file: Path, name: str, **more: Any) -> dict[str, Any]:
    field = {"name": "Ball", "project": str(ball), "baked": True, "scene_from_capture": np.eye(4).tolist()}
    return {"frame": name, "lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": ["Combined", "Depth"],
            "file": str(file), **more}  # fmt: skip


def shared(folder: Path, floats: int) -> Path:
    path = folder / "pixels"
    path.write_bytes(bytes(HEADER + 4 * floats))
    return path


def test_frames_come_through_the_file_and_load_the_field_once(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 5 * W * H)
    for number in range(100):
        answers.ask(number, **request(ball, file, f"f{number}"))
    results = [answers.answer(number)["result"] for number in range(100)]
    assert {result["loaded"] for result in results} == {1}
    data = file.read_bytes()
    assert struct.unpack("<q", data[:8])[0] == 200, "twice for each frame: begun and done"
    pixels = np.frombuffer(data[HEADER : HEADER + 16 * W * H], np.float32).reshape(H, W, 4)
    expected = taken(ball, FieldStore(), ["Combined"], {"baked": True}).passes["Combined"]
    assert np.allclose(pixels, expected, atol=1e-6)
    assert any(message.get("method") == "progress" for message in answers.seen)


def test_colours_come_sample_by_sample(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 5 * W * H)
    answers.ask(1, **request(ball, file, "one", samples=5))
    assert "result" in answers.answer(1)
    counters = [m["params"]["counter"] for m in answers.seen if m.get("params", {}).get("kind") == "pixels"]
    assert counters == [2, 4, 6, 8]


def test_a_frame_is_cancelled_within_two_seconds(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 5 * W * H)
    slow = request(ball, file, "slow", samples=4096)
    slow["fields"][0]["baked"] = False
    answers.ask(1, **slow)
    answers.ask(2, **request(ball, file, "next"))
    while answers.messages.get(timeout=60).get("params", {}).get("kind") != "pixels":
        pass
    begin = time.monotonic()
    answers.frames.cancel("slow")
    assert answers.answer(1)["error"]["code"] == rpc.CANCELLED
    assert time.monotonic() - begin < 2
    assert "result" in answers.answer(2), "others go on"


def test_wrong_frames_are_answered_with_sentences(ball: Path, tmp_path: Path) -> None:
    answers, file = Answers(), shared(tmp_path, 3)
    answers.ask(1, **request(ball, file, "small"))
    assert "bytes" in answers.answer(1)["error"]["message"]
    answers.ask(2, **request(ball, tmp_path / "none", "lost"))
    assert "none" in answers.answer(2)["error"]["message"]
    file = shared(tmp_path, 5 * W * H)
    answers.ask(3, **request(tmp_path / "nothing", file, "unknown"))
    assert "nothing" in answers.answer(3)["error"]["message"]
    answers.ask(4, **request(ball, file, "wrong", samples=0))
    assert answers.answer(4)["error"]["code"] == rpc.INVALID_PARAMS
    with pytest.raises(rpc.RpcError):
        answers.ask(5, **{**request(ball, file, "wrong"), "frame": ""})


def test_readers_notice_pixels_that_are_being_written(tmp_path: Path) -> None:
    """Ten thousand frames, read while they are written: every picture that the counter says is whole is whole."""
    size = 2000
    path = shared(tmp_path, size)
    file = SharedFile(path, {"Combined": (1, size // 4, 4)})
    done = threading.Event()

    def write() -> None:
        for number in range(10_000):
            file.write({"Combined": np.full((1, size // 4, 4), number, np.float32)})
        done.set()

    pixels = np.memmap(path, np.uint8, "r")
    counter, values = pixels[:8].view(np.int64), pixels[HEADER:].view(np.float32)
    writer = threading.Thread(target=write)
    writer.start()
    whole, seen = 0, set()
    while not done.is_set():
        before = int(counter[0])
        copy = values.copy()
        if before % 2 == 0 and int(counter[0]) == before:
            assert (copy == copy[0]).all()
            whole += 1
            seen.add(float(copy[0]))
    writer.join()
    assert int(counter[0]) == 20_000
    assert values[0] == 9_999
    assert whole > 0
    with pytest.raises(InputError):
        SharedFile(path, {"Combined": (1, 1, 4)})


def test_cancel_stops_an_exposure(ball: Path, store: FieldStore) -> None:
    report = Reporter()
    report.cancel()
    field = {"name": "Ball", "project": ball, "scene_from_capture": np.eye(4).tolist()}
    shot = {"lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": ["Combined"], "file": "none"}
    with pytest.raises(Cancelled):
        expose(Shot.model_validate(shot), store, report)


# Splats


def test_splats_look_like_the_baked_field(ball: Path, store: FieldStore) -> None:
    """Read by another library, and drawn here as circles, the nearest over the others."""
    import trimesh
    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    (path,) = run_verb("export", ExportParams(project=ball, to="splats"), Reporter())["files"]
    assert Path(path).name == "ball-splats.ply"
    data = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    names = list(data) if isinstance(data, dict) else list(data.dtype.names)
    assert names[:3] == ["x", "y", "z"]
    assert names[-2:] == ["class_id", "class_probability"]
    values = {name: np.asarray(data[name]).reshape(-1) for name in names}
    place = np.stack([values[axis] for axis in "xyz"], 1)
    solid = values["opacity"] > 0
    radius = np.linalg.norm(place[solid], axis=1)
    assert np.median(radius) == pytest.approx(0.5, abs=0.08)
    high = (radius > 0.45) & (np.abs(place[solid][:, 2]) > 0.1)
    assert (np.where(place[solid][high, 2] > 0, 1, 2) == values["class_id"][solid][high]).mean() > 0.85
    # The picture from the side.
    way = place - SIDE[:3, 3]
    order = np.argsort(way[:, 1])
    unit = way / np.linalg.norm(way, axis=1, keepdims=True)
    basis = 0.4886025119029199 * np.stack([-unit[:, 1], unit[:, 2], -unit[:, 0]], 1)
    rest = np.stack([values[f"f_rest_{n}"] for n in range(9)], 1).reshape(-1, 3, 3)
    color = 0.5 + 0.28209479177387814 * np.stack([values[f"f_dc_{n}"] for n in range(3)], 1)
    color = (color + np.einsum("nck,nk->nc", rest, basis)).clip(0, 1)
    x, y = 120 * way[:, 0] / way[:, 1] + W / 2, H / 2 - 120 * way[:, 2] / way[:, 1]
    sigma = 120 * np.exp(values["scale_0"]) / way[:, 1]
    peak = 1 / (1 + np.exp(-values["opacity"]))
    picture, left = np.zeros((H, W, 3)), np.ones((H, W))
    rows, columns = np.mgrid[0:H, 0:W] + 0.5
    for n in order:
        near = max(int(3 * sigma[n]) + 1, 2)
        part = np.s_[max(int(y[n]) - near, 0) : int(y[n]) + near, max(int(x[n]) - near, 0) : int(x[n]) + near]
        distance = (columns[part] - x[n]) ** 2 + (rows[part] - y[n]) ** 2
        alpha = peak[n] * np.exp(-distance / (2 * sigma[n] ** 2))
        picture[part] += (left[part] * alpha)[..., None] * color[n]
        left[part] *= 1 - alpha
    field = take(ball, store, ["Combined"], {"baked": True})["Combined"]
    assert np.abs((1 - left) - field[..., 3]).mean() < 0.05
    inner = field[..., 3] > 0.99
    srgb = np.where(
        field[..., :3] > 0.0031308, 1.055 * field[..., :3].clip(1e-9) ** (1 / 2.4) - 0.055, 12.92 * field[..., :3]
    )
    assert np.abs(picture - srgb)[inner].mean() < 0.06


def test_splats_need_a_baked_field(ball: Path, tmp_path: Path) -> None:
    import shutil

    from fieldwork.nerfcore.params import ExportParams
    from fieldwork.nerfcore.verbs import run_verb

    project = Path(shutil.copytree(ball, tmp_path / "p"))
    shutil.rmtree(project / "runs" / "main" / "voxels")
    with pytest.raises(ProjectError, match="no baked field"):
        run_verb("export", ExportParams(project=project, to="splats"), Reporter())
