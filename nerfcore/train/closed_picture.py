"""A picture of the cells that rules closed before training, for someone who misses a thing in the field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..files import atomic_path
from ..geometry.contraction import grid_position
from ..sampling.known_space import KnownSpace

VIEWS = {"from above": (0, 1), "from the side": (0, 2)}  # axes of the box across and up
COLORS = ("tab:orange", "tab:purple", "tab:blue")
MOST_POINTS = 20000
NAME = "closed.png"


def closed_picture(run: Path) -> str | None:
    """Where a run's folder shows what rules closed before training; None where they closed nothing."""
    path = run / NAME
    return str(path) if path.is_file() else None


def picture_closed(run: Path, space: KnownSpace | None, centers: torch.Tensor, points: torch.Tensor) -> None:
    """Show in a run's folder which cells rules closed before training; a picture of an older one goes. See
    `write_closed_picture`."""
    path = run / NAME
    path.unlink(missing_ok=True)
    if space is not None:
        write_closed_picture(path, space, centers, points)


def write_closed_picture(path: Path, space: KnownSpace, centers: torch.Tensor, points: torch.Tensor) -> bool:
    """Draw which cells each rule closed, as seen from above and from the side of the box, with camera centres (V, 3)
    and sparse points (N, 3), normalised. Returns False, and writes nothing, where no rule closed anything.

    Space is drawn as the grid has it: where it is contracted, the inner half of the picture is the box.

    Raises:
        DiskError: the file cannot be written.
    """
    if not any(bool(cells.any()) for cells in space.closed.values()):
        return False
    # Loaded where it draws: each training would wait for it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(9, 5.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    cameras, cloud = (
        grid_position(x, space.contracted).cpu().numpy() for x in (centers, points[:: 1 + len(points) // MOST_POINTS])
    )
    side = space.resolution
    for axes, (title, (across, up)) in zip(figure.subplots(1, len(VIEWS)), VIEWS.items()):
        along = ({0, 1, 2} - {across, up}).pop()
        for color, cells in zip(COLORS, space.closed.values()):
            # cells are z, y, x
            depth = cells.view(side, side, side).float().mean(2 - along).cpu().numpy()
            shown = np.zeros((*depth.shape, 4))
            shown[...] = to_rgba(color)
            shown[..., 3] = 0.75 * np.sqrt(depth / max(float(depth.max()), 1e-9))
            axes.imshow(shown, origin="lower", extent=(0, 1, 0, 1), interpolation="nearest")
        axes.scatter(cloud[:, across], cloud[:, up], s=1, c="0.4", linewidths=0)
        axes.scatter(cameras[:, across], cameras[:, up], s=14, c="black", marker="^")
        if space.contracted:
            axes.plot([0.25, 0.75, 0.75, 0.25, 0.25], [0.25, 0.25, 0.75, 0.75, 0.25], c="0.7", linewidth=0.8)
        axes.set(title=title, xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal")
    handles = [
        Patch(color=color, label=f"closed: {rule} ({float(cells.float().mean()):.1%} of the cells)")
        for color, (rule, cells) in zip(COLORS, space.closed.items())
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=1, fontsize="small", frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
    return True
