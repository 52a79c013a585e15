"""The world frame of a capture: which way is up, where the ground is, how large things are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .similarity import make_similarity, transform_points

# Not tuned.
UNCERTAIN = 0.5  # confidence below which a level group of cameras is looked for
GROUND_THICKNESS = 0.015  # of the height of the points
GROUND_TILT = 6.0  # degrees from level
GROUND_SHARE = 0.1  # of the points near the subject
SIDEWAYS = 0.9  # certainty about a plane of down axes, and about the side from which it is seen
LEVEL_SHARE = 0.3  # of the cameras that such a group must have
ASKED = 200  # cameras at most, of which any two may span the plane of the group


def up_direction(camera_to_world: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """The up direction of a capture taken with a level camera, and how certain it is.

    People hold cameras level, so the cameras' right axes lie in the horizontal plane: up is the eigenvector of the
    smallest eigenvalue of Σ x xᵀ over the right axes x; its sign is that of the mean camera up. Where the right axes
    all agree (a single stand point) that plane is undetermined, and the mean camera up itself is taken. Where they
    fill no plane (an object that was laid on its side for some of the photos), it is the plane of most of them. Where
    the down axes fill a plane instead (photos taken, or stored, sideways), up is its normal, on the side from which
    the cameras look down.

    Args:
        camera_to_world: (4, 4) poses with OpenCV axes.
    Returns:
        up (3,), of unit length, in the frame of the poses; confidence in [0, 1]: 1 − λ₀/λ₁ of the eigenvalues, times
        the agreement of the cameras about the sign (and times the share of cameras in the plane, if not all; sideways
        photos are certain to a half at most).
    """
    poses = np.stack(camera_to_world)
    right, up = poses[:, :3, 0], -poses[:, :3, 1]
    axis, confidence = _plane_normal(right, up)
    if confidence < UNCERTAIN and len(poses) >= 8:
        level = _largest_level_group(right, up)
        if LEVEL_SHARE * len(poses) <= len(level) < len(poses):
            axis, certain = _plane_normal(right[level], up[level])
            confidence = max(confidence, certain * len(level) / len(poses))
    if confidence < UNCERTAIN:
        upended, certain = _plane_normal(poses[:, :3, 1], poses[:, :3, 0])
        downwards = np.sign(poses[:, :3, 2] @ upended)
        if certain > SIDEWAYS and abs(downwards.mean()) > SIDEWAYS:
            return upended * -np.sign(downwards.mean()), UNCERTAIN * certain * abs(float(downwards.mean()))
    return axis, confidence


def _plane_normal(right: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float]:
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    mean_up = up.mean(0)
    if len(right) < 2 or values[1] < 1e-3:
        # Level in one direction only: take the mean up, made square to the common right axis.
        side = vectors[:, 2]
        flat = mean_up - side * (side @ mean_up)
        length = np.linalg.norm(flat)
        return (flat / length if length > 1e-9 else up[0]), 0.0
    axis = vectors[:, 0] if vectors[:, 0] @ mean_up >= 0 else -vectors[:, 0]
    votes = abs(float(np.sign(up @ axis).mean()))
    return axis, float(np.clip((1 - values[0] / values[1]) * votes, 0, 1))


def _largest_level_group(right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Indices of the largest group of cameras that are level about one common up (within 5°)."""
    best = np.zeros(0, int)
    asked = np.linspace(0, len(right) - 1, min(ASKED, len(right))).round().astype(int)
    for number, i in enumerate(asked):
        for j in asked[number + 1 :]:
            axis = np.cross(right[i], right[j])
            length = np.linalg.norm(axis)
            if length < 0.3:
                continue
            axis = axis / length * (1 if up[i] @ axis >= 0 else -1)
            group = np.flatnonzero((np.abs(right @ axis) < np.sin(np.radians(5))) & (up @ axis > 0))
            if len(group) > len(best):
                best = group
    return best


