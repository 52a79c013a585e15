"""What `reconstruct` hands on, and what it says about poses that are there already."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.capture.ingest import new
from fieldwork.nerfcore.errors import DiskError, SettingError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.params import BlocksParams, MeshParams, NewParams, Params, ReconstructParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.verdict import verdict
from fieldwork.nerfcore.workflows import reconstruct as module
from fieldwork.tests.nerfcore.support.photos import folder_of
from PIL import Image
from pydantic import ValidationError


class Reached(Exception):
    """The first stage began."""


def first_stage(monkeypatch: pytest.MonkeyPatch, params: ReconstructParams) -> tuple[NewParams, list[str]]:
    """The parameters of the first stage of a reconstruction, and what was said before it."""
    seen: list[NewParams] = []

    def do(self: module.Pipeline, verb: str, values: NewParams) -> None:
        seen.append(values)
        raise Reached

    monkeypatch.setattr(module.Pipeline, "do", do)
    report = Reporter()
    with pytest.raises(Reached):
        module.reconstruct(params, report)
    return seen[0], report.warnings


@pytest.mark.parametrize(("file", "kind"), [("transforms.json", "transforms.json"), ("sparse/0/cameras.txt", "COLMAP")])
@pytest.mark.parametrize("inside", [True, False])
def test_poses_that_are_there_are_offered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, kind: str, inside: bool
) -> None:
    root = tmp_path / "capture"
    photos = folder_of(root / "images", 3)
    for name in {file, file.replace("cameras", "images")}:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("{}")
    _, (warning,) = first_stage(monkeypatch, ReconstructParams(photos=photos if inside else root, out=tmp_path / "p"))
    assert kind in warning
    assert f"fieldwork import {root}" in warning


def test_settings_are_checked_before_anything_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.Pipeline, "do", lambda *_: pytest.fail("a stage began"))
    values = {"photos": folder_of(tmp_path / "photos"), "out": tmp_path / "p", "set": {"loss.semantic": "0.1"}}
    with pytest.raises(SettingError, match=r"loss\.semantic"):
        module.reconstruct(ReconstructParams.model_validate(values), Reporter())
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize(
    ("name", "file", "words"),
    [
        ("blend", "scene.obj", "no Blender file"),
        ("blend", "taken/scene.blend", "a file is in its way"),
        ("report", "taken/report.html", "a file is in its way"),
        ("report", "p.html", "a file is in its way"),
        ("renders", "taken", "a file is in its way"),
    ],
)
def test_files_to_write_are_checked_before_anything_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, file: str, words: str
) -> None:
    monkeypatch.setattr(module.Pipeline, "do", lambda *_: pytest.fail("a stage began"))
    (tmp_path / "taken").write_text("")
    (tmp_path / "p.html").mkdir()
    values = {"photos": folder_of(tmp_path / "photos"), "out": tmp_path / "p", name: tmp_path / file}
    with pytest.raises((SettingError, DiskError), match=words):
        module.reconstruct(ReconstructParams.model_validate(values), Reporter())
    assert not (tmp_path / "p").exists()


def test_nothing_is_said_of_photos_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = folder_of(tmp_path / "capture" / "photos", 3)
    values, warnings = first_stage(monkeypatch, ReconstructParams(photos=photos, out=tmp_path / "p", mask_mode="empty"))
    assert warnings == []
    assert values.mask_mode == "empty"


def all_stages(
    monkeypatch: pytest.MonkeyPatch, folder: Path, made: dict[str, Any], **asked: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The parameters of the stages of a reconstruction that do nothing, and its result; `made`: results by verb."""
    seen = {}

    def do(self: module.Pipeline, verb: str, values: Params) -> None:
        seen[verb] = values
        self.results[verb], self.seconds[verb] = made.get(verb, {}), 0.0

    monkeypatch.setattr(module.Pipeline, "do", do)
    monkeypatch.setattr("fieldwork.nerfcore.train.reuse.held_out", lambda project, run: False)
    params = ReconstructParams(photos=folder_of(folder / "photos", 3), out=folder / "p", **asked)
    return seen, module.reconstruct(params, Reporter())


@pytest.mark.parametrize(("asked", "made"), [({}, (200_000, "auto")), ({"faces": 0, "texture": 0}, (None, None))])
def test_the_mesh_is_of_a_size_one_can_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, int], made: tuple[int | None, int | str | None]
) -> None:
    seen, _ = all_stages(monkeypatch, tmp_path, {}, **asked)
    assert (seen["mesh"].faces, seen["mesh"].texture) == made


def test_the_mesh_is_closed_as_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, asked in enumerate(({"close_gaps": 5.0}, {"watertight": True}, {})):
        seen, _ = all_stages(monkeypatch, tmp_path / str(number), {}, **asked)
        for name, usual in (("close_gaps", 0.0), ("watertight", False)):
            assert getattr(seen["mesh"], name) == asked.get(name, usual)
    with pytest.raises(ValidationError, match="close_gaps"):
        ReconstructParams(photos=tmp_path, out=tmp_path / "p", close_gaps=21)


def test_a_texture_has_a_size_or_as_many_texels_as_the_photos_need(tmp_path: Path) -> None:
    for given, taken in (("auto", "auto"), ("512", 512), (16384, 16384), (None, None)):
        assert MeshParams.model_validate({"project": tmp_path, "texture": given}).texture == taken
        assert BlocksParams.model_validate({"project": tmp_path, "texture": given}).texture == taken
    for wrong in (1, 63, 16385, "large", 0.5):
        with pytest.raises(ValidationError, match=f"{wrong} is no size of a texture; give 64 to 16384 pixels, or auto"):
            MeshParams.model_validate({"project": tmp_path, "texture": wrong})
    for said in ("0", "none"):
        assert ReconstructParams.model_validate({"photos": tmp_path, "out": tmp_path, "texture": said}).texture is None


