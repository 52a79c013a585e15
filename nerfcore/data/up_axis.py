"""Which way is up in a transforms.json: what its keys say, else what its cameras do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..geometry.frames import UNCERTAIN, rotation_to_z, up_direction
from .dataset import Y_UP

AXES = {"x": np.array([1.0, 0, 0]), "y": np.array([0, 1.0, 0]), "z": np.array([0, 0, 1.0])}
# Keys that only nerfstudio writes. It turns the mean up of the cameras upwards when it reads such a file.
NERFSTUDIO = ("applied_transform", "applied_scale", "orientation_override", "ply_file_path")
INSTANT_NGP = ("aabb_scale", "from_na", "render_aabb")  # its script turns the world z up
CLEARLY_OFF = np.radians(30)


class Up(NamedTuple):
    """`world_from_sfm` (4, 4) turns the file's frame z up; `confidence` where cameras told; what to say about it."""

    world_from_sfm: np.ndarray
    confidence: float | None = None
    warnings: tuple[str, ...] = ()


def choose_up(head: dict[str, Any], poses: Sequence[np.ndarray], named_splits: bool) -> Up:
    """The world of a transforms.json.

    Args:
        head: its keys outside the frames.
        poses: camera-to-world (4, 4) with OpenCV axes.
        named_splits: whether it is one of transforms_train.json, …, which Blender's scenes have: z up.
    Raises:
        InputError: the direction that the file gives is none.
    """
    stated = _stated(head)
    if stated is not None:
        return Up(_turned(stated))
    if head.get("orientation_override") == "none" or any(key in head for key in INSTANT_NGP) or named_splits:
        return Up(np.eye(4))
    up, confidence = up_direction(poses)
    if any(key in head for key in NERFSTUDIO):
        doubt = "The cameras say little about which way is up: look at it, and set it with `fieldwork align --up`."
        return Up(_turned(up), confidence, () if confidence >= UNCERTAIN else (doubt,))
    text = (
        "transforms.json does not say which axis is up: z is taken to be. If it is not, set it: `fieldwork align --up"
    )
    if confidence >= UNCERTAIN and np.arccos(np.clip(up[2], -1, 1)) > CLEARLY_OFF:
        return Up(np.eye(4), None, (f"{text} {_written(up)}`, which is up by how the cameras were held.",))
    return Up(np.eye(4), None, (f"{text} y`, for example.",))


def _stated(head: dict[str, Any]) -> np.ndarray | None:
    """The direction (3,) that the file itself calls up: "y up" in camera_convention, or Instant-NGP's `up`."""
    said = re.search(r"([+-]?)\b([xyz])[ -]up\b", str(head.get("camera_convention", "")).lower())
    if said:
        return AXES[said[2]] * (-1 if said[1] == "-" else 1)
    if "up" not in head:
        return None
    try:
        up = np.array(head["up"], np.float64)
    except (TypeError, ValueError):
        up = np.zeros(0)
    if up.shape != (3,) or not np.isfinite(up).all() or np.linalg.norm(up) < 1e-9:
        raise InputError(f"“up” in transforms.json is no direction ({head['up']}).", "It has three numbers: [0, 0, 1].")
    return up / np.linalg.norm(up)


def _turned(up: np.ndarray) -> np.ndarray:
    """A rotation (4, 4) that turns `up` (3,) into +z; along the axes where `up` is one."""
    if up[1] > 1 - 1e-9:
        return Y_UP.copy()
    turn = np.eye(4)
    if up[2] < 1 - 1e-9:
        turn[:3, :3] = rotation_to_z(up)
    return turn


def _written(up: np.ndarray) -> str:
    """A direction as `align --up` takes it."""
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > np.cos(np.radians(10)):
        return ("-" if up[axis] < 0 else "") + "xyz"[axis]
    return ",".join(f"{part:.2f}" for part in up)
