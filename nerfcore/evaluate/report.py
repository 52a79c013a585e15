"""The report of a reconstruction, HTML or PDF: numbers, timings, tables and pictures in one file."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

from ..errors import SettingError
from ..files import write_text
from ..measure.lettering import warn_of_missing
from ..measure.stored import read_measures
from ..measure.wording import significant
from ..params import ReportParams
from ..progress import Reporter
from ..project.runs import known_runs, no_such_run, read_events, read_metrics, run_folder
from ..project.store import load_project
from ..render.pictures import ENDINGS
from .documentation import JUDGEMENT, Section, compared, results_of, sections, titled
from .reported_mesh import current_drawings, mesh_stands

FORMATS = (".html", ".pdf")
HEAD = ("Result", "Time")  # tables that stand beside each other at the top
TEMPLATE = Path(__file__).parent / "report.html.j2"


def embedded(data: bytes, kind: str = "png") -> str:
    """A data: URL, so that the report is one file that can be sent around."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def training_curve(run: Path) -> str | None:
    """Training PSNR over time as an embedded SVG picture; None without events."""
    rows = read_events(run)
    if len(rows) < 2:
        return None
    import matplotlib  # only where a report is made: it takes long

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


def check_report(path: Path) -> None:
    """Raise SettingError unless the ending of a report is .html or .pdf."""
    if path.suffix.lower() not in FORMATS:
        raise SettingError(f"{path}: reports are written as {' or '.join(FORMATS)}.", "Choose one of these endings.")


def report(params: ReportParams, reporter: Reporter) -> dict[str, Any]:
    """Write the report of a run from what its verbs have left in the project.

    Returns:
        {"file", "sections": titles of its tables}
    Raises:
        SettingError: neither .html nor .pdf. ProjectError: there are no poses, or there is no such run. DiskError.
    """
    folder = Path(params.project)
    project, known = load_project(folder), known_runs(folder)
    if params.run not in (*known, ReportParams.model_fields["run"].default):  # without any, the photos are reported
        raise no_such_run(folder, params.run)
    out = params.out or folder / "exports" / params.run / "report.html"
    check_report(out)
    results = results_of(project, params.run)
    results["evaluate"] = read_metrics(run_folder(folder, params.run)).get("test")
    reporter.stage("Writing the report")
    titles = write_report(out, folder, params.run, folder / "exports" / params.run / "renders", results, reporter)
    return {"file": str(out), "sections": titles}


def write_report(
    path: Path, folder: Path, run: str, renders: Path, result: dict[str, Any], reporter: Reporter
) -> list[str]:
    """Write the report of the verbs' results with the pictures of the folder `renders`, and return the titles of its
    tables. `result` may have "stages", the seconds of each verb. What is of a mesh that no longer holds is left out, with
    a warning.

    Raises:
        SettingError: neither .html nor .pdf. ProjectError: there are no poses. DiskError: `path` cannot be written.
    """
    check_report(path)
    project = load_project(folder)
    measures: dict[str, Any] = {}
    drawn: list[Path] = []
    if mesh_stands(folder, run, result, reporter):
        measures = read_measures(folder, run) or {}
        drawn = current_drawings(folder, project, run, reporter)
    else:
        result = {verb: value for verb, value in result.items() if verb != "mesh"}
    tables = sections(folder, run, result, measures)
    stages = result.get("stages") or {}
    if stages:
        seconds = [[stage, f"{value} s"] for stage, value in stages.items()]
        place = next((i + 1 for i, table in enumerate(tables) if table.title == "Result"), 0)
        tables.insert(place, Section("Time", [], [*seconds, ["all", f"{sum(stages.values()):.1f} s"]]))
    evaluation = result.get("evaluate") or {}
    judged = zip(evaluation.get("pictures", []), evaluation.get("per_image", []))  # in one order, see `evaluate`
    scores = {folder / name: score for name, score in judged if (folder / name).is_file()}
    pictured = list(scores)
    rendered = sorted(renders.glob("*.png"))
    name = folder.resolve().name
    if path.suffix.lower() == ".pdf":
        photo = titled(f"{compared(evaluation, 'photo')} and render", evaluation)
        captions = (("Drawing", drawn), (photo, pictured), ("Render", rendered))
        pictures = [(f"{what}: {file.stem}", file) for what, files in captions for file in files]
        from .report_pdf import write_pdf  # loads matplotlib

        cells = (cell for table in tables for row in table.rows for cell in row)
        warn_of_missing([name, *cells, *(caption for caption, _ in pictures)], reporter)
        write_pdf(path, name, tables, pictures)
        return [table.title for table in tables]
    import jinja2

    html = (
        jinja2.Environment(autoescape=True)
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            name=name,
            head=[table for table in tables if table.title in HEAD],
            judgement=next((table for table in tables if table.title == JUDGEMENT), None),
            tables=[table for table in tables if table.title not in (*HEAD, JUDGEMENT)],
            areas=(result.get("mesh") or {}).get("classes") or {},
            area_unit="m²" if project.frame.scale_known else "units²",
            significant=significant,
            evaluation=evaluation,
            compared=titled(compared(evaluation, "views"), evaluation),
            pictures=[picture | {"score": score} for picture, score in zip(pictures_of(pictured), scores.values())],
            drawings=pictures_of(drawn),
            renders=[pictures_of(view) for view in by_view(rendered)],
            curve=training_curve(run_folder(folder, run)),
            classes=project.classes,
            labelled=bool(evaluation.get("per_class_iou")),
        )
    )
    write_text(path, html)
    return [table.title for table in tables]


def by_view(files: list[Path]) -> list[list[Path]]:
    """Pictures with those together that are passes of one view: `orbit_0000`, `orbit_0000_depth`."""
    views: dict[str, list[Path]] = {}
    for file in files:
        ending = next((e for e in ENDINGS.values() if e and file.stem.endswith(e)), "")
        views.setdefault(file.stem.removesuffix(ending), []).append(file)
    return list(views.values())


def pictures_of(files: list[Path]) -> list[dict[str, str]]:
    """Names and data: URLs of PNG files."""
    return [{"name": file.stem, "data": embedded(file.read_bytes())} for file in files]