def test_too_few_triangles_are_refused_before_any_work(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 3)
    with pytest.raises(ValidationError, match="3 is too few for a surface; give 0 for all there are, or 100 and more"):
        ReconstructParams(photos=photos, out=tmp_path / "p", faces=3)
    with pytest.raises(ValidationError, match="99 is too few for a surface; give 0 for all there are, or 100 and more"):
        MeshParams(project=tmp_path, faces=99)
    assert MeshParams(project=tmp_path, faces=100).faces == 100
    for every in (MeshParams(project=tmp_path, faces=0), BlocksParams(project=tmp_path, faces=0)):
        assert every.faces is None


def test_as_many_views_are_rendered_as_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, _ = all_stages(monkeypatch, tmp_path, {}, render_count=3)
    assert seen["render"].orbit == 3


def test_the_blend_comes_before_what_says_how_good_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, _ = all_stages(monkeypatch, tmp_path, {}, blend=tmp_path / "scene.blend")
    assert list(seen) == ["new", "poses", "train", "mesh", "blend", "render"]


def test_pictures_after_a_short_training_are_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(width=800, height=600, fx=700, fy=700, cx=400, cy=300)
    monkeypatch.setattr("fieldwork.nerfcore.render.verb.orbit_cameras", lambda scene, count: [("a", camera, None)])
    monkeypatch.setattr(module, "load_scene", lambda folder, holdout: None)
    monkeypatch.setattr(module, "holdout_of", lambda folder, run: 8)
    unknown, _ = all_stages(monkeypatch, tmp_path / "a", {}, time_limit=60)
    assert unknown["render"].size == (200, 150)  # how fast the field renders is not known
    # 8 pictures in a fifth of 90 seconds: 18 s.
    for speed, size in ((8 * 800 * 600 / 18, (800, 600)), (8 * 400 * 300 / 18, (400, 300))):
        monkeypatch.setattr(module, "read_metrics", lambda folder, speed=speed: {"test": {"rps": speed}})
        seen, _ = all_stages(monkeypatch, tmp_path / str(size[0]), {}, time_limit=60)
        assert (seen["render"].size, seen["render"].orbit) == (size, 8)


def test_the_verdict_is_the_worst_of_the_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = {
        "poses": {"verdict": verdict([("weak", "Few photos.")])},
        "train": {"verdict": verdict([])},
        "mesh": {"verdict": verdict([("failed", "Scraps.")])},
    }
    _, result = all_stages(monkeypatch, tmp_path, made)
    assert result["verdict"] == {"level": "failed", "reasons": ["mesh: Scraps.", "poses: Few photos."]}


def test_the_meaning_of_masks_can_be_changed(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 3)
    (photos / "masks").mkdir()
    Image.new("L", (320, 200), 255).save(photos / "masks" / "p0.png")
    for mode in ("ignore", "empty", "ignore"):
        new(NewParams(photos=photos, project=tmp_path / "p", mask_mode=mode), Reporter())
        assert load_project(tmp_path / "p").mask_mode == mode


def mask(kind: str) -> Image.Image:
    """A mask around an object, one of an object that stands on the lower border, one that hides a passer-by, or the sky."""
    picture = Image.new("L", (320, 200), 0 if kind in ("object", "standing") else 255)
    boxes = {"object": (90, 40, 230, 160), "standing": (90, 40, 230, 200), "passer-by": (0, 40, 60, 200)}
    box = boxes.get(kind, (0, 0, 320, 70))
    picture.paste(255 - picture.getpixel((160, 195) if kind != "standing" else (0, 0)), box)
    return picture


@pytest.mark.parametrize(
    ("kinds", "mode"),
    [
        (["object"] * 4, "empty"),
        (["standing"] * 4, "empty"),
        (["passer-by"] * 4, "ignore"),
        (["sky"] * 4, "ignore"),
        (["object", "object", "object"], "ignore"),
        (["object", "object", "object", "sky"], "ignore"),
    ],
)
def test_masks_say_what_black_means(tmp_path: Path, kinds: list[str], mode: str) -> None:
    photos = folder_of(tmp_path / "photos", 4)
    (photos / "masks").mkdir()
    for i, kind in enumerate(kinds):
        mask(kind).save(photos / "masks" / f"p{i}.png")

    class Notes(Reporter):
        notes: list[str]

        def note(self, message: str) -> None:
            self.notes.append(message)

    report = Notes()
    report.notes = []
    new(NewParams(photos=photos, project=tmp_path / "p"), report)
    assert load_project(tmp_path / "p").mask_mode == mode
    assert any("--mask-mode ignore" in note for note in report.notes) == (mode == "empty")


def test_added_photos_do_not_change_what_masks_mean(tmp_path: Path) -> None:
    photos, more = folder_of(tmp_path / "photos", 3), tmp_path / "more"
    more.mkdir()
    (photos / "p2.jpg").rename(more / "p2.jpg")
    new(NewParams(photos=photos, project=tmp_path / "p", mask_mode="empty"), Reporter())
    new(NewParams(photos=more, project=tmp_path / "p", add=True), Reporter())
    assert load_project(tmp_path / "p").mask_mode == "empty"
