"""Results of a suite as rows, Markdown and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from ..files import atomic_path
from .jobs import COUNTING_SIDE, Job
from .live import live_table
from .results import Row
from .suites import PUBLISHED_DROPS, REFERENCE
from .surface_table import FIGURES, figure_table

COLUMNS = {
    "scene": "scene",
    "variant": "variant",
    "budget": "budget",
    "seed": "seed",
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "miou": "mIoU",
    "psnr_gain": "Δ PSNR",
    "miou_gain": "Δ mIoU",
    "steps": "steps",
    "seconds": "training (s)",
    "rays_per_second": "rays/s trained",
    "params_m": "parameters (M)",
    "spr": "samples/ray",
    "memory_training_mb": "peak memory, training (MiB)",
    "memory_rendering_mb": "peak memory, rendering (MiB)",
}
DIGITS = {"psnr": ".2f", "ssim": ".3f", "miou": ".3f", "psnr_gain": "+.2f", "miou_gain": "+.3f"}
NAMES = {"psnr": "PSNR (dB)", "miou": "mIoU", "f_size": "F at 1 %", "f_pixel": "F at two pixels"}
# Of the suite `speed`, see `bench/speed.py`: rates of the machine, and times beside the least that it needs.
SHARES = {
    "precision": "precision",
    "gflops": "matrix products (GFLOP/s)",
    "reads": "random reads (M/s)",
    "copy": "copy (GB/s)",
    "render_least": "frame, at least (s)",
    "render_taken": "frame, taken (s)",
    "render_ratio": "times the least",
    "step_least": "step, at least (ms)",
    "step_taken": "step, taken (ms)",
    "step_ratio": "times the least",
    "step_faults": "page faults a step",
    "step_system": "system time (%)",
}
OWN = {"surface": figure_table, "live": live_table}  # suites with tables of their own
SPEED = {"fps": "frames/s", "ms_frame": "ms a frame", "ms_sampling": "ms sampling", "ms_network": "ms network"}


def text(value: Any, digits: str = ",.4g") -> str:
    """A figure as it stands in a table; what was not measured says so."""
    if value is None:
        return "not measured"
    return format(value, digits) if isinstance(value, float) else str(value)


def table(columns: dict[str, str], rows: Sequence[Row]) -> str:
    """A Markdown table of the columns {key: heading} of rows."""
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + " --- |" * len(columns)]
    lines += [
        "| " + " | ".join(text(row.get(key, "–"), DIGITS.get(key, ",.4g")) for key in columns) + " |" for row in rows
    ]
    return "\n".join(lines)


def make_rows(suite: str, results: Sequence[dict[str, Any]]) -> list[Row]:
    """One row a run, with its difference from the suite's reference at the same scene and budget."""
    rows = []
    for result in results:
        job = result["job"]
        row: Row = {
            "scene": job["scene"],
            "variant": job["variant"],
            "budget": Job(**job).budget,
            "seed": job.get("seed"),
        }
        row |= {key: result.get(key) for key in COLUMNS if key not in row}
        for speed in result.get("speed", []):
            side = speed["fps_size"][0]
            row["spr"], row["fused"] = speed["spr"], speed["fused"]
            values = {**speed, "ms_frame": round(1e3 / speed["fps"], 2)}
            row |= {f"{key}_{side}": values[key] for key in SPEED}
        row |= {key: result["roofline"][key] for key in SHARES if "roofline" in result}
        row |= {key: result[key] for key in (*FIGURES, "stages") if suite == "surface" and key in result}
        if suite == "live":
            row |= result.get("live", {})
            row["field_400"] = row.pop("fps_400", None)
        row["error"] = result.get("error")
        rows.append(row)
    reference = {_case(r): r for r in rows if r["variant"] == REFERENCE.get(suite)}
    for row in rows:
        base = reference.get(_case(row))
        if base is None or base is row:
            continue
        for key, gain in (("psnr", "psnr_gain"), ("miou", "miou_gain")):
            if row[key] is not None and base[key] is not None:
                row[gain] = round(row[key] - base[key], 4)
    return rows


def verdicts(suite: str, rows: Sequence[Row]) -> list[str]:
    """What the figures say about the claims they were taken for; nothing where a figure is missing."""
    if suite == "ablation":
        return _ablation_verdicts(rows)
    if suite == "robustness":
        return _drop_verdicts(rows)
    return _seed_verdicts(rows) if suite == "figures" else []


