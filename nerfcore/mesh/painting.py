"""Painting texels from chosen photos, with soft crossings where the choice changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from ..images.picture import linear_to_srgb, srgb_to_linear, to_bytes
from ..kernels.triangles import triangle_texels
from ..progress import Reporter
from .facelets import Facelets
from .photos import Photo, halvings, sample, sharpened
from .visibility import CPU, DepthBuffer, DepthBuffers, in_parallel, within

BLOCK = 1 << 19  # texels painted at once
BAND = 1 << 22  # texels whose colours are made bytes at once
FINE = 0.7  # width of a texel in pixels: a finer one shows less than a pixel does, so that the pixel's blur is undone
BESIDE_FADES = 2  # power of the weight of a view that sees a facelet's border alone


@dataclass(frozen=True)
class Jobs:
    """Which view paints which facelet: face (J,), view (J,); weight (J, 3) at the facelet's corners; factor (J, 3, 3)
    what multiplies the photo's linear colours there (corner, channel). beside (J,) bool: the view does not see the facelet
    well, only what borders on it."""

    face: np.ndarray
    view: np.ndarray
    weight: np.ndarray
    factor: np.ndarray
    beside: np.ndarray

    def of(self, rows: np.ndarray) -> Jobs:
        """Only those of some rows: indices (N,) or (J,) bool."""
        return Jobs(*(values[rows] for values in vars(self).values()))


def crossings(pieces: Facelets, view: np.ndarray, column: np.ndarray, keep: np.ndarray, log_factor: np.ndarray) -> Jobs:
    """Every facelet from its chosen view, and beside a change of view from the neighbours' too.

    A vertex mixes the views of the facelets around it in equal parts, and a facelet mixes its corners' mixtures, so the
    colour does not jump where the choice changes. The factors are averaged at the vertices as well. A neighbour's view that
    does not see the facelet, as around the sharp edges of a wire, sees its border all the same: it fades from there, faster.

    Args:
        view (F, K): candidates; column (F,): the chosen one, −1 for none; keep (F, K): which may be used; log_factor
            (F, K, 3): see `view_choice.towards_common`.
    """
    painted = np.flatnonzero(column >= 0)
    chosen = np.full(len(pieces), -1, np.int64)
    chosen[painted] = view[painted, column[painted]]
    span = int(view.max(initial=0)) + 1
    corner_key = pieces.faces[painted].astype(np.int64) * span + chosen[painted, None]
    mixed, counts = np.unique(corner_key, return_counts=True)
    vertex = mixed // span
    around = np.bincount(vertex, counts, len(pieces.vertices))
    share = counts / around[vertex]
    # Facelets with a corner where several views meet, and all views at their corners.
    several = np.bincount(vertex, minlength=len(pieces.vertices)) > 1
    border = painted[several[pieces.faces[painted]].any(1)]
    begin, end = np.searchsorted(vertex, pieces.faces[border]), np.searchsorted(vertex, pieces.faces[border], "right")
    pairs = [np.stack([painted, chosen[painted]], 1)]
    for step in range(int((end - begin).max(initial=0))):
        row, corner = np.nonzero(begin + step < end)
        pairs.append(np.stack([border[row], mixed[begin[row, corner] + step] % span], 1))
    face, number = np.unique(np.concatenate(pairs), axis=0).T
    match = view[face] == number[:, None]
    at = match.argmax(1)
    seen = match.any(1) & keep[face, at]
    usable = seen | ~match.any(1)  # all but views that show something else
    face, number, at, seen = face[usable], number[usable], at[usable], seen[usable]
    keys = pieces.faces[face].astype(np.int64) * span + number[:, None]
    place = np.minimum(np.searchsorted(mixed, keys), len(mixed) - 1)
    weight = np.where(mixed[place] == keys, share[place], 0)
    # The mean factor of each view at each vertex, over the facelets that it sees there.
    unique, inverse = np.unique(keys, return_inverse=True)
    inverse = inverse.reshape(-1)
    mine = np.repeat(log_factor[face, at] * seen[:, None], 3, axis=0)
    number_at = np.maximum(np.bincount(inverse, np.repeat(seen, 3)), 1)
    mean = np.stack([np.bincount(inverse, mine[:, c], len(unique)) / number_at for c in range(3)], 1)
    factor = np.exp(mean)[inverse].reshape(-1, 3, 3)
    return Jobs(
        face.astype(np.int64), number.astype(np.int64), weight.astype(np.float32), factor.astype(np.float32), ~seen
    )


@dataclass(frozen=True)
class Texels:
    """Texels of a texture, facelet by facelet: first (F + 1,), place (N,) in a tile or in the texture, barycentric (N, 2);
    width (F,) of a texel on the surface."""

    first: np.ndarray
    place: np.ndarray
    barycentric: np.ndarray
    width: np.ndarray

    def __len__(self) -> int:
        return len(self.place)

    def owner(self) -> np.ndarray:
        """The facelet of each: (N,)."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))

    def only(self, wanted: np.ndarray) -> Texels:
        """Those that are `wanted`: (N,) bool."""
        before = np.concatenate([[0], np.cumsum(wanted)])
        return Texels(before[self.first], self.place[wanted], self.barycentric[wanted], self.width)

    def of(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texels (N,) of facelets, and for each the row in `faces` (N,)."""
        counts = self.first[faces + 1] - self.first[faces]
        row = np.repeat(np.arange(len(faces)), counts)
        return np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts) + self.first[faces][row], row

    def points(self, pieces: Facelets, faces: np.ndarray, texel: np.ndarray) -> np.ndarray:
        """Where texels (N,) of the facelets (N,) lie on the surface: (N, 3) float32."""
        second, third = self.barycentric[texel].T[..., None]
        corner, to_second, to_third = pieces.spans
        return corner[faces] + second * to_second[faces] + third * to_third[faces]


def texels_of(pieces: Facelets, size: int, tile: tuple[int, int, int, int]) -> Texels:
    """Texels of one tile (left, top, width, height) of a texture of `size`."""
    assert pieces.corners is not None
    corners = pieces.corners * [1, -1] * size + [0, size]
    a, b, c = corners.transpose(1, 0, 2)
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    return Texels(*triangle_texels(corners, *tile, CPU), np.sqrt(pieces.areas / np.maximum(area, 1e-9)))


def joined(parts: list[Texels]) -> Texels:
    """Texels of the same facelets in several tiles, whose places are those of the texture."""
    owner = np.concatenate([part.owner() for part in parts])
    order = np.argsort(owner, kind="stable")
    first = np.searchsorted(owner[order], np.arange(len(parts[0].first)))
    place, barycentric = (np.concatenate([getattr(p, name) for p in parts])[order] for name in ("place", "barycentric"))
    return Texels(first, place, barycentric, parts[0].width)


def paint_all(
    photos: Sequence[Photo],
    buffers: DepthBuffers,
    texels: Texels,
    jobs: Jobs,
    careful: np.ndarray,
    report: Reporter,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) uint8 sRGB that photos mix for texels, and which (N,) bool any of them sees, and not only its border.

    Args:
        careful (F,): facelets whose every texel has to be looked for in the depth buffer.
    """
    total, painted = np.zeros((len(texels), 4), np.float32), np.zeros(len(texels), bool)
    jobs = jobs.of(np.diff(texels.first)[jobs.face] > 0)
    order = np.argsort(jobs.view, kind="stable")
    numbers, begins = np.unique(jobs.view[order], return_index=True)

    def work(item: tuple[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        report.check()
        number, rows = item
        mine = jobs.of(rows)
        buffer = buffers[number] if careful[mine.face].any() else None
        return paint(photos[number], mine, buffers.pieces, texels, careful, buffer)

    items = list(zip(numbers.tolist(), np.split(order, begins[1:]))) if len(numbers) else []
    # One photo after the other, in whatever order they are done: sums then do not differ from run to run.
    for _, (texel, value, seen) in in_parallel(work, items, report, "photos"):
        total[texel] += value
        painted[texel[seen]] = True
    color = np.zeros((len(texels), 3), np.uint8)
    for begin in range(0, len(texels), BAND):
        some = begin + np.flatnonzero(painted[begin : begin + BAND])
        color[some] = to_bytes(linear_to_srgb(total[some, :3] / total[some, 3:]))
    return color, painted


def paint(
    photo: Photo,
    jobs: Jobs,
    pieces: Facelets,
    texels: Texels,
    careful: np.ndarray,
    buffer: DepthBuffer | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What one photo gives: the numbers (N,) of texels, (N, 4) its linear colours times weight, and weight, and which (N,)
    bool it sees and not only what borders on them.

    Args:
        jobs: those of this photo, which is read where it sees any of them.
        careful (F,): facelets whose every texel has to be looked for in the depth buffer.
    """
    view = photo.view
    numbers, values, seen = [np.zeros(0, np.int64)], [np.zeros((0, 4), np.float32)], [np.zeros(0, bool)]
    texel, row = texels.of(jobs.face)

    @cache
    def read() -> tuple[np.ndarray, bool]:
        """The photo, and whether any of it is masked."""
        rgba = photo.read()
        return rgba, bool((rgba[..., 3] == 0).any())

    @cache
    def pictures(fine: bool) -> list[torch.Tensor]:
        rgba, _ = read()
        if fine:
            return [sharpened(rgba)]
        return halvings(torch.from_numpy(rgba[..., :3].astype(np.float32) / 255).permute(2, 0, 1), 6)

    for begin in range(0, len(texel), BLOCK):
        some, job = texel[begin : begin + BLOCK], row[begin : begin + BLOCK]
        face = jobs.face[job]
        points = texels.points(pieces, face, some)
        local = view.local(points)
        pixel, depth = view.pixels(local), view.depth(local)
        good = within(pixel, view.camera.width, view.camera.height)
        if buffer is not None:
            check = np.flatnonzero(careful[face] & good)
            towards = view.center - points[check]
            cosine = np.einsum("ij,ij->i", towards, pieces.normals[face[check]]) / np.linalg.norm(towards, axis=1)
            good[check] = buffer.sees(pixel[check], depth[check], np.maximum(cosine, 0.05))
        if not good.any():
            continue
        rgba, masked = read()
        if masked:
            at = np.flatnonzero(good)
            x, y = pixel[at].astype(int).T
            good[at] = rgba[y, x, 3] > 0
        some, job, face, pixel, depth = some[good], job[good], face[good], pixel[good], depth[good]
        # A texel wider than a pixel takes the mean of what it covers.
        pixels = texels.width[face] / view.footprint(depth)
        level = np.round(np.log2(np.maximum(pixels, 1))).astype(int)
        # Interpolated as the photo is stored: in linear light a cubic would overshoot visibly beside highlights.
        stored, fine = np.empty((len(pixel), 3), np.float32), pixels < FINE
        for finer, rows in ((True, fine), (False, ~fine)):
            if rows.any():
                stored[rows] = sample(pictures(finer), pixel[rows], level[rows], "bicubic").numpy()
        color = srgb_to_linear(stored.clip(0, 1))
        second, third = texels.barycentric[some].T[..., None]
        first = 1 - second - third
        weight, factor = jobs.weight[job], jobs.factor[job]
        share = np.concatenate([first, second, third], 1)
        share = np.where(jobs.beside[job, None], share**BESIDE_FADES, share)
        weight = np.einsum("nk,nk->n", share, weight)
        factor = first * factor[:, 0] + second * factor[:, 1] + third * factor[:, 2]
        weight = np.maximum(weight, 1e-4)
        values.append(np.concatenate([color * factor * weight[:, None], weight[:, None]], 1).astype(np.float32))
        numbers.append(some)
        seen.append(~jobs.beside[job])
    return np.concatenate(numbers), np.concatenate(values), np.concatenate(seen)
