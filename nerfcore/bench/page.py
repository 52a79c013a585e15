"""The page of figures, written wholly from result sets: `python -m fieldwork.nerfcore.bench.page docs/benchmarks.md`.

The sets of a page lie in the folder `figures` beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..files import write_text
from . import gpu, tables
from .results import ResultSet, read_sets

MARK = "This page is made by `make benchmarks-page` from the files in `figures/`; it is not edited by hand."
HEAD = f"""# Benchmarks

{MARK}
Each table stands under the command that measured it, with machine and commit. PSNR, SSIM and mIoU are of held-out
photos ([what exactly](cli.md)), the suites are described in [the command line](cli.md#benchmarks), what was tried and
rejected stands in [experiments](experiments.md). Other methods beside ours: [evidence](evidence.md).
"""
# Suite: heading, and what its tables show.
SUITES = {
    "figures": ("Quality", "The standard preset on each scene."),
    "speed": ("Speed", "Quality after a given time, and the time of a frame with sampling and networks apart."),
    "ablation": ("Ablation", "The same field with one part changed; pictures take the same samples on every ray."),
    "robustness": ("Robustness", "Training on damaged photos or labels, measured on the undamaged held-out photos."),
    "gpu": ("GPU", "What is asked of a GPU."),
    "surface": (
        "Surfaces",
        "The textured mesh of 200 000 faces beside the true surface of simulated scenes. A pixel is the median footprint "
        "of a photo's pixel on the surface, the size the longest side of what three cameras see.",
    ),
    "labels": (
        "Labels from strokes",
        "A simulated annotator draws one stroke for each class on two photos and then corrects the largest mistakes; the "
        "field saw no label map. mIoU is of the pixels of held-out photos, those without a class counting as wrong; “all "
        "label maps” is the most that the same surfels can show. Worst: of the seeds, or the 95th percentile of times, "
        "beside whose median “mean” shows. “+ parts”: strokes take whole parts; each of the four rows of the method stands "
        "on those before it. “Where just these are left out”: what even one who knows the wrong strokes loses. "
        "“Every pixel”: the same method where the annotator draws all that there is on these photos. “Best threshold”: the "
        "probability of void from which surfels are void, chosen by one who knows the held-out photos, at a loss of 0.01 mIoU "
        "at most where all classes are marked. “Best order”: the best of 16 photos each time, by one who knows the held-out ones; first seed. Strokes of a user "
        "do not take whole parts: “two photos” and all other rows have the graph and image features, without that.",
    ),
    "live": (
        "Baked fields",
        "What the baked field of a run costs, what it loses on the held-out photos, and how fast `render --baked` makes pictures "
        "with classes; beside it the field itself.",
    ),
    "measures": (
        "Measures",
        "Things of known size on a table, about 25 pixels across in 24 small photos whose poses, exposure, label maps and "
        "scale are each off by a little; photos, field, mesh and measures are as a user's. No two captures are alike.",
    ),
}
# No suites of `bench`: figures that other verbs reported.
OTHERS = {
    "demo": ("Whole captures", "From photos to the field with cameras estimated by `fieldwork poses`."),
    "poses": ("Poses", "Estimated cameras against those of the data set."),
}


def figures_folder(page: Path) -> Path:
    return page.parent / "figures"


def page_text(sets: Sequence[ResultSet]) -> str:
    """The whole page. Suites that nothing was measured of say so."""
    parts = [HEAD]
    found = {s.suite for s in sets}
    others = {suite: OTHERS.get(suite, (suite.capitalize(), "")) for suite in [*OTHERS, *sorted(found - OTHERS.keys())]}
    for suite, (heading, meaning) in (SUITES | {s: o for s, o in others.items() if s in found - SUITES.keys()}).items():
        own = [s for s in sets if s.suite == suite]
        parts.append("\n".join([f"## {heading}", "", *([meaning, ""] if meaning else [])]))
        parts += [_gpu_text(own)] if suite == "gpu" else [_set_text(s) for s in reversed(own)]
        if not own and suite != "gpu":
            parts.append(f"`fieldwork bench --suite {suite}`: not measured.\n")
    return "\n".join(parts)


def _set_text(result: ResultSet) -> str:
    lines = [f"### {result.title}", "", "```", result.command, "```", "", result.origin(), ""]
    lines += [_table(result), ""]
    lines += [*(f"- {note}" for note in result.notes), ""] if result.notes else []
    return "\n".join(lines)


def _table(result: ResultSet) -> str:
    """The set's table; columns in which nothing was measured at all are left out, unless the set names its columns."""
    rows = result.rows
    if result.columns is not None:
        return tables.table(result.columns, rows)
    columns = {key: heading for key, heading in tables.COLUMNS.items() if any(r.get(key) is not None for r in rows)}
    if {row["variant"] for row in rows} == {"standard"}:
        del columns["variant"]
    for side in tables.frame_sides(rows):
        columns |= {f"{key}_{side}": f"{heading}, {side}×{side}" for key, heading in tables.SPEED.items()}
    text = tables.table(columns, rows)
    if any("render_ratio" in row for row in rows):
        shares = {"scene": "scene", "budget": "budget", **tables.SHARES}
        text += "\n\nTimes beside the least that the machine needs for the multiplications and the reads alone "
        text += "(`nerfcore/bench/roofline.py`), a frame of 400×400 and a step in the middle of training:\n\n"
        text += tables.table(shares, rows)
    return text


def _gpu_text(sets: Sequence[ResultSet]) -> str:
    if not sets:
        return gpu.section(None, None, {}, "", {})
    texts = []
    for result in sets:
        asked = result.asked
        checks, figures, waits = (asked.checks, asked.figures, asked.waits) if asked else (None, {}, {})
        texts.append(gpu.section(result.origin(), checks, figures, _table(result), waits))
        texts += [f"- {note}" for note in result.notes] + [""] * bool(result.notes)
    return "\n".join(texts)


def check_page(page: Path) -> None:
    """Raise InputError where `page` is a file that `write_page` did not make."""
    if page.is_file() and MARK not in page.read_text(encoding="utf-8"):
        raise InputError(f"{page} was not made by this command.", "Give the page another name; it is written wholly.")


def write_page(page: Path) -> None:
    """Write the page anew from the sets beside it.

    Raises:
        InputError: `page` is a file that this did not make, or a set cannot be read.
    """
    check_page(page)
    write_text(page, page_text(read_sets(figures_folder(page))))


def main() -> None:
    parser = argparse.ArgumentParser(prog="page", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("page", type=Path, help="Markdown page; its result sets lie in the folder figures beside it")
    write_page(parser.parse_args().page)


if __name__ == "__main__":
    main()
