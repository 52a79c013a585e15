"""Pictures of a record: quality over time and parameters, noise, ablation, and crops side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...files import atomic_path
from .summary import distinct, finished, over_seeds, title_of

COLOURS = ("#7a8b99", "#b08d57", "#3a7d44", "#8a5a9e", "#4c78a8", "#c8553d")


def write_plots(record: dict[str, Any], pictures: Path, folder: Path) -> list[Path]:
    """Write the plots that the record has figures for into a folder; returns their files.

    `pictures`: where the trials' renders are.
    """
    import matplotlib  # only where a record is drawn

    matplotlib.use("Agg")
    made = []
    for name, draw in (("time", _time), ("parameters", _parameters), ("noise", _noise), ("ablation", _ablation)):
        figure = draw(record)
        if figure is not None:
            made.append(_saved(figure, folder / f"{record['profile']}-{name}.png"))
    crops = _crops(record, pictures)
    if crops is not None:
        made.append(_saved(crops, folder / f"{record['profile']}-crops.png"))
    return made


def _saved(figure: Any, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
    return path


def _axes(count: int, width: float = 4.2, height: float = 3.2) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * count, height), layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    for each in axes:
        each.grid(alpha=0.3)
    return figure, list(axes)


def _colour(variants: list[str], variant: str) -> str:
    return COLOURS[variants.index(variant) % len(COLOURS)] if variant != "ours" else "#d1495b"


def _methods(rows: list[dict[str, Any]]) -> set[tuple[str, str]]:
    """Scene and variant of all rows."""
    return {(row["trial"]["scene"], row["trial"]["variant"]) for row in rows}


def _time(record: dict[str, Any]) -> Any:
    """PSNR of the rays being trained on, over the budget's seconds; a line a seed.

    None where a method has no curve on a scene, which records of before did not keep: a plot that has it stays.
    """
    rows = [row for row in finished(record, "time") if row.get("curve")]
    if not rows or _methods(rows) != _methods(finished(record, "time")):
        return None
    scenes, variants = distinct(rows, "scene"), distinct(rows, "variant")
    figure, axes = _axes(len(scenes))
    for axis, scene in zip(axes, scenes):
        named = set[str]()
        for row in rows:
            trial = row["trial"]
            if trial["scene"] != scene:
                continue
            label = None if trial["variant"] in named else title_of(trial["variant"])
            named.add(trial["variant"])
            curve = np.array(row["curve"])
            axis.plot(curve[:, 0], curve[:, 2], color=_colour(variants, trial["variant"]), linewidth=1.2, label=label)
        clock = "processor" if rows[0]["trial"]["clock"] == "processor" else "clock"
        axis.set(title=scene, xlabel=f"seconds of training ({clock})", ylabel="PSNR of training rays (dB)")
        axis.legend(fontsize=7)
    return figure


def _parameters(record: dict[str, Any]) -> Any:
    """PSNR of held-out photos over the number of parameters."""
    rows = finished(record, "time")
    if not rows:
        return None
    scenes, variants = distinct(rows, "scene"), distinct(rows, "variant")
    figure, axes = _axes(len(scenes))
    for axis, scene in zip(axes, scenes):
        for variant in variants:
            quality = over_seeds(rows, "psnr", scene=scene, variant=variant)
            size = over_seeds(rows, "params_m", scene=scene, variant=variant)
            if quality is None or size is None:
                continue
            colour = _colour(variants, variant)
            axis.errorbar(
                size.value, quality.value, quality.half, fmt="o", capsize=3, color=colour, label=title_of(variant)
            )
        axis.set(title=scene, xlabel="parameters (millions)", ylabel="PSNR, held out (dB)", xscale="log")
        axis.legend(fontsize=7)
    return figure


def _noise(record: dict[str, Any]) -> Any:
    """PSNR over the noise of the training photos, with the range over the seeds."""
    rows = finished(record, "noise")
    if not rows:
        return None
    scenes, variants = distinct(rows, "scene"), distinct(rows, "variant")
    figure, axes = _axes(len(scenes))
    for axis, scene in zip(axes, scenes):
        for variant in variants:
            points = [
                (n, over_seeds(rows, "psnr", scene=scene, variant=variant, noise=n)) for n in distinct(rows, "noise")
            ]
            known = [(n, found) for n, found in points if found is not None]
            colour = _colour(variants, variant)
            values, halves = [f.value for _, f in known], [f.half for _, f in known]
            axis.errorbar(
                [n for n, _ in known], values, halves, capsize=3, marker="o", color=colour, label=title_of(variant)
            )
        axis.set(title=scene, xlabel="σ of the noise in the training photos", ylabel="PSNR, held out (dB)")
        axis.legend(fontsize=7)
    return figure


def _ablation(record: dict[str, Any]) -> Any:
    """PSNR of ours with one part changed, as bars with the range over the seeds."""
    rows = finished(record, "ablation")
    if not rows:
        return None
    scenes, variants = distinct(rows, "scene"), distinct(rows, "variant")
    figure, axes = _axes(len(scenes), 5.2, 0.9 + 0.35 * len(variants))
    for axis, scene in zip(axes, scenes):
        known = [(v, over_seeds(rows, "psnr", scene=scene, variant=v)) for v in variants]
        shown = [(v, found) for v, found in known if found is not None][::-1]
        colours = [_colour([], "ours") if v == "ours" else COLOURS[0] for v, _ in shown]
        values, halves = [f.value for _, f in shown], [f.half for _, f in shown]
        axis.barh([title_of(v) for v, _ in shown], values, xerr=halves, color=colours, capsize=3)
        axis.tick_params(axis="y", labelsize=7)
        low = min(value - half for value, half in zip(values, halves))
        axis.set(title=scene, xlabel="PSNR, held out (dB)", xlim=(max(0.0, low - 2), None))
    return figure


def _crops(record: dict[str, Any], pictures: Path) -> Any:
    """One held-out photo of each scene beside the renders of all methods, of the first seed.

    None where a render is not there, as of trials that ran elsewhere: a plot that has it stays.
    """
    rows = finished(record, "time")
    first = min(distinct(rows, "seed"), default=0)
    shown = [row for row in rows if row["trial"]["seed"] == first]
    if not shown or not all((pictures / name).is_file() for row in shown for name in row["pictures"]):
        return None
    from matplotlib.figure import Figure

    scenes, variants = distinct(rows, "scene"), distinct(rows, "variant")
    figure = Figure(figsize=(1.7 * (len(variants) + 1), 1.9 * len(scenes)), layout="constrained")
    axes = figure.subplots(len(scenes), len(variants) + 1, squeeze=False)
    for line, scene in zip(axes, scenes):
        own = {row["trial"]["variant"]: row for row in shown if row["trial"]["scene"] == scene}
        photo = next((row["pictures"][1] for row in own.values() if row["pictures"]), None)
        cells = [("photo", photo)] + [(title_of(v), own[v]["pictures"][0] if v in own else None) for v in variants]
        for axis, (title, name) in zip(line, cells):
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(title, fontsize=7)
            if name is not None and (pictures / name).is_file():
                with Image.open(pictures / name) as image:
                    axis.imshow(np.asarray(image.convert("RGB")), interpolation="nearest")
            else:
                axis.text(0.5, 0.5, "no labels", ha="center", va="center", fontsize=7, transform=axis.transAxes)
        line[0].set_ylabel(scene, fontsize=8)
    return figure
