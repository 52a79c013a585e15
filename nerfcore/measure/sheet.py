"""A drawing on paper at a stated scale: picture, section lines, grid with coordinates, scale bar, legend.

Matplotlib takes long to load: only what draws loads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SettingError
from ..files import atomic_path
from ..progress import go_on
from .lettering import fitted, lettering, wrapped
from .wording import significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM = 1 / 25.4  # inches
DPI = 200
LEFT, RIGHT, TOP, BOTTOM = 18.0, 62.0, 14.0, 26.0  # margins in mm; the legend stands in the right one
ROW, LINE = 6.0, 2.7  # mm from one entry of the legend to the next, and between lines of one
LEGEND = 36  # characters of a line of the legend
ROOM = 400.0, 280.0  # mm that a drawing may take where no scale is asked for: about A3 with its margins
SMALLEST = 60.0  # mm, so that scale bar and title have room
LARGEST = 2000.0  # mm
GRID = 10.0  # mm between lines of the grid at least, so that the coordinates beside it have room
# N of 1 : N, from 1000000:1 to 1:10^12: of things in scene units sizes say nothing.
SCALES = [1 / (n * 10**k) for k in reversed(range(6)) for n in (10, 5, 2.5, 2)] + [
    n * 10**k for k in range(12) for n in (1, 2, 2.5, 5)
]
FORMATS = ("png", "svg", "pdf")
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Entry:
    """A line of the legend."""

    text: str
    color: Color
    hatch: str = ""


@dataclass(frozen=True)
class Zone:
    """A part of the drawing that is hatched and outlined: mask (H, W) bool over all of the image."""

    mask: np.ndarray
    color: Color
    hatch: str


@dataclass(frozen=True)
class Mark:
    """A number at a place of the drawing, in world units."""

    x: float
    y: float
    text: str


@dataclass(frozen=True)
class Sheet:
    """What is drawn: the window low, high (2,) of the drawing in world units; image (H, W, 3) uint8 over all of it;
    lines (S, 2, 2) with a colour (S, 3) each; zones of the image, and marks. scale: 1 : scale on paper; metric: whether a unit is a metre; note: stands below it, and
    in the metadata of its files."""

    title: str
    low: np.ndarray
    high: np.ndarray
    scale: float
    metric: bool
    image: np.ndarray
    axes: tuple[str, str]
    legend: list[Entry] = field(default_factory=list)
    heading: str = ""
    lines: np.ndarray | None = None
    line_colors: np.ndarray | None = None
    zones: list[Zone] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    note: str = ""


def label_note(revision: int | None) -> str:
    """What a drawing says of the revision of the marks that its classes are from; empty where they are from none."""
    return "" if revision is None else f"labels of revision {revision}"


def chosen_scale(size: np.ndarray, asked: float | None) -> float:
    """The scale 1 : N of a drawing of a size (2,) in world units: the one asked for, else the largest that fits.

    Raises:
        SettingError: the drawing would be too large for any paper.
    """
    paper = size * 1000
    if asked is None:
        return float(next((s for s in SCALES if (paper / s <= ROOM).all()), SCALES[-1]))
    if (paper / asked > LARGEST).any():
        width, height = paper / asked
        raise SettingError(
            f"At {ratio(asked)} the drawing is {width:.0f} × {height:.0f} mm.", "Choose a smaller scale."
        )
    return asked


def ratio(scale: float) -> str:
    """A scale 1 : N in words: “1:50”, of what is drawn larger than it is “2:1”."""
    return f"1:{significant(scale, 6)}" if scale >= 1 else f"{significant(1 / scale, 6)}:1"


def nice_step(length: float, parts: float) -> float:
    """A round number (1, 2 or 5 times a power of ten) that goes into a length about so many times, or less often."""
    raw = max(length, 1e-9) / parts
    power = 10.0 ** np.floor(np.log10(raw))
    return float(next(n * power for n in (1, 2, 5, 10) if n * power >= raw * 0.999))


def write_sheet(stem: Path, sheet: Sheet, check: Callable[[], None] = go_on) -> list[Path]:
    """Write a sheet as STEM.png, STEM.svg and STEM.pdf, each in its true size; `check` is called before each of these, which
    take a second. Raises DiskError."""
    with lettering():
        return _write(stem, sheet, check)


def _write(stem: Path, sheet: Sheet, check: Callable[[], None]) -> list[Path]:
    check()
    figure = _figure(sheet)
    paths = []
    for kind in FORMATS:
        check()
        path = stem.with_name(f"{stem.name}.{kind}")
        with atomic_path(path) as temporary:
            told = {"Title": sheet.title} | (
                {"Subject" if kind == "pdf" else "Description": sheet.note} if sheet.note else {}
            )
            figure.savefig(temporary, format=kind, dpi=DPI, metadata=told)
        paths.append(path)
    figure.clear()  # it refers to itself, and its picture would stay until garbage is collected
    return paths


def _figure(sheet: Sheet) -> Figure:
    """The sheet as a figure whose axes are as large on paper as the scale says."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    extent = sheet.high - sheet.low
    drawn = extent * 1000 / sheet.scale
    width, height = np.maximum(drawn, SMALLEST) + [LEFT + RIGHT, TOP + BOTTOM]
    height = max(height, TOP + BOTTOM + 2 * ROW + sum(_tall(entry) for entry in sheet.legend))
    figure = Figure(figsize=(width * MM, height * MM))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((LEFT / width, BOTTOM / height, drawn[0] / width, drawn[1] / height))
    box = (sheet.low[0], sheet.high[0], sheet.low[1], sheet.high[1])
    axes.imshow(sheet.image, extent=box, interpolation="none", aspect="auto")
    if sheet.lines is not None and len(sheet.lines):
        axes.add_collection(LineCollection(list(sheet.lines), colors=sheet.line_colors, linewidths=1.2))
    for zone in sheet.zones:
        _hatched(axes, zone, sheet)
    for mark in sheet.marks:
        edge = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": "black", "linewidth": 0.4}
        axes.text(mark.x, mark.y, mark.text, fontsize=5.5, ha="center", va="center", bbox=edge)
    axes.set(xlim=box[:2], ylim=box[2:])
    step = nice_step(float(extent.max()), min(10.0, float(drawn.max()) / GRID))
    for axis, low, high in ((axes.xaxis, box[0], box[1]), (axes.yaxis, box[2], box[3])):
        axis.set_ticks(np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step)
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.grid(color="0.35", linewidth=0.25, alpha=0.6)
    axes.tick_params(labelsize=6, length=2, width=0.4)
    unit = "m" if sheet.metric else "units"
    axes.set_xlabel(f"{sheet.axes[0]} ({unit})", fontsize=6, labelpad=1)
    axes.set_ylabel(f"{sheet.axes[1]} ({unit})", fontsize=6, labelpad=1)
    for spine in axes.spines.values():
        spine.set_linewidth(0.4)
    stated = ratio(sheet.scale) if sheet.metric else "not to scale: the scale of the capture is not known"
    fitted(figure, (LEFT / width, 1 - 9 / height), sheet.title, 10, weight="bold")
    stated = f"{stated} · grid {significant(step)} {unit}" + (f" · {sheet.note}" if sheet.note else "")
    fitted(figure, (LEFT / width, 3 / height), stated, 8)
    _scale_bar(figure, sheet, float(width), float(height))
    _legend(figure, sheet, float(width), float(height))
    return figure


