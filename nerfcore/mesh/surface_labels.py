"""Classes on a surface, from the label maps of the photos that see it.

The probability of a class at a place is the mean over the views that show it labelled, weighted by how frontal and near
they are: P(c) = Σ w·p(c) / Σ w, where p is the confidence of a label map for its class. What label maps leave unlabelled
is void, unless they leave most of the surface so: then they are samples, which do not say what is nothing. Where photos
see the surface and no label map says what it is, the field's probabilities stand in. What no photo sees is void on a closed
surface; of an open one it is bits and filled holes, which have the classes around them.
Neighbours across smooth, evenly coloured places share what they know a little, and only then the most probable class is
taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ..progress import Reporter
from .facelets import Facelets
from .painting import Texels, texels_of
from .photos import Photo
from .visibility import DepthBuffers, Observations, PosedCamera, in_parallel, within

ROUNDS = 4  # of sharing with neighbours
SHARE = 0.4  # what a neighbour across a smooth edge counts beside a facelet's own evidence
CREASE = np.radians(25)  # angle, and difference of sRGB colours, across which a third of the sharing is left
CONTRAST = 0.08
LEAST = 0.1  # evidence below which a place is void
SPARSE = 0.5  # labelled share of what label maps show of the surface, below which unlabelled means unknown
CERTAIN = 0.98  # share of its evidence a facelet needs for one class, to have no outline in it
PRIOR = 0.1  # what a facelet's evidence counts at its texels beside that of one view
TILE = 2048  # texels a side that are worked on at once
MARGIN = 4  # texels around charts that repeat their border
BAND = 1 << 21  # texels between two questions whether to go on

ClassField = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Evidence:
    """What is known of F facelets: mass (F, C) of each class, in sum between 0 (nothing) and 1; own (F, C) that before
    neighbours shared. sparse: whether what label maps leave unlabelled is unknown, not void."""

    mass: np.ndarray
    own: np.ndarray
    sparse: bool


@dataclass(frozen=True)
class SurfaceClasses:
    """Classes of a mesh: face_class (F,), class_id (V,) int32 ids; face_confidence (F,), confidence (V,) float32 in
    [0, 1]: the probability of that class, 0 for void."""

    face_class: np.ndarray
    face_confidence: np.ndarray
    class_id: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True)
class ClassMaps:
    """Classes on a texture: ids (S, S) uint8 or uint16, confidence (S, S) uint8, 255 for certain."""

    ids: np.ndarray
    confidence: np.ndarray


def class_evidence(
    photos: Sequence[Photo],
    pieces: Facelets,
    seen: Observations,
    class_ids: Sequence[int],
    field: ClassField | None,
    colors: np.ndarray | None,
    report: Reporter,
    continued: bool = False,
) -> Evidence:
    """Evidence for each facelet.

    Args:
        class_ids: id of each class; other ids in label maps say nothing.
        field: points (N, 3) and normals (N, 3) → (N, C) probabilities; None where there is no field.
        colors: (F, 3) sRGB in [0, 1] for the contrast between neighbours; None: shape alone decides.
        continued: whether what no photo sees has the classes around it, as bits that close holes of an open surface or
            lie at its rims, or is void.
    """
    votes = np.zeros((len(pieces), len(class_ids)), np.float32)
    total, looked = np.zeros(len(pieces), np.float32), np.zeros(len(pieces), np.float32)
    index = index_of(class_ids)

    def read(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return view_votes(photos[number], number, pieces, seen, index, len(class_ids))

    for _, (face, vote, amount, told) in in_parallel(read, range(len(photos)), report, "label maps"):
        votes[face] += vote
        total[face] += amount
        looked[face] += told
    own = votes / np.maximum(total, 1e-30)[:, None]
    shown = looked > 0
    sparse = np.count_nonzero(total > 0) < SPARSE * np.count_nonzero(shown)
    blank = shown & (total == 0) & (not sparse)
    if field is not None:
        silent = np.flatnonzero((total == 0) & ~blank & (seen.view >= 0).any(1))
        for part in np.array_split(silent, max(1, -(-len(silent) // (1 << 16)))):
            report.check()
            if len(part):
                own[part] = field(pieces.centers[part], pieces.normals[part])
    mass = _shared(pieces, own, colors, blank)
    if continued:
        mass = _continued(pieces, mass, (seen.view < 0).all(1), blank)
    return Evidence(mass, own, bool(sparse))


def view_votes(
    photo: Photo, number: int, pieces: Facelets, seen: Observations, index: np.ndarray, classes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the label map of photo `number` says: facelets (N,) it is among the best for, their votes (N, C), and how much
    of them is labelled (N,), and how much it says anything of, be it that there is no label (N,), all weighted by how well it
    sees them.

    Args:
        index: index of each class id, see `index_of`; classes: how many.
    """
    face, column = seen.of(number)
    if photo.labels is None or not len(face):
        nothing = np.zeros(0, np.float32)
        return face[:0], np.zeros((0, classes), np.float32), nothing, nothing
    weight = seen.weight[face, column]
    labels, sure = photo.labels()
    label = index[np.minimum(labels, len(index) - 1)]
    center, corners = pieces.centers[face], pieces.vertices[pieces.faces[face]]
    # The middle, and half way to each corner.
    places = [center, *((corners[:, k] + center) / 2 for k in range(3))]
    found = [read_votes(photo.view, photo.view.local(place), label, sure, classes) for place in places]
    votes, labelled, told = (sum(parts) for parts in zip(*found))
    return face, votes * weight[:, None], labelled * weight, told * weight


