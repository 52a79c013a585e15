"""Letters of drawings and reports: names as they are, never read as formulas, in fonts that have their characters."""

from __future__ import annotations

import textwrap
import unicodedata
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ..progress import Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Matplotlib's own font, then those of systems that have what it lacks; only installed ones are asked.
FONTS = (
    *("DejaVu Sans", "Noto Sans", "Segoe UI", "Arial Unicode MS"),
    *("Noto Sans CJK SC", "Noto Sans CJK JP", "Noto Sans SC", "Noto Sans JP", "Noto Sans KR"),
    *("Source Han Sans SC", "WenQuanYi Micro Hei", "WenQuanYi Zen Hei", "Droid Sans Fallback"),
    *("Microsoft YaHei", "SimHei", "Yu Gothic", "MS Gothic", "Malgun Gothic"),
    *("PingFang SC", "Hiragino Sans", "Apple SD Gothic Neo", "Heiti TC"),
    *("Noto Sans Devanagari", "Nirmala UI", "Noto Sans Thai", "Leelawadee UI", "Noto Sans Hebrew", "Noto Sans Arabic"),
)


def fonts() -> list[str]:
    """The families that are installed, in the order in which they are asked for a character."""
    from matplotlib.font_manager import fontManager

    installed = set(fontManager.get_font_names())
    return [name for name in FONTS if name in installed]


@contextmanager
def lettering() -> Iterator[None]:
    """Within it matplotlib writes text as it is. `warn_of_missing` says what fonts lack, for all drawings at once."""
    from matplotlib import rc_context

    with rc_context({"text.parse_math": False, "font.family": fonts()}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from")
        yield


def missing(texts: Iterable[str]) -> list[str]:
    """The characters that no installed font has."""
    from matplotlib.font_manager import findfont, get_font

    known: set[int] = set()
    for family in fonts():
        known |= get_font(findfont(family)).get_charmap().keys()
    return sorted({char for text in texts for char in text if char.isprintable() and ord(char) not in known})


def warn_of_missing(texts: Iterable[str], report: Reporter) -> None:
    """Warn of characters that will be drawn as empty boxes."""
    found = missing(texts)
    if found:
        more = " …" if len(found) > 20 else ""
        report.warn(
            f"No font has {' '.join(found[:20])}{more}: drawn as boxes. Install a font that has them (“Noto Sans CJK” has "
            "those of Chinese, Japanese and Korean) and draw again, or give the names in other letters."
        )


def fitted(
    figure: Figure, place: tuple[float, float], text: str, size: float, right: float = 1.0, **style: Any
) -> None:
    """A line of text that begins at a place of a figure (shares of it), in smaller letters where it would go beyond
    `right`."""
    line = figure.text(*place, text, fontsize=size, **style)
    room, wide = (right - place[0]) * figure.bbox.width, line.get_window_extent().width
    line.set_fontsize(size * min(1.0, 0.98 * room / max(wide, 1e-9)))


def width_of(text: str) -> int:
    """How many characters wide a text is: those of Chinese and Japanese count as two."""
    return len(text) + sum(unicodedata.east_asian_width(char) in "WF" for char in text)


def wrapped(text: str, characters: int) -> list[str]:
    """The lines of a text that may be so many characters wide; those of Chinese and Japanese are as wide as two."""
    return textwrap.wrap(text, max(1, characters * len(text) // max(1, width_of(text)))) or [""]
