"""Single things and classes of a baked field hidden, dimmed, recoloured, moved and copied."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.errors import FieldworkError, InputError, ProjectError, SettingError
from fieldwork.nerfcore.film.cryptomatte import id_of
from fieldwork.nerfcore.film.edits import read_edits, render
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.mesh.instances import Instance, write_instances
from fieldwork.nerfcore.params import RenderParams
from fieldwork.nerfcore.progress import Reporter
from PIL import Image

from .support.film import H, W, ball, store, take
from .support.halves import write_halves

__all__ = ["ball", "store"]

LEFT, RIGHT = (H // 2 - 12, W // 2 - 12), (H // 2 - 12, W // 2 + 12)


@pytest.fixture(scope="module")
def things(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    project = Path(shutil.copytree(ball, tmp_path_factory.mktemp("things") / "Kugel ü"))
    write_halves(project)
    return project


def shifted(x: float, y: float, z: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix.tolist()


def test_a_hidden_thing_is_gone_and_the_others_stay(things: Path, store: FieldStore) -> None:
    wanted = ["Combined", "Class Index", "CryptoObject00"]
    plain = take(things, store, wanted, {"baked": True})
    found = take(things, store, wanted, {"baked": True, "instances": {"left": {"opacity": 0.0}}})
    before, after = plain["Combined"][..., 3], found["Combined"][..., 3]
    left, right = np.s_[: H // 2 - 6, : W // 2 - 4], np.s_[: H // 2 - 4, W // 2 + 4 :]
    assert after[left].sum() < 0.4 * before[left].sum()
    assert np.abs(after - before)[right].max() < 0.1
    assert np.abs(after - before)[H // 2 + 4 :].max() < 0.1
    assert (found["CryptoObject00"][after > 0.9][:, 0] == np.float32(id_of("left"))).mean() < 0.02
    assert found["Class Index"][RIGHT][0] == 1


def test_a_thing_is_tinted_and_dimmed_alone(things: Path, store: FieldStore) -> None:
    plain = take(things, store, ["Combined", "Class Color"], {"baked": True})
    green = {"left": {"tint": 1.0, "color": (0.0, 1.0, 0.0)}}
    tinted = take(things, store, ["Combined", "Class Color"], {"baked": True, "instances": green})
    assert tinted["Combined"][LEFT] == pytest.approx([0, 1, 0, 1], abs=0.08)
    assert tinted["Combined"][RIGHT] == pytest.approx(plain["Combined"][RIGHT], abs=0.02)
    assert tinted["Class Color"][LEFT] == pytest.approx(plain["Class Color"][LEFT], abs=0.01)
    dim = take(things, store, ["Combined"], {"baked": True, "instances": {"left": {"opacity": 0.05}}})["Combined"]
    gone = take(things, store, ["Combined"], {"baked": True, "instances": {"left": {"opacity": 0.0}}})["Combined"]
    alpha = [pixels[: H // 2 - 6, : W // 2 - 4, 3].sum() for pixels in (gone, dim, plain["Combined"])]
    assert alpha[0] < alpha[1] < alpha[2]


def test_a_hidden_class_hides_its_things(things: Path, store: FieldStore) -> None:
    looks = {"classes": {1: {"opacity": 0.0}}, "instances": {"left": {"tint": 0.5}}}
    found = take(things, store, ["Combined"], {"baked": True, **looks})["Combined"][..., 3]
    plain = take(things, store, ["Combined"], {"baked": True})["Combined"][..., 3]
    assert found[: H // 2 - 4].sum() < 0.4 * plain[: H // 2 - 4].sum()


def test_a_copy_stands_elsewhere_with_its_depth_and_its_mattes(things: Path, store: FieldStore) -> None:
    plain = take(things, store, ["Combined", "Depth", "Class Index", "CryptoObject00"], {"baked": True})
    base = {"name": "Ball", "project": things, "baked": True, "scene_from_capture": np.eye(4).tolist()}
    # 12 pixels to the right and 12 down, half a unit nearer.
    copy = {**base, "scene_from_capture": shifted(0.4, -0.5, -0.3), "only": "left"}
    found = take(things, store, ["Combined", "Depth", "Class Index", "CryptoObject00"], fields=[base, copy])
    alone = take(things, store, ["Combined", "Depth"], fields=[copy])
    place = alone["Combined"][..., 3] > 0.95
    assert place.sum() > 100
    whole = take(things, store, ["Combined"], fields=[{k: v for k, v in copy.items() if k != "only"}])
    assert (alone["Combined"] - whole["Combined"])[..., 3].max() < 1e-3, "nothing beside the ball"
    rest = (whole["Combined"][..., 3] > 0.95) & (alone["Combined"][..., 3] < 0.05)
    assert rest.sum() > 50, "the rest of the ball is left out"
    assert np.abs(found["Combined"] - alone["Combined"])[place].mean() < 0.02
    assert found["Depth"][place] == pytest.approx(alone["Depth"][place], abs=0.05)
    assert found["Depth"][place].mean() < plain["Depth"][plain["Depth"] < 1e9].mean() - 0.2
    assert (found["Class Index"][place] == 1).mean() > 0.95
    assert (found["CryptoObject00"][place][:, 0] == np.float32(id_of("left"))).mean() > 0.95
    beside = alone["Combined"][..., 3] < 0.001
    assert np.abs(found["Combined"] - plain["Combined"])[beside].max() < 1e-3


def test_what_cannot_be_edited_is_told(ball: Path, things: Path, store: FieldStore) -> None:
    with pytest.raises(InputError, match=r"no thing “middle”.*There are left, right"):
        take(things, store, ["Combined"], {"baked": True, "only": "middle"})
    with pytest.raises(SettingError, match="baked field only"):
        take(things, store, ["Combined"], {"baked": False, "only": "left"})
    with pytest.raises(ProjectError, match="no mesh yet"):
        take(ball, store, ["Combined"], {"baked": True, "only": "left"})


def test_a_renamed_thing_is_found_by_its_new_name(things: Path, store: FieldStore, tmp_path: Path) -> None:
    project = Path(shutil.copytree(things, tmp_path / "p"))
    take(project, store, ["Combined"], {"baked": True, "only": "left"})
    write_instances(project / "exports" / "main", [Instance(1, "west", 1, 0.4, (0, 0, 0.2))])
    assert take(project, store, ["Combined"], {"baked": True, "only": "west"})["Combined"][..., 3].max() > 0.9
    with pytest.raises(InputError, match="no thing “left”"):
        take(project, store, ["Combined"], {"baked": True, "only": "left"})


# The verb


def picture(project: Path, out: Path, edits: Any = None) -> np.ndarray:
    """One view of the ball from the side, as `render --baked --edits` writes it, (48, 48, 3) in [0, 1]."""
    out.mkdir(parents=True, exist_ok=True)
    pose = [[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1]]
    lens = {"w": 48, "h": 48, "fl_x": 72}
    (out / "cameras.json").write_text(json.dumps({**lens, "frames": [{"file_path": "a", "transform_matrix": pose}]}))
    file = None
    if edits is not None:
        file = out / "edits.json"
        file.write_text(edits if isinstance(edits, str) else json.dumps({"edits": edits}))
    params = RenderParams(project=project, out=out, camera=out / "cameras.json", baked=True, edits=file)
    render(params, Reporter())
    with Image.open(out / "a.png") as image:
        return np.asarray(image.convert("RGB"), np.float32) / 255


def test_the_verb_edits_things_and_classes(things: Path, tmp_path: Path) -> None:
    plain = picture(things, tmp_path / "plain")
    assert np.abs(picture(things, tmp_path / "none", []) - plain).max() < 0.02
    edits = [
        {"instance": "left", "move": shifted(0.0, -0.3, 0.35), "copies": [shifted(-0.1, -0.3, -0.25)]},
        {"instance": "right", "color": [0.0, 1.0, 0.0]},
        {"class": "bottom", "hide": True},
    ]
    found = picture(things, tmp_path / "edited", edits)
    red_green_blue = found[24 - 9, 24 + 9]
    assert red_green_blue == pytest.approx([0, 1, 0], abs=0.1), "“right” is green"
    white = plain[1, 1]
    assert found[24 + 16, 24 + 4] == pytest.approx(white, abs=0.1), "the lower class is hidden"
    assert np.abs(found[24 + 6, 24 - 12] - white).max() > 0.1, "a copy stands where it was"
    assert np.abs(found[2:5, 24 - 8 : 24 - 2] - white).mean() > 0.1, "moved up, above the ball"
    assert np.abs(plain[2:5, 24 - 8 : 24 - 2] - white).mean() < 0.02


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{", "is not JSON"),
        ('{"edits": [{"hide": true}]}', "either “instance” or “class”"),
        ('{"edits": [{"class": "top", "move": [[1]]}]}', "4 × 4|only an instance"),
        ('{"edits": [{"instance": "left", "copies": [[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,1]]]}]}', "nothing"),
        ('{"edits": [{"instance": "left", "colour": 1}]}', "colour"),
        ('{"edits": [{"instance": "left", "color": [255, 128, 0]}]}', "color.*less than or equal to 1"),
        ('{"edits": [{"instance": "left", "tint": 0.5}]}', "tint.*needs a “color”"),
        ('{"edits": [{"class": "sky", "hide": true}]}', "no class “sky”.*top, bottom"),
        ('{"edits": [{"instance": "cup", "hide": true}]}', "no thing “cup”"),
        ('{"edits": [{"class": "top", "hide": true}, {"class": "top", "opacity": 0.5}]}', "2 edits of “top”"),
    ],
)
def test_a_file_of_edits_that_is_wrong_is_told(things: Path, tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(FieldworkError, match=told):
        picture(things, tmp_path, text)


def test_edits_need_the_baked_field(things: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--baked"):
        RenderParams(project=things, out=tmp_path, orbit=1, edits=tmp_path / "edits.json")


def test_other_edits_are_another_render(things: Path, tmp_path: Path) -> None:
    from fieldwork.nerfcore.render.verb import rendered

    params = RenderParams(project=things, out=tmp_path, camera=tmp_path / "cameras.json", baked=True)
    picture(things, tmp_path, [{"instance": "left", "hide": True}])
    params = params.model_copy(update={"edits": tmp_path / "edits.json"})
    assert rendered(params).result is not None
    (tmp_path / "edits.json").write_text('{"edits": [{"instance": "right", "hide": true}]}')
    assert rendered(params).result is None


def test_a_wrong_file_of_edits_says_what_one_holds(tmp_path: Path) -> None:
    path = tmp_path / "edits.json"
    path.write_text('{"edits": [{"class": "wall", "hidden": true}]}')
    with pytest.raises(InputError, match=r"no setting “edits\.0\.hidden”") as caught:
        read_edits(path)
    assert "instance, class, hide, opacity, color, tint, move, copies" in caught.value.hint
    (example,) = re.findall(r"Write (\{.*\})\. ", caught.value.hint)
    path.write_text(example)
    (edit,) = read_edits(path)
    assert edit.hide
