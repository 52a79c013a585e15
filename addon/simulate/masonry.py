"""Dressed stone that the weather has been at: shapes as arrays of points, and what has become of every face.

Metres, z up; facades face −y. `shift` (3,) moves the noise, so that another seed gives another stone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Vector, noise

from .shapes import centers_normals, painted, per_face, sheet

STONE, MOSS, CRUST, CRACK, LOSS = range(5)  # material slots of everything made of stone
MORTAR = 1.0  # the "tint" of a joint; blocks have 0.1 to 0.9, see materials.sandstone
STEP = 0.0125  # of the wall's grid, about one and a half pixels of a photo
THICK = 0.42  # of the wall
Polyline = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Opening:
    """An opening with a round arch: its middle, its sill, where the arch begins, half its width; metres."""

    x: float
    sill: float
    spring: float
    radius: float

    def outside(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Distance to the edge (metres), negative within."""
        upper = np.hypot(x - self.x, z - self.spring) - self.radius
        lower = np.maximum(np.abs(x - self.x) - self.radius, self.sill - z)
        return np.where(z > self.spring, upper, lower)

    def path(self, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 2) x, z of the edge from the left of the sill over the arch, and outward directions (n, 2)."""
        up = np.arange(self.sill, self.spring, step)
        turn = np.linspace(np.pi, 0, int(np.pi * self.radius / step))
        side, level = np.array([[1.0, 0.0]]).repeat(len(up), 0), self.radius * np.ones_like(up)
        left, right = np.stack([self.x - level, up], 1), np.stack([self.x + level, up], 1)[::-1]
        around = np.stack([np.cos(turn), np.sin(turn)], 1)
        crown = around * self.radius + (self.x, self.spring)
        return np.concatenate([left, crown, right]), np.concatenate([-side, around, side])


def noise_at(points: np.ndarray, scale: float, shift: np.ndarray, octaves: int = 3) -> np.ndarray:
    """Smooth noise of about ±0.7 at points (..., 3)."""
    flat = (points.reshape(-1, 3) * scale + shift).tolist()
    return np.array([noise.fractal(Vector(p), 1.0, 2.0, octaves) for p in flat]).reshape(points.shape[:-1])


def smooth(value: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def weather(
    centers: np.ndarray,
    normals: np.ndarray,
    shift: np.ndarray,
    damp: np.ndarray | float = 0,
    shelter: np.ndarray | float = 0,
) -> np.ndarray:
    """What has grown on stone, as a slot per face: moss where it is damp, black crust where no rain gets.

    Args:
        centers, normals: (F, 3) of the faces.
        damp, shelter: (F,) from 0 to 1, beyond what height and direction tell.
    """
    up, rough = normals[:, 2], 0.4 * noise_at(centers, 11, shift, 2)
    wet = np.maximum(np.exp(-np.maximum(centers[:, 2], 0) / 0.16), damp) + 0.8 * smooth(up, 0.5, 0.9)
    moss = noise_at(centers, 2.4, shift) + rough + 0.75 * wet > 0.66
    streaks = noise_at(centers * (1, 1, 0.35), 3.4, shift + 7)
    crust = streaks + rough + 0.75 * shelter + 0.5 * smooth(-up, 0.3, 0.9) - 0.3 * smooth(up, 0.4, 0.8) > 0.6
    return np.where(moss, MOSS, np.where(crust, CRUST, STONE))


def solid(
    name: str,
    rings: np.ndarray,
    slots: list[bpy.types.Material],
    shift: np.ndarray,
    *,
    rough: float = 0.012,
    tint: np.ndarray | None = None,
    shelter: float = 0,
) -> bpy.types.Object:
    """A weathered stone of the shape of a closed tube of `rings` (n, m, 3); `tint` (n,) per ring."""
    middle = rings.mean(1, keepdims=True)
    outward = rings - middle
    outward /= np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-9)
    worn = noise_at(rings, 5, shift)[..., None] + 0.3 * noise_at(rings, 16, shift, 2)[..., None]
    rings = rings + outward * rough * (worn - 0.2)
    shrink = np.linspace(1, 1e-3, 6)[1:, None, None]
    caps = [rings[i].mean(0) + (rings[i] - rings[i].mean(0)) * shrink for i in (0, -1)]
    vertices, quads = sheet(np.concatenate([caps[0][::-1], rings, caps[1]]), wrap=True)
    tints = np.full(len(rings), 0.45) if tint is None else tint
    tints = np.pad(tints, 5, mode="edge")[:-1].repeat(rings.shape[1])
    centers, normals = centers_normals(vertices, quads)
    # The direction in which the tube was given is free.
    axis = np.pad(middle[:, 0], ((5, 5), (0, 0)), mode="edge")[:-1].repeat(rings.shape[1], 0)
    if ((centers - axis) * normals).sum() < 0:
        quads, normals = quads[:, ::-1], -normals
    return painted(name, vertices, quads, slots, weather(centers, normals, shift, shelter=shelter), tints)


def outline(corners: Polyline, step: float = 0.018) -> np.ndarray:
    """A closed polygon with slightly rounded corners as points (m, 2) about `step` metres apart."""
    points = []
    for a, b in zip(corners, [*corners[1:], corners[0]]):
        count = max(1, round(float(np.hypot(b[0] - a[0], b[1] - a[1])) / step))
        points += [np.array(a) + (np.array(b) - np.array(a)) * i / count for i in range(count)]
    found = np.array(points)
    return (np.roll(found, 1, 0) + 2 * found + np.roll(found, -1, 0)) / 4


def along_x(profile: np.ndarray, start: float, end: float, step: float = 0.02) -> np.ndarray:
    """Rings (n, m, 3) of a profile (m, 2) y, z drawn along x."""
    xs = np.linspace(start, end, max(2, round((end - start) / step)))
    flat = np.broadcast_to(profile, (len(xs), *profile.shape))
    return np.concatenate([np.broadcast_to(xs[:, None, None], (len(xs), len(profile), 1)), flat], 2)


def turned(profile: Polyline, x: float, y: float, sides: int = 40, step: float = 0.02) -> np.ndarray:
    """Rings (n, sides, 3) of a profile of (radius, height) turned around an upright axis at x, y."""
    radius, height = np.array(profile).T
    path = np.concatenate([[0], np.cumsum(np.hypot(np.diff(radius), np.diff(height)))])
    fine = np.linspace(0, path[-1], round(path[-1] / step))
    r, z = np.interp(fine, path, radius)[:, None], np.interp(fine, path, height)[:, None]
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    return np.stack([x + r * np.cos(angle), y + r * np.sin(angle), z + 0 * angle], 2)


def around(
    opening: Opening, profile: np.ndarray, block: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Rings (n, m, 3) of a surround with a profile (m, 2) outward, y, and the tint (n,) of its blocks of one length."""
    path, out = opening.path(0.014)
    length = np.arange(len(path)) * 0.014 / block
    joint = smooth(np.abs(length - np.round(length)) * block, 0.006, 0.02)
    flat = path[:, None] + out[:, None] * profile[None, :, :1]
    y = np.broadcast_to(profile[:, 1], flat.shape[:2]) + 0.01 * (1 - joint[:, None])
    tints = random.uniform(0.1, 0.9, int(length[-1]) + 3)[np.round(length).astype(int)]
    return np.stack([flat[..., 0], y, flat[..., 1]], 2), np.where(joint < 0.5, MORTAR, tints)


