"""How things stand to each other: *on, in, next to, part of, hangs on*, from their surfaces alone.

Surfaces of captures are torn and touch each other only at their rims, since no photo shows what a thing stands on. So all
is told by points of the surfaces, their normals, and how close they come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy

Kind = Literal["on", "in", "next to", "part of", "hangs on"]
KINDS: tuple[Kind, ...] = ("on", "in", "next to", "part of", "hangs on")
TOUCH = 0.01  # of the size of the scene: a smaller gap is contact
UPWARD = 0.7  # of a normal's height, from which a face carries what lies on it
SIDEWAYS = 0.5  # of the same, below which things hang there
FOOT = 0.25  # share of a thing's height, from below, in which it is carried
INSIDE = 0.8  # share of a thing that lies within the hull of what it is in
WALLED = 0.7  # share of the directions around a thing in which there is that
BESIDE = 1.0  # of the narrower one's width: a smaller gap is "next to"
LEVEL = 0.5  # share of the smaller one's height that both have in common then
SECTORS = 24  # directions around


@dataclass(frozen=True)
class Thing:
    """An instance by points (N, 3) of its surface in the world (z up), unit normals (N, 3) outward, and its area.
    `branch`: names of its class, from the root of the tree of classes: “chair/leg” is a part of “chair”."""

    id: int
    name: str
    branch: tuple[str, ...]
    points: np.ndarray
    normals: np.ndarray
    area: float

    @property
    def low(self) -> np.ndarray:
        return self.points.min(0)

    @property
    def high(self) -> np.ndarray:
        return self.points.max(0)


class Relation(NamedTuple):
    """`subject` is `kind` of `other`, both ids of things; `gap` between them in world units."""

    subject: int
    kind: Kind
    other: int
    gap: float


@dataclass(frozen=True)
class Contact:
    """Where points of one thing come close to another: gap, the smallest distance; foot: the share of the close points
    that is at its foot; carried, hung: the share whose neighbour on the other thing faces up, or to a side or down."""

    gap: float
    foot: float
    carried: float
    hung: float
    height: float  # middle of the close points


def relations(things: Sequence[Thing]) -> list[Relation]:
    """All relations between things, those of one thing together, in the order of the things.

    “in” rules out “on” and “hangs on”, “on” rules out “hangs on”; “next to” stands between things without another
    relation, and once for both. Only what is direct is told: not that what is in a bowl on a table is on the table.
    """
    if len(things) < 2:
        return []
    every = np.concatenate([thing.points for thing in things])
    touch = TOUCH * float(np.linalg.norm(np.ptp(every, axis=0)))
    trees = [scipy.spatial.KDTree(thing.points) for thing in things]
    hulls = [_hull(thing.points) for thing in things]
    found: dict[tuple[int, int], Relation] = {}
    contacts = {
        (a, b): contact(things[a], things[b], trees[b], touch)
        for a in range(len(things))
        for b in range(len(things))
        if a != b and (_distance_of_boxes(things[a], things[b]) <= touch)
    }
    for (a, b), near in contacts.items():
        one, other = things[a], things[b]
        if near.gap <= touch and is_branch(one.branch, other.branch):
            found[a, b] = Relation(one.id, "part of", other.id, near.gap)
        elif is_in(one, other, hulls[a], hulls[b]):
            found[a, b] = Relation(one.id, "in", other.id, near.gap)
    # The smaller one first: of two flat things one above the other, it is the one that lies on top.
    for (a, b), near in sorted(contacts.items(), key=lambda pair: things[pair[0][0]].area):
        if near.gap <= touch and not {(a, b), (b, a)} & found.keys() and is_on(things[a], near):
            found[a, b] = Relation(things[a].id, "on", things[b].id, near.gap)
    standing = {a for (a, _), relation in found.items() if relation.kind in ("on", "in", "part of")}
    for (a, b), near in contacts.items():
        hangs = near.gap <= touch and near.hung > 0.5 and things[a].area < things[b].area
        if hangs and a not in standing and not {(a, b), (b, a)} & found.keys():
            found[a, b] = Relation(things[a].id, "hangs on", things[b].id, near.gap)
    found = _direct(found)
    for a, one in enumerate(things):
        for b in range(a + 1, len(things)):
            if not {(a, b), (b, a)} & found.keys():
                gap = beside(one, things[b], trees[b])
                if gap is not None:
                    found[a, b] = Relation(one.id, "next to", things[b].id, gap)
    order = {thing.id: number for number, thing in enumerate(things)}
    return sorted(found.values(), key=lambda r: (order[r.subject], KINDS.index(r.kind), order[r.other]))


def is_branch(branch: tuple[str, ...], trunk: tuple[str, ...]) -> bool:
    """Whether a class grows from another one in the tree of classes."""
    return len(branch) > len(trunk) and branch[: len(trunk)] == trunk


def contact(one: Thing, other: Thing, tree: scipy.spatial.KDTree, touch: float) -> Contact:
    """How the points of one thing come close to another one, whose points the tree holds."""
    distance, nearest = (np.asarray(part) for part in tree.query(one.points))
    gap = float(distance.min())
    close = distance <= max(touch, gap * 1.05)
    height = one.points[close, 2]
    foot = one.low[2] + FOOT * (one.high[2] - one.low[2]) + touch
    facing = other.normals[nearest[close]][:, 2]
    # A rim that touches is enough to be carried: walls beside it count for nothing.
    low = height <= foot
    carried = float((facing[low] > UPWARD).mean()) if low.any() else 0.0
    hung = float((facing < SIDEWAYS).mean())
    return Contact(gap, float(low.mean()), carried, hung, float(np.median(height)))


def is_on(one: Thing, near: Contact) -> bool:
    """Whether a thing stands on what it comes close to so."""
    return near.foot > 0.5 and near.carried > 0.3 and float(np.median(one.points[:, 2])) >= near.height


def is_in(
    one: Thing, other: Thing, own: scipy.spatial.ConvexHull | None, hull: scipy.spatial.ConvexHull | None
) -> bool:
    """Whether a thing lies within the hull of another, which stands around it and is larger."""
    if hull is None or (own is not None and own.volume >= hull.volume):
        return False
    inside = (one.points @ hull.equations[:, :3].T + hull.equations[:, 3] <= 1e-9).all(1)
    if inside.mean() < INSIDE:
        return False
    middle = np.median(one.points, 0)
    # At its own height there must be walls around it: the legs of a table are too thin, and its top is above.
    height = one.high[2] - one.low[2]
    level = (other.points[:, 2] >= one.low[2] + 0.25 * height) & (other.points[:, 2] <= one.high[2])
    around = other.points[level][:, :2] - middle[:2]
    sector = ((np.arctan2(around[:, 1], around[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    return len(np.unique(sector)) >= WALLED * SECTORS


def beside(one: Thing, other: Thing, tree: scipy.spatial.KDTree) -> float | None:
    """The gap between two things that stand next to each other; None where they do not."""
    width = min(float(np.ptp(thing.points[:, :2], axis=0).min()) for thing in (one, other))
    if _distance_of_boxes(one, other) > BESIDE * width:
        return None
    common = min(one.high[2], other.high[2]) - max(one.low[2], other.low[2])
    height = min(one.high[2] - one.low[2], other.high[2] - other.low[2])
    if common < LEVEL * height:
        return None
    gap = float(np.asarray(tree.query(one.points)[0]).min())
    return gap if gap <= BESIDE * width else None


def _direct(found: dict[tuple[int, int], Relation]) -> dict[tuple[int, int], Relation]:
    """The relations without those that follow from others: what lies on or in a thing that is on or in a third one is by
    itself neither on nor in that, though a thin one leaves it within reach."""
    holders: dict[int, set[int]] = {}
    for (a, b), relation in found.items():
        if relation.kind in ("on", "in"):
            holders.setdefault(a, set()).add(b)

    def follows(a: int, b: int) -> bool:
        return any(b in holders.get(between, ()) for between in holders.get(a, set()) - {b})

    return {(a, b): r for (a, b), r in found.items() if r.kind not in ("on", "in") or not follows(a, b)}


def _hull(points: np.ndarray) -> scipy.spatial.ConvexHull | None:
    """The convex hull of points; None where they are flat."""
    try:
        return scipy.spatial.ConvexHull(points)
    except scipy.spatial.QhullError:
        return None


def _distance_of_boxes(one: Thing, other: Thing) -> float:
    """Distance between the boxes around two things, 0 where they meet."""
    apart = np.maximum(np.maximum(one.low - other.high, other.low - one.high), 0)
    return float(np.linalg.norm(apart))
