"""A texture from the photos, at the resolution they have.

For every small piece of the surface one photo is chosen, so that detail is not averaged away; its broad colours are
brought to those that all photos of the place have in common, and its exposure to that of the others. What no photo sees
has the field's colour. Photos are interpolated as they are stored (sRGB); gains, factors and mixtures are applied in
linear light, where exposure is a product and a mixture of light is a sum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import psutil
import scipy
import torch

from ..errors import SettingError
from ..progress import Reporter, Stretch, go_on
from .facelets import Facelets, facelets
from .painting import Jobs, Texels, crossings, joined, paint_all, texels_of
from .photos import Photo
from .view_choice import agreeing, choose, look, matches, photo_gains, towards_common
from .visibility import DepthBuffers, Observations, observe

TILE = 4096  # texels a side that are worked on at once
PIECE_TEXELS = 40  # longest edge of a piece for which one photo is chosen
SECOND_BEST = 3  # further photos that are tried where the chosen one is hidden
FILL_STEP = 2  # texels along squares with one colour of the field, where no photo shows more and texels are many
FILLED = 1 << 18  # of these colours at once
MARGIN = 4  # texels around charts that repeat their border
BAND = 1 << 22  # texels that are spread at once: a fraction of a second
BYTES_PER_TEXEL, BYTES_PER_TILE_TEXEL = 8, 71

Fill = Callable[[np.ndarray, np.ndarray], np.ndarray]
GAP, UNSEEN, PHOTO = 0, 1, 2  # what a texel holds


@dataclass(frozen=True)
class Prepared:
    """A surface cut into pieces for a texture of `size`, and which photos see them."""

    photos: list[Photo]
    pieces: Facelets
    buffers: DepthBuffers
    seen: Observations
    size: int


@dataclass(frozen=True)
class PhotoTexture:
    """image (S, S, 3) uint8 sRGB, row 0 at the top (v = 1); unseen (S, S) uint8, 255 where the surface's colour is not a
    photo's; seen: share of the surface that a photo painted; gains (photos, 3)."""

    image: np.ndarray
    unseen: np.ndarray
    seen: float
    gains: np.ndarray


def bytes_needed(size: int) -> int:
    """Memory that painting a texture of `size` takes."""
    return BYTES_PER_TEXEL * size**2 + BYTES_PER_TILE_TEXEL * min(size, TILE) ** 2


def fits(size: int) -> bool:
    """Whether there is memory to paint a texture of `size`."""
    return bytes_needed(size) <= psutil.virtual_memory().available


def check_memory(size: int) -> None:
    """Raise SettingError when a texture of `size` does not fit into free memory."""
    if not fits(size):
        needed, free = bytes_needed(size), psutil.virtual_memory().available
        raise SettingError(
            f"A texture of {size}×{size} needs {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free.",
            f"Choose a size of {size // 2} or less, or close other programs.",
        )


def prepare(
    vertices: np.ndarray,
    faces: np.ndarray,
    corners: np.ndarray,
    photos: list[Photo],
    size: int,
    report: Reporter,
) -> Prepared:
    """Cut a mesh (V, 3), (F, 3) with UV (F, 3, 2) into pieces and find the photos that see them best.

    Raises:
        SettingError: there is no memory for a texture of that size.
    """
    check_memory(size)
    report.stage("Finding what the photos see")
    a, b, c = vertices[faces].transpose(1, 0, 2).astype(np.float64)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    u, v = (corners[:, 1] - corners[:, 0]).astype(np.float64), (corners[:, 2] - corners[:, 0]).astype(np.float64)
    flat = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum()
    texel = np.sqrt(area / max(flat * size**2, 1e-12))
    pieces = facelets(vertices, faces, corners, PIECE_TEXELS * texel)
    buffers = DepthBuffers([photo.view for photo in photos], pieces)
    return Prepared(photos, pieces, buffers, observe(buffers, report), size)


def photo_texture(prepared: Prepared, fill: Fill | None, report: Reporter) -> PhotoTexture:
    """Paint the texture.

    Args:
        fill: points (N, 3) and normals (N, 3) → (N, 3) uint8 sRGB, for what no photo shows; None spreads what is
            beside.
    """
    photos, pieces, seen = prepared.photos, prepared.pieces, prepared.seen
    report.stage("Comparing the photos")
    looks = look(photos, pieces, seen, report)
    gains = photo_gains(seen.view, looks, len(photos))
    looks.color[...] *= gains[np.maximum(seen.view, 0)]
    keep = agreeing(pieces, seen.view, looks)
    report.stage("Choosing photos")
    same = matches(pieces, seen.view)
    worth = np.where(keep, looks.worth, 0)
    column = choose(pieces, same, worth, report)
    log_factor = towards_common(pieces, same, looks, keep, seen.weight) + np.log(gains)[np.maximum(seen.view, 0)]
    jobs = crossings(pieces, seen.view, column, keep, log_factor)
    careful = np.ones(len(pieces), bool)
    painted = column >= 0
    careful[painted] = ~_whole_around(pieces, seen, column)[painted]
    others = _second_best(seen, worth, column, log_factor)
    report.stage("Painting the texture")
    image, source = _texture(prepared, [jobs, *others], careful, fill, report)
    painted = np.count_nonzero(source == PHOTO)
    share = painted / max(np.count_nonzero(source), 1)
    return PhotoTexture(image, np.where(source == UNSEEN, 255, 0).astype(np.uint8), share, gains)


