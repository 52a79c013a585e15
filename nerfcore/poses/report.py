"""The picture of a pose estimate: cameras and points from above and from the side, and the graph of matches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..files import atomic_path
from ..geometry.points import Points
from ..geometry.similarity import transform_points, transform_pose
from ..project.schema import ImageRecord, Poses, Project
from ..project.store import world_from_sfm

MAX_POINTS = 20000


def draw_report(
    path: Path,
    project: Project,
    poses: Poses,
    points: Points,
    records: list[ImageRecord],
    links: list[list],
    names: dict[str, str],
) -> None:
    """Write the picture as PNG. `links` are [file, file, matches]; `names` photo names by file."""
    frame = world_from_sfm(project)
    cameras = np.stack([transform_pose(frame, np.array(image.camera_to_world)) for image in poses.images])
    cloud = transform_points(frame, points.xyz)
    shown = np.linspace(0, len(cloud) - 1, min(MAX_POINTS, len(cloud))).astype(int) if len(cloud) else []
    figure = Figure(figsize=(15, 5.4), layout="constrained")
    top, side, graph = figure.subplots(1, 3)
    middle, reach = _middle_and_reach(cameras[:, :3, 3], cloud)
    for axes, (a, b), title in ((top, (0, 1), "from above (x, y)"), (side, (0, 2), "from the side (x, z)")):
        axes.scatter(cloud[shown, a], cloud[shown, b], s=1, c=points.rgb[shown] / 255, linewidths=0)
        centers, ahead = cameras[:, :3, 3], cameras[:, :3, 2] * 0.1 * reach
        axes.quiver(
            centers[:, a], centers[:, b], ahead[:, a], ahead[:, b],
            angles="xy", scale_units="xy", scale=1, width=0.004, color="#d55e00",
        )  # fmt: skip
        axes.set(title=title, xlim=(middle[a] - reach, middle[a] + reach), ylim=(middle[b] - reach, middle[b] + reach))
        axes.set_aspect("equal")
    _draw_graph(graph, records, links, names)
    confidence = project.frame.up_confidence
    up = f", up certain to {confidence:.2f}" if confidence is not None else ""
    error = f", {poses.reprojection_px:.2f} px" if poses.reprojection_px is not None else ""
    figure.suptitle(f"{len(poses.images)} of {len(records)} photos placed, {len(points)} points{error}{up}")
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(str(temporary))


def _middle_and_reach(centers: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle (3,) and half the width of the drawn square: all cameras, and the bulk of the points near them."""
    low, high = centers.min(0), centers.max(0)
    if len(cloud):
        distance = np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1)
        near = cloud[distance <= 3 * np.median(distance)]
        low, high = np.minimum(low, near.min(0)), np.maximum(high, near.max(0))
    return (low + high) / 2, 0.55 * max(float((high - low).max()), 1e-6)


def _draw_graph(axes, records: list[ImageRecord], links: list[list], names: dict[str, str]) -> None:
    """Photos on a circle in name order; a line for every verified pair, darker with more matches (by their logarithm)."""
    order = {record.name: i for i, record in enumerate(records)}
    angle = np.arange(len(records)) / max(len(records), 1) * 2 * np.pi
    place = np.stack([np.sin(angle), np.cos(angle)], -1)
    strongest = np.log(max((count for *_, count in links), default=2))
    for a, b, count in sorted(links, key=lambda link: link[2]):
        ends = place[[order[names[a]], order[names[b]]]]
        strength = np.log(max(count, 2)) / max(strongest, 1.0)
        axes.plot(ends[:, 0], ends[:, 1], color="#0072b2", alpha=float(np.clip(strength**4, 0.06, 1)), lw=0.8)
    good = np.array([record.status == "ok" for record in records])
    axes.scatter(*place[good].T, s=18, c="#009e73", zorder=3, label="placed")
    if (~good).any():
        axes.scatter(*place[~good].T, s=28, c="#d55e00", marker="x", zorder=3, label="without a pose")
    step = max(1, -(-len(records) // 60))
    for i, record in enumerate(records):
        if i % step == 0 or not good[i]:
            # Along the radius, so that neighbours do not cover each other; never upside down.
            degrees = 90 - np.degrees(angle[i])
            left = np.sin(angle[i]) < 0
            x, y = place[i] * 1.06
            axes.text(
                x, y, record.name, fontsize=6, rotation=degrees + 180 * left, rotation_mode="anchor",
                ha="right" if left else "left", va="center",
            )  # fmt: skip
    axes.set(title="matches between photos", xlim=(-1.5, 1.5), ylim=(-1.5, 1.5))
    axes.set_aspect("equal")
    axes.axis("off")
    axes.legend(loc="lower left", fontsize=7, frameon=False)
