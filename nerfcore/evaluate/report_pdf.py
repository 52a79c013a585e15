"""A report as PDF: the tables and pictures of the HTML report on A4 pages."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imread

from ..files import atomic_path
from ..measure.lettering import fitted, lettering, width_of, wrapped
from .documentation import Section

WIDTH, HEIGHT = 210.0, 297.0  # mm
MARGIN = 15.0
SIZE, LINE = 6.0, 3.1  # points of the text of tables, mm from line to line
GLYPH = 0.61  # of the size: mean width of a character
WIDEST = 40  # characters of a column before its text is broken; the last column gets what is left
POINT = 25.4 / 72  # mm


class _Pages:
    """Pages that are filled from top to bottom."""

    def __init__(self, file: PdfPages) -> None:
        self.file, self.number = file, 0
        self.figure, self.y = Figure(), 0.0
        self._begin()

    def _begin(self) -> None:
        self.figure = Figure(figsize=(WIDTH / 25.4, HEIGHT / 25.4))
        FigureCanvasAgg(self.figure)
        self.number, self.y = self.number + 1, HEIGHT - MARGIN

    def end(self) -> None:
        self.figure.text(0.5, 8 / HEIGHT, str(self.number), fontsize=SIZE, ha="center")
        self.file.savefig(self.figure)

    def need(self, height: float) -> None:
        """Go to a new page where less than so many mm are left."""
        if self.y - height < MARGIN:
            self.end()
            self._begin()

    def heading(self, text: str, size: float, weight: str = "normal") -> None:
        """A line across the page, in smaller letters where it is longer."""
        place = MARGIN / WIDTH, self.y / HEIGHT
        fitted(self.figure, place, text, size, 1 - MARGIN / WIDTH, weight=weight, va="top")

    def text(self, x: float, text: str, size: float = SIZE, weight: str = "normal") -> None:
        self.figure.text(x / WIDTH, self.y / HEIGHT, text, fontsize=size, fontweight=weight, va="top")


def write_pdf(path: Path, title: str, sections: Sequence[Section], pictures: Sequence[tuple[str, Path]]) -> None:
    """Write tables, then pictures (caption, PNG file), each as wide as the page.

    Raises:
        DiskError: `path` cannot be written.
    """
    with (
        lettering(),
        atomic_path(path) as temporary,
        PdfPages(temporary, metadata={"Title": title, "Creator": "Fieldwork"}) as file,
    ):
        pages = _Pages(file)
        pages.heading(title, 16, weight="bold")
        pages.y -= 9
        pages.text(MARGIN, f"Written {datetime.now(UTC):%Y-%m-%d %H:%M} UTC", 8)
        pages.y -= 8
        for section in sections:
            _table(pages, section)
        for caption, picture in pictures:
            _picture(pages, caption, picture)
        pages.end()


def _table(pages: _Pages, section: Section) -> None:
    pages.need(8 * LINE)
    pages.text(MARGIN, section.title, 11, weight="bold")
    pages.y -= 6
    for line in textwrap.wrap(section.text, 130):
        pages.text(MARGIN, line, SIZE + 1)
        pages.y -= LINE + 0.5
    lines = [section.columns, *section.rows] if section.columns else section.rows
    places, characters = _places(lines)
    for number, row in enumerate(lines):
        broken = [wrapped(cell, wide) for cell, wide in zip(row, characters)]
        pages.need(LINE * max(map(len, broken)))
        for line in range(max(map(len, broken))):
            for x, cell in zip(places, broken):
                if line < len(cell):
                    heading = section.columns and number == 0
                    pages.text(x, cell[line], weight="bold" if heading else "normal")
            pages.y -= LINE
            pages.need(0)
    pages.y -= 5


def _places(lines: Sequence[Sequence[str]]) -> tuple[list[float], list[int]]:
    """Where the columns of a table begin in mm, and how many characters have room in each."""
    glyph = SIZE * GLYPH * POINT
    wide = [min(WIDEST, max(width_of(row[k]) for row in lines)) for k in range(len(lines[0]))]
    places = [MARGIN]
    for characters in wide[:-1]:
        places.append(places[-1] + (characters + 2) * glyph)
    wide[-1] = max(10, int((WIDTH - MARGIN - places[-1]) / glyph))
    return places, wide


def _picture(pages: _Pages, caption: str, path: Path) -> None:
    pixels = imread(path)
    wide = WIDTH - 2 * MARGIN
    tall = min(wide * pixels.shape[0] / pixels.shape[1], HEIGHT - 2 * MARGIN - 8)
    wide = tall * pixels.shape[1] / pixels.shape[0]
    pages.need(tall + 8)
    pages.heading(caption, 8)
    pages.y -= 4 + tall
    axes = pages.figure.add_axes((MARGIN / WIDTH, pages.y / HEIGHT, wide / WIDTH, tall / HEIGHT))
    axes.imshow(pixels, interpolation="none", aspect="auto")
    axes.set_axis_off()
    pages.y -= 5