def _hatched(axes: Axes, zone: Zone, sheet: Sheet) -> None:
    """A zone as outlines and hatching, which stay lines in SVG and PDF."""
    from matplotlib import rc_context

    height, width = zone.mask.shape
    step = (sheet.high - sheet.low) / [width, height]
    # With a border around it, so that what reaches the side is closed too.
    x = sheet.low[0] + (np.arange(width + 2) - 0.5) * step[0]
    y = sheet.high[1] - (np.arange(height + 2) - 0.5) * step[1]
    inside = np.pad(zone.mask, 1).astype(float)
    with rc_context({"hatch.linewidth": 0.5}):
        filled = axes.contourf(x, y, inside, levels=[0.5, 1.5], colors="none", hatches=[zone.hatch])
    filled.set_edgecolor(zone.color)
    filled.set_linewidth(0)
    axes.contour(x, y, inside, levels=[0.5], colors=[zone.color], linewidths=0.8)


def _scale_bar(figure: Figure, sheet: Sheet, width: float, height: float) -> None:
    """Four alternating fields below the drawing, of a round length."""
    from matplotlib.patches import Rectangle

    length = nice_step(50.0 * sheet.scale / 1000, 1) / 4
    if 4 * length * 1000 / sheet.scale > 60:
        length /= 2
    mm = length * 1000 / sheet.scale
    for k in range(4):
        shade = "black" if k % 2 == 0 else "white"
        place = ((LEFT + k * mm) / width, 11 / height)
        figure.patches.append(
            Rectangle(
                place, mm / width, 1.6 / height, facecolor=shade, edgecolor="black", linewidth=0.4,
                transform=figure.transFigure, figure=figure,
            )
        )  # fmt: skip
    for k in (0, 2, 4):
        text = f"{significant(k * length)}" + ((" m" if sheet.metric else " units") if k == 4 else "")
        figure.text((LEFT + k * mm) / width, 8 / height, text, fontsize=6, ha="center")


def _tall(entry: Entry) -> float:
    """Height of an entry of the legend in mm."""
    return ROW + LINE * (len(wrapped(entry.text, LEGEND)) - 1)


def _legend(figure: Figure, sheet: Sheet, width: float, height: float) -> None:
    from matplotlib.patches import Rectangle

    left = (width - RIGHT + 4) / width
    y = height - TOP - 3
    if sheet.heading:
        figure.text(left, y / height, sheet.heading, fontsize=7, weight="bold")
    y -= ROW
    for entry in sheet.legend:
        figure.patches.append(
            Rectangle(
                (left, y / height), 4 / width, 3 / height, linewidth=0.3, hatch=2 * entry.hatch,
                facecolor="white" if entry.hatch else entry.color, edgecolor=entry.color if entry.hatch else "black",
                transform=figure.transFigure, figure=figure,
            )
        )  # fmt: skip
        for number, line in enumerate(wrapped(entry.text, LEGEND)):
            figure.text(left + 5.5 / width, (y + 0.4 - number * LINE) / height, line, fontsize=6.5)
        y -= _tall(entry)