@dataclass(frozen=True)
class Wall:
    """What a wall is like: its blocks up to a broken top, openings, ledges, cracks and places where stone is lost.

    top: x, z of the broken top; ledges: z, from x, to x of what keeps the rain off; cracks: polylines x, z;
    losses: x, z, radius.
    """

    half: float
    courses: Sequence[float]
    top: Polyline
    openings: Sequence[Opening]
    ledges: Sequence[tuple[float, float, float]]
    cracks: Sequence[Polyline]
    losses: Sequence[tuple[float, float, float]]


def build_wall(
    wall: Wall, slots: list[bpy.types.Material], shift: np.ndarray, random: np.random.Generator
) -> bpy.types.Object:
    """The wall as one surface with its broken edges, facing −y at about y = 0; the back stays open."""
    nx, nz = round(2 * wall.half / STEP), round(wall.courses[-1] / STEP)
    x, z = np.meshgrid(np.linspace(-wall.half, wall.half, nx + 1), np.linspace(0, wall.courses[-1], nz + 1))
    flat = np.stack([x, 0 * x, z], 2)
    wobble = [0.012 * noise_at(flat, 6, shift + k, 2) for k in (1, 2)]
    standing, joint, tint, bulge = _blocks(wall, x + wobble[0], z + wobble[1], random)

    lost = np.max([1 - np.hypot(x - a, z - b) / r for a, b, r in wall.losses], 0) + 0.45 * noise_at(flat, 4, shift + 3)
    split = np.min([_crack(line, x, z, flat, shift + 5) for line in wall.cracks], 0)
    depth = 0.016 * (1 - joint) - bulge + 0.008 * noise_at(flat, 9, shift, 2)
    hollow = smooth(lost, -0.03, 0.08)
    depth = depth * (1 - 0.6 * hollow) + 0.05 * hollow + 0.03 * smooth(-split, -0.004, 0.008)
    top = np.interp(x, *np.array(wall.top).T)
    shelter = np.max([_below(x, z, ledge) for ledge in wall.ledges], 0)

    vertices, quads = sheet(np.stack([x, depth, z], 2))
    outside = np.min([opening.outside(x, z) for opening in wall.openings], 0)
    keep = (per_face(quads, standing.astype(float)) > 0.5) & (per_face(quads, outside) > 0.04)
    centers, _ = centers_normals(vertices, quads)
    facing = np.broadcast_to([0.0, -1.0, 0.0], centers.shape)  # without the joints, which would be speckled
    slot = weather(
        centers, facing, shift, 0.8 * np.exp(-np.maximum(per_face(quads, top - z), 0) / 0.1), per_face(quads, shelter)
    )
    slot = np.where(per_face(quads, lost) > 0, LOSS, slot)
    slot = np.where(per_face(quads, split) < 0, CRACK, slot)
    tints = np.where(per_face(quads, joint) < 0.5, MORTAR, per_face(quads, tint))

    more, more_quads = _broken_edges(vertices, quads[keep])
    edge_slot = weather(*centers_normals(more, more_quads), shift)
    return painted(
        "wall",
        np.concatenate([vertices, more]),
        np.concatenate([quads[keep], more_quads + len(vertices)]),
        slots,
        np.concatenate([slot[keep], edge_slot]),
        np.concatenate([tints[keep], np.full(len(edge_slot), 0.3)]),
    )


