"""The HTML report of a reconstruction: numbers, timings and pictures in one file."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import jinja2
import matplotlib

from ..files import write_text
from ..project.store import load_project
from ..render.run import run_folder

TEMPLATE = Path(__file__).parent / "report.html.j2"


def embedded(data: bytes, kind: str = "png") -> str:
    """A data: URL, so that the report is one file that can be sent around."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def training_curve(events: Path) -> str | None:
    """Training PSNR over time as an embedded SVG picture; None without events."""
    if not events.is_file():
        return None
    rows = [json.loads(line) for line in events.read_text(encoding="utf-8").splitlines() if line.endswith("}")]
    if len(rows) < 2:
        return None
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 2.4), layout="constrained")
    axes = figure.subplots()
    axes.plot([r["seconds"] for r in rows], [r["psnr"] for r in rows], color="#2a6f97", linewidth=1.2)
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("training PSNR (dB)")
    axes.grid(alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg")
    return embedded(buffer.getvalue(), "svg+xml")


def write_report(path: Path, project_folder: Path, run: str, renders: Path, result: dict[str, Any]) -> None:
    """Write the report of a `reconstruct` result with the pictures of the folder `renders`.

    Raises:
        DiskError: `path` cannot be written.
    """
    project = load_project(project_folder)
    evaluation = result.get("evaluate") or {}
    pictures = [
        {"name": Path(name).stem, "data": embedded((project_folder / name).read_bytes())}
        for name in evaluation.get("pictures", [])
        if (project_folder / name).is_file()
    ]
    scores = {s["name"]: s for s in evaluation.get("per_image", [])}
    html = (
        jinja2.Environment(autoescape=True)
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            name=project_folder.resolve().name,
            result=result,
            evaluation=evaluation,
            pictures=pictures,
            scores=scores,
            renders=[{"name": r.stem, "data": embedded(r.read_bytes())} for r in sorted(renders.glob("*.png"))],
            curve=training_curve(run_folder(project_folder, run) / "events.jsonl"),
            classes=project.classes,
            rejected=[i for i in project.images if i.status != "ok"],
            labelled=bool(evaluation.get("per_class_iou")),
            total=round(sum(result["stages"].values()), 1),
        )
    )
    write_text(path, html)