def rotation_to_z(up: np.ndarray, forward: np.ndarray | None = None) -> np.ndarray:
    """Rotation (3, 3) that turns `up` (3,) into +z, and, as far as that leaves room, `forward` (3,) into +y."""
    z = up / np.linalg.norm(up)
    hint = np.array([0.0, 1.0, 0.0]) if forward is None else np.asarray(forward, np.float64)
    y = hint - z * (z @ hint)
    if np.linalg.norm(y) < 1e-6:
        hint = np.eye(3)[np.argmin(np.abs(z))]
        y = hint - z * (z @ hint)
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def focus_point(camera_to_world: Sequence[np.ndarray]) -> np.ndarray:
    """The point (3,) closest, in the least-squares sense, to all viewing axes of the cameras."""
    poses = np.stack(camera_to_world)
    direction, center = poses[:, :3, 2], poses[:, :3, 3]
    projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    # Axes that are nearly parallel meet nowhere: their common direction is left out.
    return np.linalg.lstsq(projector.sum(0), (projector @ center[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]


def upright(
    camera_to_world: Sequence[np.ndarray], points: np.ndarray | None = None, camera_distance: float = 3.0
) -> tuple[np.ndarray, float]:
    """A world frame for a capture of unknown scale: z up, the subject over the origin, the ground near z = 0.

    Args:
        camera_to_world: (4, 4) poses with OpenCV axes.
        points: sparse points (N, 3) in the same frame.
        camera_distance: the median distance of the cameras from the subject becomes this many units.
    Returns:
        world_from_sfm, a similarity (4, 4), and the confidence of the up direction.
    """
    poses = np.stack(camera_to_world)
    up, confidence = up_direction(camera_to_world)
    rotation = rotation_to_z(up, poses[:, :3, 2].mean(0))
    centers = poses[:, :3, 3]
    if points is not None and len(points) >= 20:
        center = np.median(points, axis=0)
    else:
        center = focus_point(camera_to_world)
    distance = float(np.median(np.linalg.norm(centers - center, axis=1)))
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    if not np.isfinite(distance) or distance > 100 * max(extent, 1e-12) or distance < 1e-9:
        # Parallel viewing axes have no focus: stay with the cameras.
        center, distance = centers.mean(0), max(extent, 1e-6)
    scale = camera_distance / distance
    frame = make_similarity(scale, rotation, -scale * rotation @ center)
    if points is not None:
        grounded = on_ground(points, frame)
        frame = frame if grounded is None else grounded
    return frame, confidence


def on_ground(points: np.ndarray, world_from_points: np.ndarray) -> np.ndarray | None:
    """The frame put upon the ground, or None when no horizontal ground is evident.

    The ground is a plane through the lower points, at most 6° from level: a tenth of the points near the subject lie
    in it, and hardly any below.

    Args:
        points: (N, 3) in any frame.
        world_from_points: similarity (4, 4) into a frame whose z is roughly up.
    """
    near = transform_points(world_from_points, points)
    if len(near) < 100:
        return None
    distance = np.linalg.norm(near - np.median(near, axis=0), axis=1)
    near = near[distance < 4 * np.median(distance)]
    height = _lowest_layer(near[:, 2])
    if height is None:
        return None
    thickness = GROUND_THICKNESS * np.ptp(np.quantile(near[:, 2], [0.02, 0.98]))
    normal, offset = np.array([0.0, 0.0, 1.0]), height
    for width in (4.0, 3.0, 2.0, 1.0, 1.0, 1.0):
        layer = near[np.abs(near @ normal - offset) < width * thickness]
        if len(layer) < 30:
            return None
        center = layer.mean(0)
        _, vectors = np.linalg.eigh((layer - center).T @ (layer - center))
        normal = vectors[:, 0] * (1.0 if vectors[2, 0] >= 0 else -1.0)
        offset = float(normal @ center)
    above = near @ normal - offset
    share = float((np.abs(above) < thickness).mean())
    below = float((above < -2 * thickness).mean())
    if normal[2] < np.cos(np.radians(GROUND_TILT)) or share < GROUND_SHARE or below > 0.05:
        return None
    turn = np.eye(4)
    # The smallest rotation that levels the ground, so that the heading stays.
    turn[:3, :3] = _smallest_rotation(normal)
    turn[2, 3] = -offset
    return turn @ world_from_points


def _smallest_rotation(normal: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) by the least angle that turns the unit vector `normal` (not −z) into +z (Rodrigues)."""
    x, y, z = normal
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + z)


def _lowest_layer(z: np.ndarray) -> float | None:
    """Height of the layer in which the lower points pile up, with at most 5 % of the points below it."""
    z = np.sort(z)
    low, high = np.quantile(z, [0.02, 0.98])
    thickness = max((high - low) * 2 * GROUND_THICKNESS, 1e-9)
    counts = np.searchsorted(z, z + thickness) - np.arange(len(z))
    candidates = np.arange(max(1, int(0.05 * len(z))))
    best = int(candidates[np.argmax(counts[candidates])])
    if counts[best] < 0.5 * GROUND_SHARE * len(z):
        return None
    return float(np.median(z[best : best + counts[best]]))


def axis_upright(camera_to_world: Sequence[np.ndarray]) -> np.ndarray:
    """Rotation (4, 4) for a data set whose frame has a level axis: the axis nearest to up becomes +z.

    Scale and origin stay those of the data set, as metric sets want it.
    """
    up, _ = up_direction(camera_to_world)
    axis = int(np.argmax(np.abs(up)))
    snapped = np.zeros(3)
    snapped[axis] = np.sign(up[axis])
    frame = np.eye(4)
    if axis == 2 and snapped[2] > 0:
        return frame
    frame[:3, :3] = rotation_to_z(snapped, np.eye(3)[(axis + 1) % 3])
    return frame
