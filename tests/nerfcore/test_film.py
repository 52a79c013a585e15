"""Frames for Blender: the passes of a shot, and fields that are moved, cut, hidden and recoloured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.film.cryptomatte import id_of
from fieldwork.nerfcore.film.exposure import surface_normals
from fieldwork.nerfcore.film.fields import FieldStore, dimmed

from .support.film import SIDE, H, W, ball, lens, store, take

__all__ = ["ball", "store"]


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
    far = take(ball, store, ["Combined"], {"baked": baked}, lens=lens(clip=(0.1, 1.3)))["Combined"][..., 3]
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


@pytest.mark.parametrize("opacity", [0.0, 0.02, 0.3, 1.0])
def test_the_opacity_of_a_class_is_a_factor_of_alpha_however_dense_the_field(opacity: float) -> None:
    """A fog of probabilities whose sum rounds to more than 1, in samples from thin to solid."""
    thickness = torch.logspace(-3, 4, 2000)
    shares = torch.softmax(torch.randn(2000, 39, generator=torch.Generator().manual_seed(0)) * 6, 1)
    factors = torch.full((39,), opacity)
    found = dimmed(shares @ factors, thickness)
    assert found.isfinite().all()
    alpha = 1 - torch.exp(-found * thickness)
    assert (alpha - opacity * (1 - torch.exp(-thickness))).abs().max() < 1e-4


def test_what_the_clip_plane_cuts_away_hides_nothing(ball: Path, store: FieldStore, tmp_path: Path) -> None:
    """A near wall that the camera looks through, and a board before the ball, which hides it or cuts it out."""

    def board(y: float) -> np.ndarray:
        return np.array([[-2, y, -2], [2, y, -2], [2, y, 2], [-2, y, 2]], np.float32)

    def shown(boards: list[tuple[float, bool]]) -> dict[str, np.ndarray]:
        file = tmp_path / "boards.npz"
        faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * n for n in range(len(boards))])
        holdout = np.repeat([held for _, held in boards], 2)
        np.savez(file, vertices=np.concatenate([board(y) for y, _ in boards]), faces=faces, holdout=holdout)
        return take(ball, store, ["Combined", "FieldBehind"], lens=lens(clip=(0.6, 100.0)), occluders=file)

    wall, before = -1.7, -1.0
    assert shown([(before, False)])["Combined"][..., 3].max() < 0.05
    for near in (False, True):
        both = shown([(wall, near), (before, False)])
        assert both["Combined"][..., 3].max() < 0.05
        assert both["FieldBehind"][..., 3].max() > 0.9, "only a holdout would cut it out there too"
    assert shown([(wall, False)])["Combined"][..., 3].max() > 0.95


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


def test_a_project_that_was_moved_is_told(store: FieldStore, tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match="the folder is not there"):
        take(tmp_path / "moved", store, ["Combined"])
    with pytest.raises(ProjectError, match=r"no project\.json"):
        take(tmp_path, store, ["Combined"])


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