def index_of(class_ids: Sequence[int]) -> np.ndarray:
    """Index of each class id; −1 for ids of no class, with one more place for all that are larger."""
    index = np.full(max(class_ids, default=0) + 2, -1, np.int32)
    index[list(class_ids)] = np.arange(len(class_ids))
    return index


def read_votes(
    view: PosedCamera, local: np.ndarray, label: np.ndarray, sure: np.ndarray, classes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a label map says of points (N, 3) in camera axes: votes (N, C) between the four pixels around each, how much of these
    is labelled (N,), and of how much it says anything (N,): nothing where it is masked or not sure at all.

    Args:
        label: (H, W) class index, −1 for none; sure: (H, W) uint8.
    """
    height, width = label.shape
    pixel = view.pixels(local)
    good = np.flatnonzero(within(pixel, width, height))
    base = np.floor(pixel[good] - 0.5)
    ahead = pixel[good] - 0.5 - base
    votes, known, told = np.zeros(len(local) * classes), np.zeros(len(local)), np.zeros(len(local))
    for dy in (0, 1):
        for dx in (0, 1):
            x = np.clip(base[:, 0] + dx, 0, width - 1).astype(int)
            y = np.clip(base[:, 1] + dy, 0, height - 1).astype(int)
            part = np.abs(1 - dx - ahead[:, 0]) * np.abs(1 - dy - ahead[:, 1])
            found, certain = label[y, x], sure[y, x] / 255
            labelled = (found >= 0) & (certain > 0)
            where, amount = good[labelled], part[labelled]
            votes += np.bincount(where * classes + found[labelled], amount * certain[labelled], len(votes))
            known += np.bincount(where, amount, len(known))
            told += np.bincount(good[certain > 0], part[certain > 0], len(told))
    votes = votes.reshape(len(local), classes)
    return votes.astype(np.float32), known.astype(np.float32), told.astype(np.float32)


def _shared(pieces: Facelets, own: np.ndarray, colors: np.ndarray | None, blank: np.ndarray) -> np.ndarray:
    """Evidence (F, C) after some rounds of taking the neighbours' in, less across creases and contrasts; `blank` (F,)
    facelets stay void."""
    there = np.maximum(pieces.neighbours, 0)
    weight = np.empty(there.shape, np.float32)
    for edge in range(3):
        other = there[:, edge]
        cosine = np.einsum("ij,ij->i", pieces.normals, pieces.normals[other])
        exponent = (np.arccos(cosine.clip(-1, 1)) / CREASE) ** 2
        if colors is not None:
            exponent = exponent + (np.abs(colors - colors[other]).max(1) / CONTRAST) ** 2
        weight[:, edge] = SHARE * np.exp(-exponent) * (pieces.neighbours[:, edge] >= 0)
    mass = own
    for _ in range(ROUNDS):
        total, amount = own.copy(), np.ones(len(own), np.float32)
        for edge in range(3):
            total += weight[:, edge, None] * mass[there[:, edge]]
            amount += weight[:, edge]
        mass = np.where(blank[:, None], 0, total / amount[:, None])
    return mass


def _continued(pieces: Facelets, mass: np.ndarray, wanted: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Evidence (F, C) that on `wanted` (F,) bool facelets is that of what lies around them: the mean of the neighbours that have
    any, or are `blank` (F,), ring by ring."""
    mass = np.where(wanted[:, None], 0, mass)
    known = ~wanted & (blank | (mass.sum(1) >= LEAST))
    left = np.flatnonzero(wanted)
    while len(left):
        there = pieces.neighbours[left]
        near = (there >= 0) & known[there]
        reached = near.any(1)
        if not reached.any():
            break
        rows, there, near = left[reached], there[reached], near[reached]
        mass[rows] = np.einsum("ne,nec->nc", near, mass[there]) / near.sum(1)[:, None]
        known[rows] = True
        left = left[~reached]
    return mass


def decided(mass: np.ndarray, class_ids: Sequence[int], void: int) -> tuple[np.ndarray, np.ndarray]:
    """The most probable class id (N,) int32 of evidence (N, C), `void` where there is next to none, and its confidence."""
    if not len(class_ids):
        return np.full(len(mass), void, np.int32), np.zeros(len(mass), np.float32)
    known = mass.sum(1) >= LEAST
    best = np.array(class_ids, np.int32)[mass.argmax(1)]
    return np.where(known, best, void).astype(np.int32), np.where(known, mass.max(1), 0).clip(0, 1).astype(np.float32)


def surface_classes(
    vertices: int, faces: np.ndarray, pieces: Facelets, evidence: Evidence, class_ids: Sequence[int], void: int
) -> SurfaceClasses:
    """Classes of the mesh's faces (F, 3) and its vertices, from those of its pieces, by area."""
    area = np.bincount(pieces.parent, pieces.areas, len(faces))
    mass = np.stack(
        [np.bincount(pieces.parent, pieces.areas * column, len(faces)) for column in evidence.mass.T]
        or [np.zeros(len(faces))],
        1,
    )
    at_vertex, around = np.zeros((vertices, mass.shape[1])), np.zeros(vertices)
    for corner in range(3):
        around += np.bincount(faces[:, corner], area, vertices)
        for number in range(mass.shape[1]):
            at_vertex[:, number] += np.bincount(faces[:, corner], mass[:, number], vertices)
    face_class, face_confidence = decided(mass / np.maximum(area, 1e-30)[:, None], class_ids, void)
    class_id, confidence = decided(at_vertex / np.maximum(around, 1e-30)[:, None], class_ids, void)
    return SurfaceClasses(face_class, face_confidence, class_id, confidence)


def class_maps(
    photos: Sequence[Photo],
    buffers: DepthBuffers,
    seen: Observations,
    evidence: Evidence,
    class_ids: Sequence[int],
    void: int,
    size: int,
    report: Reporter,
) -> ClassMaps:
    """Classes on a texture of `size`: facelets of one class are filled, in the others every texel asks the label maps."""
    pieces, index = buffers.pieces, index_of(class_ids)
    kind = np.uint8 if max([*class_ids, void]) < 256 else np.uint16
    ids, sure = np.full((size, size), void, kind), np.zeros((size, size), np.uint8)
    known = np.zeros((size, size), bool)
    piece_class, piece_confidence = decided(evidence.mass, class_ids, void)
    share = evidence.own.max(1, initial=0) >= CERTAIN * np.maximum(evidence.own.sum(1), 1e-6)
    plain = share & (evidence.own.sum(1) > 0)
    for edge in range(3):
        other = pieces.neighbours[:, edge]
        plain &= (other < 0) | (piece_class[other] == piece_class)
    mixed = ~plain & (evidence.own.sum(1) > 0)
    for edge in range(3):  # an outline may run close by
        mixed |= (pieces.neighbours[:, edge] >= 0) & (evidence.own[pieces.neighbours[:, edge]].sum(1) > 0) & ~plain
    tiles = [(x, y) for y in range(0, size, TILE) for x in range(0, size, TILE)]
    for number, (left, top) in enumerate(tiles):
        report.progress(number / len(tiles))
        tile = left, top, min(TILE, size - left), min(TILE, size - top)
        block = np.s_[top : top + tile[3], left : left + tile[2]]
        texels = texels_of(pieces, size, tile)
        owner = np.repeat(np.arange(len(pieces)), np.diff(texels.first))
        flat_id, flat_sure = np.full(tile[2] * tile[3], void, kind), np.zeros(tile[2] * tile[3], np.uint8)
        flat_id[texels.place] = piece_class[owner]
        flat_sure[texels.place] = piece_confidence[owner] * 255 + 0.5
        asked = np.flatnonzero(mixed)
        asked = asked[texels.first[asked + 1] > texels.first[asked]]
        # As many facelets at once as have ten million votes.
        sizes = np.cumsum((texels.first[asked + 1] - texels.first[asked]) * max(len(class_ids), 1))
        for part in np.split(asked, np.searchsorted(sizes, np.arange(1e7, sizes[-1], 1e7))) if len(asked) else []:
            texel, mass = _ask(photos, buffers, seen, evidence, texels, part, index, report)
            found, confidence = decided(mass, class_ids, void)
            flat_id[texels.place[texel]] = found
            flat_sure[texels.place[texel]] = confidence * 255 + 0.5
        ids[block], sure[block] = flat_id.reshape(tile[3], tile[2]), flat_sure.reshape(tile[3], tile[2])
        covered = np.zeros(tile[2] * tile[3], bool)
        covered[texels.place] = True
        known[block] = covered.reshape(tile[3], tile[2])
    _widened(ids, sure, known, report)
    return ClassMaps(ids, sure)


def _ask(
    photos: Sequence[Photo],
    buffers: DepthBuffers,
    seen: Observations,
    evidence: Evidence,
    texels: Texels,
    asked: np.ndarray,
    index: np.ndarray,
    report: Reporter,
) -> tuple[np.ndarray, np.ndarray]:
    """The texels (N,) of the facelets asked, and the evidence (N, C) there."""
    pieces, classes = buffers.pieces, evidence.mass.shape[1]
    texel, row = texels.of(asked)
    face = asked[row]
    points = texels.points(pieces, face, texel)
    best = np.maximum(seen.weight[asked].max(1), 1e-30)
    votes, total = PRIOR * evidence.mass[face], np.full(len(face), PRIOR, np.float32)
    unlabelled = np.zeros(len(face), np.float32)
    for number in np.unique(seen.view[asked]):
        report.check()
        labels = photos[number].labels if number >= 0 else None
        if labels is None:
            continue
        match = seen.view[asked] == number
        weight = np.where(match, seen.weight[asked], 0).max(1) / best
        rows = np.flatnonzero(weight[row] > 0)
        view = photos[number].view
        local = view.local(points[rows])
        towards = view.center - points[rows]
        cosine = np.einsum("ij,ij->i", towards, pieces.normals[face[rows]]) / np.linalg.norm(towards, axis=1)
        clear = buffers[int(number)].sees(view.pixels(local), view.depth(local), np.maximum(cosine, 0.05))
        rows, local = rows[clear], local[clear]
        ids, sure = labels()
        label = index[np.minimum(ids, len(index) - 1)]
        vote, known, told = read_votes(view, local, label, sure, classes)
        votes[rows] += vote * weight[row[rows], None]
        total[rows] += known * weight[row[rows]]
        unlabelled[rows] += (told - known) * weight[row[rows]]
    if not evidence.sparse:
        votes[(unlabelled > PRIOR * 0.5) & (total <= PRIOR * 1.5)] = 0
    return texel, votes / total[:, None]


def _widened(ids: np.ndarray, sure: np.ndarray, known: np.ndarray, report: Reporter) -> None:
    """Repeat the border of the charts in the gaps between them, in place."""
    size = len(ids)
    bands = [slice(begin, begin + max(1, BAND // size)) for begin in range(0, size, max(1, BAND // size))]
    pair = np.zeros((size + 2, size), np.uint32)
    for _ in range(MARGIN):
        # One number for both, so that a texel takes its class and its confidence from the same neighbour; 0: unknown.
        for band in bands:
            report.check()
            both = (sure[band].astype(np.uint32) << 16 | ids[band]) + 1
            pair[1:-1][band] = np.where(known[band], both, 0)
        for band in bands:
            report.check()
            around = pair[band.start : band.stop + 2]
            near = np.asarray(scipy.ndimage.maximum_filter(around, 3, mode="nearest"), np.uint32)[1:-1]
            rim = ~known[band] & (near > 0)
            ids[band][rim] = np.bitwise_and(near[rim] - 1, 0xFFFF).astype(ids.dtype)
            sure[band][rim] = np.right_shift(near[rim] - 1, 16)
            known[band] |= rim


def class_picture(ids: np.ndarray, colors: dict[int, tuple[float, float, float]]) -> np.ndarray:
    """Classes (S, S) as a picture (S, S, 3) uint8 of their sRGB colours in [0, 1]; dark grey for those without one."""
    table = np.full((int(ids.max(initial=0)) + 1, 3), 38, np.uint8)
    for number, color in colors.items():
        if number < len(table):
            table[number] = np.round(np.clip(color, 0, 1) * 255)
    return table[ids]
