"""Pictures for people: colour maps for depth and labels, comparison strips."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

VOID_COLOR = (0.0, 0.0, 0.0)
# What is added to the name of a view in the names of its passes' files.
ENDINGS = {
    "rgb": "",
    "depth": "_depth",
    "semantic": "_labels",
    "confidence": "_confidence",
    "normal": "_normal",
    "unknown": "_unknown",
}


def pass_name(frame: str, kind: str, frames: Collection[str]) -> str:
    """The name, without suffix, of the picture of a pass: no picture of another one of the frames has it, as the frame
    `a_depth` would beside the depth of `a`. `frames`: their names by `casefold`."""
    ending, plain = ENDINGS[kind], frame
    while ending and ((plain + ending).casefold() in frames or (plain != frame and plain.casefold() in frames)):
        plain += "_"
    return plain + ending


def colorize_depth(depth: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Depth (H, W) → (H, W, 3) uint8 in turbo's colours, near red and far blue over `depth_range`; empty is black."""
    drawn = depth_range(depth, opacity)
    if drawn is None:
        return np.zeros((*depth.shape, 3), np.uint8)
    solid, (near, far) = _solid(depth, opacity), drawn
    value = 1 - (np.nan_to_num(depth, nan=far) - near) / max(far - near, 1e-9)
    from matplotlib import colormaps  # only where depth is shown: it takes long

    picture = colormaps["turbo"](value.clip(0, 1))[..., :3]
    return (np.where(solid[..., None], picture, 0) * 255 + 0.5).astype(np.uint8)


def depth_range(depth: np.ndarray, opacity: np.ndarray) -> tuple[float, float] | None:
    """Nearest and farthest depth that are told apart in a depth picture (2–98 % of the pixels); None where all is empty."""
    solid = _solid(depth, opacity)
    if not solid.any():
        return None
    near, far = np.percentile(depth[solid], [2, 98])
    return float(near), float(far)


def _solid(depth: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (opacity > 0.5)


def colorize_labels(label: np.ndarray, colors: dict[int, tuple[float, float, float]]) -> np.ndarray:
    """Class ids (H, W) → (H, W, 3) uint8 in the classes' colours; unknown ids are black."""
    table = np.zeros((int(max([*colors, int(label.max()), 0])) + 1, 3))
    for index, color in colors.items():
        table[index] = color
    return (table[label] * 255 + 0.5).astype(np.uint8)


def side_by_side(images: list[np.ndarray], gap: int = 4) -> np.ndarray:
    """Images (H, W, 3) uint8 of one height in a row with white gaps."""
    bar = np.full((images[0].shape[0], gap, 3), 255, np.uint8)
    parts = [images[0]]
    for image in images[1:]:
        parts += [bar, image]
    return np.concatenate(parts, 1)