def field_texture(
    vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray, size: int, fill: Fill, report: Reporter
) -> np.ndarray:
    """A texture (S, S, 3) uint8 of a mesh with UV (F, 3, 2), all of it `fill`'s colours.

    Raises:
        SettingError: there is no memory for a texture of that size.
    """
    check_memory(size)
    report.stage("Painting the texture")
    pieces = facelets(vertices, faces, corners)
    nobody = np.full((len(pieces), 1), -1, np.int16)
    seen = Observations(nobody, np.zeros(nobody.shape, np.float32), np.zeros(nobody.shape, bool))
    prepared = Prepared([], pieces, DepthBuffers([], pieces), seen, size)
    return _texture(prepared, [], np.zeros(len(pieces), bool), fill, report)[0]


def _texture(
    prepared: Prepared, rounds: list[Jobs], careful: np.ndarray, fill: Fill | None, report: Reporter
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (S, S, 3) uint8, spread beyond the charts, and where they come from (S, S)."""
    size = prepared.size
    canvas = _Canvas(np.zeros((size * size, 3), np.uint8), np.full(size * size, GAP, np.uint8))
    tiles = [(x, y) for y in range(0, size, TILE) for x in range(0, size, TILE)]
    unpainted: list[Texels] = []
    for number, (left, top) in enumerate(tiles):
        part = Stretch(report, number / len(tiles), 1 / len(tiles))
        width = min(TILE, size - left)
        texels = texels_of(prepared.pieces, size, (left, top, width, min(TILE, size - top)))
        row, column = np.divmod(texels.place, width)
        texels = replace(texels, place=(row + top) * size + column + left)
        canvas.source[texels.place] = UNSEEN
        for jobs in rounds[:1]:
            texels = canvas.paint(prepared, texels, jobs, careful, Stretch(part, 0, 0.7))
        # Photos are read once for the further rounds of many tiles, of which little is left.
        if unpainted and sum(map(len, unpainted)) + len(texels) > TILE**2:
            _finish(canvas, prepared, joined(unpainted), rounds[1:], fill, Stretch(part, 0.7, 0.3))
            unpainted = []
        unpainted.append(texels)
    _finish(
        canvas, prepared, joined(unpainted), rounds[1:], fill, Stretch(report, 1 - 0.3 / len(tiles), 0.3 / len(tiles))
    )
    image, source = canvas.image.reshape(size, size, 3), canvas.source.reshape(size, size)
    report.stage("Spreading borders")
    spread(image, source > (GAP if fill else UNSEEN), report.check)
    return image, source


@dataclass(frozen=True)
class _Canvas:
    """A texture that is painted: image (texels, 3) uint8, source (texels,) uint8."""

    image: np.ndarray
    source: np.ndarray

    def paint(self, prepared: Prepared, texels: Texels, jobs: Jobs, careful: np.ndarray, report: Reporter) -> Texels:
        """Paint texels from photos; returns those that none of them sees."""
        color, seen = paint_all(prepared.photos, prepared.buffers, texels, jobs, careful, report)
        self.image[texels.place[seen]] = color[seen]
        self.source[texels.place[seen]] = PHOTO
        return texels.only(~seen)


def _finish(
    canvas: _Canvas, prepared: Prepared, texels: Texels, rounds: list[Jobs], fill: Fill | None, report: Reporter
) -> None:
    """Paint what the chosen photos did not: from the next best ones, then by `fill`."""
    pieces = prepared.pieces
    for number, jobs in enumerate(rounds):
        part = Stretch(report, number / len(rounds), 1 / len(rounds))
        texels = canvas.paint(prepared, texels, jobs, np.ones(len(pieces), bool), part)
    if fill is None or not len(texels):
        return
    owner = texels.owner()
    step = FILL_STEP if rounds and prepared.size >= TILE else 1
    chosen, shared = one_of_each_square(texels.place, prepared.size, step)
    colors = np.empty((len(chosen), 3), np.uint8)
    for begin in range(0, len(chosen), FILLED):
        report.check()
        some = chosen[begin : begin + FILLED]
        colors[begin : begin + FILLED] = fill(texels.points(pieces, owner[some], some), pieces.normals[owner[some]])
    canvas.image[texels.place] = colors[shared]


def _whole_around(pieces: Facelets, seen: Observations, column: np.ndarray) -> np.ndarray:
    """Whether the chosen view sees each facelet as a whole, and its neighbours too: (F,)."""
    rows = np.arange(len(pieces))
    chosen = seen.view[rows, column]
    whole = seen.whole[rows, column]
    for edge in range(3):
        other = pieces.neighbours[:, edge]
        beside = ((seen.view[other] == chosen[:, None]) & seen.whole[other]).any(1)
        whole &= beside | (other < 0)
    return whole


def _second_best(seen: Observations, worth: np.ndarray, column: np.ndarray, log_factor: np.ndarray) -> list[Jobs]:
    """For where the chosen view turns out to be hidden: the others, from the best on."""
    left = worth.copy()
    left[column >= 0, column[column >= 0]] = 0
    order = np.argsort(-left, axis=1)[:, :SECOND_BEST]
    rounds = []
    for turn in range(order.shape[1]):
        at = order[:, turn]
        face = np.flatnonzero(left[np.arange(len(left)), at] > 0)
        factor = np.repeat(np.exp(log_factor[face, at[face]])[:, None], 3, axis=1)
        view = seen.view[face, at[face]].astype(np.int64)
        whole = np.ones((len(face), 3), np.float32)
        rounds.append(Jobs(face, view, whole, factor.astype(np.float32), np.zeros(len(face), bool)))
    return rounds


def one_of_each_square(place: np.ndarray, width: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the texels at places (N,) of a picture so wide, one in each square of `step`: which (M,), and for each of the
    texels its number among these (N,)."""
    row, column = np.divmod(place, width)
    begin = row.min() // step if len(row) else 0
    square = (row // step - begin) * (width // step + 1) + column // step
    last = np.zeros(int(square.max(initial=0)) + 1, np.int32)
    last[square] = np.arange(len(place))
    one = np.zeros(len(place), bool)
    one[last[square]] = True
    return np.flatnonzero(one), (np.cumsum(one, dtype=np.int32) - 1)[last[square]]


def spread(image: np.ndarray, known: np.ndarray, check: Callable[[], None] = go_on) -> None:
    """Fill what is not `known` (S, S) of an image (S, S, C) in place: a margin from the texels beside it, so that
    filtering at a chart's border finds its colours; the rest from means over growing squares."""
    known = known.copy()
    height, width = known.shape
    bands = [(top, min(top + max(1, BAND // width), height)) for top in range(0, height, max(1, BAND // width))]
    for _ in range(MARGIN):
        reached = []
        for top, end in bands:
            check()
            above = max(top - 1, 0)
            grown = np.asarray(scipy.ndimage.binary_dilation(known[above : end + 1], np.ones((3, 3), bool)))[
                top - above :
            ][: end - top]
            rows, columns = np.nonzero(np.logical_and(grown, ~known[top:end]))
            rows += top
            total, number = np.zeros((len(rows), image.shape[2]), np.float32), np.zeros(len(rows), np.float32)
            for dy in (-1, 0, 1):
                begin = np.clip(rows + dy, 0, height - 1) * width
                for dx in (-1, 0, 1):
                    place = begin + np.clip(columns + dx, 0, width - 1)
                    good = known.reshape(-1)[place]
                    total += image.reshape(-1, image.shape[2])[place] * good[:, None]
                    number += good
            image[rows, columns] = (total / np.maximum(number, 1)[:, None] + 0.5).astype(np.uint8)
            reached.append((rows, columns))
        for place in reached:
            known[place] = True
    if known.all() or not known.any():
        return
    step = 4
    small = torch.from_numpy(image[::step, ::step].astype(np.float32)).permute(2, 0, 1)
    weight = torch.from_numpy(known[::step, ::step].astype(np.float32))[None]
    filled = _pushed(small * weight, weight)
    for top, end in bands:
        check()
        rows, columns = np.nonzero(~known[top:end])
        rows += top
        values = filled[:, torch.from_numpy(rows // step), torch.from_numpy(columns // step)]
        image[rows, columns] = values.T.clamp(0, 255).to(torch.uint8).numpy()


def _pushed(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Values (C, H, W), premultiplied with a weight (1, H, W) in {0, 1}; where it is 0 the mean of larger squares."""
    if min(values.shape[1:]) < 2 or bool((weight > 0).all()):
        return values / weight.clamp(min=1e-6)
    pool = torch.nn.functional.avg_pool2d
    less, least = (pool(part[None], 2, ceil_mode=True, count_include_pad=False)[0] for part in (values, weight))
    coarse = _pushed(less / least.clamp(min=1e-6) * (least > 0), (least > 0).float())
    up = torch.nn.functional.interpolate(coarse[None], size=values.shape[1:], mode="nearest")[0]
    return torch.where(weight > 0, values, up)