def frame_sides(rows: Sequence[Row]) -> list[int]:
    """Sides of the frames that were timed, less that which only counts samples."""
    sides = {int(key.rsplit("_", 1)[1]) for row in rows for key in row if key.startswith("fps_")}
    return sorted(sides - {COUNTING_SIDE})


def _case(row: Row) -> str:
    """What a row has in common with the variants it is compared with."""
    return f"{row['scene']}, {row['budget']}" + ("" if row.get("seed") is None else f", seed {row['seed']}")


def _by(rows: Sequence[Row]) -> dict[str, dict[str, Row]]:
    """Rows by what they have in common and variant."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        found.setdefault(_case(row), {})[row["variant"]] = row
    return found


def _seed_verdicts(rows: Sequence[Row]) -> list[str]:
    """Mean and spread of equal runs with several seeds."""
    lines, groups = [], {}
    for row in rows:
        groups.setdefault((row["scene"], row["variant"], row["budget"]), []).append(row)
    for (scene, _, limit), group in groups.items():
        known = {key: [r[key] for r in group if r.get(key) is not None] for key in ("psnr", "miou")}
        if len(known["psnr"]) < 2:
            continue
        half = {key: (max(values) - min(values)) / 2 for key, values in known.items() if values}
        parts = [f"PSNR {mean(known['psnr']):.2f} ± {half['psnr']:.2f} dB"]
        if len(known["miou"]) > 1:
            parts.append(f"mIoU {mean(known['miou']):.3f} ± {half['miou']:.3f}")
        lines.append(f"{scene}, {limit}, {len(known['psnr'])} seeds: {', '.join(parts)} (mean ± half of the range).")
    return lines


def _better(a: Row, b: Row, keys: Sequence[str]) -> bool | None:
    """Whether a beats b in every key; None when a figure is missing."""
    pairs = [(a[key], b[key]) for key in keys]
    if any(x is None or y is None for x, y in pairs):
        return None
    return all(x > y for x, y in pairs)


def _ablation_verdicts(rows: Sequence[Row]) -> list[str]:
    lines = []
    for case, found in _by(rows).items():
        if {"hybrid", "explicit", "implicit"} <= found.keys():
            wins = [_better(found["hybrid"], found[v], ("psnr", "miou")) for v in ("explicit", "implicit")]
            if None not in wins:
                how = "beats" if all(wins) else "does not beat"
                lines.append(f"{case}: hybrid {how} both of its boundary cases in PSNR and mIoU.")
        for variant in ("hybrid", "semantic pdf"):
            if {variant, "uniform pdf"} <= found.keys():
                won = _better(found[variant], found["uniform pdf"], ("psnr",))
                if won is not None:
                    how = "beats" if won else "does not beat"
                    lines.append(f"{case}: {variant} {how} uniform samples in PSNR.")
    return lines


def _drop_verdicts(rows: Sequence[Row]) -> list[str]:
    lines = []
    for row in rows:
        limits = PUBLISHED_DROPS.get(row["variant"])
        if limits is None or row.get("psnr_gain") is None:
            continue
        kept = "within" if -row["psnr_gain"] <= limits[0] else "more than"
        lines.append(
            f"{row['scene']}, {row['variant']}: PSNR drops {-row['psnr_gain']:.2f} dB, {kept} the published {limits[0]}."
        )
        if row.get("miou_gain") is not None:
            drop = -100 * row["miou_gain"]
            kept = "within" if drop <= limits[1] else "more than"
            lines.append(
                f"{row['scene']}, {row['variant']}: mIoU drops {drop:.1f} points, {kept} the published {limits[1]}."
            )
    return lines


def markdown(suite: str, rows: Sequence[Row], machine: str, command: str, notes: Sequence[str]) -> str:
    """The page of a suite: machine, command, tables, verdicts."""
    present = [key for key in COLUMNS if any(row.get(key) is not None for row in rows) or key in ("psnr", "miou")]
    parts = [f"# Suite {suite}", "", f"Machine: {machine}. Command: `{command}`", ""]
    parts += [table({key: COLUMNS[key] for key in present}, rows), ""]
    if suite in OWN:
        parts += [table(*OWN[suite](rows)), ""]
    for side in frame_sides(rows):
        columns = {"scene": "scene", "variant": "variant", "budget": "budget"}
        columns |= {f"{key}_{side}": heading for key, heading in SPEED.items()}
        classes = "colour and, where the scene has labels, classes"
        parts += [f"## Frames of {side}×{side}, {classes}", "", table(columns, rows), ""]
    if any("render_ratio" in row for row in rows):
        columns = {"scene": "scene", "budget": "budget", **SHARES}
        parts += ["## Beside the machine", "", table(columns, rows), ""]
    failed = [f"- {r['scene']} {r['variant']}, {r['budget']}: {r['error']}" for r in rows if r.get("error")]
    if failed:
        parts += ["## Failed runs", "", *failed, ""]
    lines = [f"- {line}" for line in [*verdicts(suite, rows), *notes]]
    if lines:
        parts += ["## Notes", "", *lines, ""]
    return "\n".join(parts)


def plot(path: Path, suite: str, rows: Sequence[Row], results: Sequence[dict[str, Any]]) -> None:
    """A picture of the suite: training curves for speed and gpu, bars of two figures for the rest."""
    import matplotlib  # only where a suite has a plot

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    if suite in ("speed", "gpu"):
        shown = [result for result in results if "roofline" in result]
        figure = Figure(figsize=(12 if shown else 7, 4), layout="constrained")
        axes, *more = figure.subplots(1, 2 if shown else 1, squeeze=False)[0]
        if more:
            _shares(more[0], shown)
        for result in results:
            curve = result.get("curve") or []
            job = result["job"]
            axes.plot([s for s, _ in curve], [p for _, p in curve], label=f"{job['scene']}, {Job(**job).budget}")
        axes.set_xlabel("seconds of training")
        axes.set_ylabel("training PSNR (dB)")
        axes.grid(alpha=0.3)
        axes.legend()
    else:
        groups = _by(rows)
        most = max(len(found) for found in groups.values())
        figure = Figure(figsize=(9, 0.6 + len(groups) * (0.9 + 0.28 * most)), layout="constrained")
        for (left, right), (case, found) in zip(
            figure.subplots(len(groups), 2, squeeze=False, sharey="row"), groups.items()
        ):
            keys = ("f_size", "f_pixel") if suite == "surface" else ("psnr", "miou")
            for axes, key in zip((left, right), keys):
                _bars(axes, found, key, f"{case}: {NAMES[key]}")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _shares(axes: Any, results: Sequence[dict[str, Any]]) -> None:
    """Bars of how many times the least a frame and a training step take."""
    names = [f"{r['job']['scene']}, {Job(**r['job']).budget}" for r in results]
    places = range(len(names))
    for shift, key, color, label in (
        (-0.2, "render_ratio", "#2a6f97", "frame"),
        (0.2, "step_ratio", "#89a9bd", "training step"),
    ):
        values = [r["roofline"][key] for r in results]
        axes.barh([place + shift for place in places], values, 0.38, color=color, label=label)
    axes.axvline(1, color="black", linewidth=1)
    axes.set_yticks(list(places), names)
    axes.set_xlabel("time taken, in multiples of the least the machine needs")
    axes.legend()


def _bars(axes: Any, found: dict[str, Row], key: str, title: str) -> None:
    """Horizontal bars, the first variant on top; missing figures leave a gap that says so."""
    names = list(found)[::-1]
    values = [found[name].get(key) for name in names]
    known = [v for v in values if v is not None]
    axes.barh(
        names, [v or 0.0 for v in values], color=["#2a6f97" if n == next(iter(found)) else "#89a9bd" for n in names]
    )
    low = min(known, default=0.0)
    # Differences matter more than the distance from zero.
    begin = max(0.0, low - 0.5 * (max(known, default=1.0) - low) - 0.02 * low)
    end = max(known, default=1.0)
    axes.set_xlim(begin, end + 0.18 * max(end - begin, 1e-3))
    for place, value in enumerate(values):
        label = " not measured" if value is None else f" {value:.4g}"
        axes.text(begin if value is None else value, place, label, va="center", fontsize=8)
    axes.set_title(title, fontsize=10, loc="left")