def _blocks(wall: Wall, x: np.ndarray, z: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Per point: whether its block still stands, 0 to 1 from the joint into the block, its tint, how far it stands out."""
    standing, joint = np.zeros(x.shape, bool), np.zeros(x.shape)
    tint, bulge = np.zeros(x.shape), np.zeros(x.shape)
    tops, levels = np.array(wall.top).T
    for row, (low, high) in enumerate(zip(wall.courses, wall.courses[1:])):
        inside = (z >= low) & (z < high) | (row == 0) & (z < low)
        start = -wall.half + (0.02 if row % 2 else 0.2)  # the ends are toothed
        widths = np.cumsum(random.uniform(0.32, 0.62, 20))
        ends = np.concatenate([[start], start + widths[start + widths < wall.half - (0.2 if row % 2 else 0.4)]])
        ends = np.append(ends, wall.half - (0.2 if row % 2 else 0.03))
        block = np.clip(np.searchsorted(ends, x[inside]) - 1, 0, len(ends) - 2)
        middle = (ends[block] + ends[block + 1]) / 2
        stands = (low + high) / 2 < np.interp(middle, tops, levels)
        standing[inside] = stands & (x[inside] > ends[0]) & (x[inside] < ends[-1])
        near = np.minimum(np.minimum(x[inside] - ends[block], ends[block + 1] - x[inside]), z[inside] - low)
        joint[inside] = smooth(np.minimum(near, high - z[inside]), 0.005, 0.022)
        tint[inside] = random.uniform(0.1, 0.9, len(ends))[block]
        bulge[inside] = random.normal(0, 0.008, len(ends))[block]
    return standing, joint, tint, bulge


def _crack(line: Polyline, x: np.ndarray, z: np.ndarray, flat: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Distance to the edge of a ragged crack (metres), negative within; it narrows towards its end."""
    wander = 0.07 * noise_at(flat, 3.5, shift)
    points, best = np.array(line), np.full(x.shape, np.inf)
    for i, (a, b) in enumerate(zip(points, points[1:])):
        along = np.clip(((x + wander - a[0]) * (b - a)[0] + (z - a[1]) * (b - a)[1]) / ((b - a) ** 2).sum(), 0, 1)
        away = np.hypot(x + wander - a[0] - along * (b - a)[0], z - a[1] - along * (b - a)[1])
        width = np.interp(i + along, [0, len(points) - 1], [0.026, 0.011])
        best = np.minimum(best, away - width)
    return best


def _below(x: np.ndarray, z: np.ndarray, ledge: tuple[float, float, float]) -> np.ndarray:
    level, start, end = ledge
    under = np.where(z < level, np.exp(-(level - z) / 0.24), 0)
    return under * smooth(x, start - 0.05, start + 0.05) * (1 - smooth(x, end - 0.05, end + 0.05))


def _broken_edges(vertices: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and quads from the open edges of the front back to the wall's thickness."""
    pairs = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    key, count = np.unique(np.sort(pairs, 1), axis=0, return_counts=True)
    single = {tuple(pair) for pair in key[count == 1].tolist()}
    border = np.array([pair for pair in pairs.tolist() if tuple(sorted(pair)) in single])
    front = vertices[border]
    back = np.stack([front[..., 0], np.full(front.shape[:2], THICK), front[..., 2]], -1)
    points = np.linspace(front, back, 15)  # (15, E, 2, 3)
    index = np.arange(points.size // 3).reshape(points.shape[:3])
    faces = np.stack([index[:-1, :, 1], index[:-1, :, 0], index[1:, :, 0], index[1:, :, 1]], -1).reshape(-1, 4)
    return points.reshape(-1, 3), faces
