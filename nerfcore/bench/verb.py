"""The verb `bench`: reproduce a table of figures on this machine.

OUT/SUITE/results.json   every figure      OUT/SUITE/table.md   the table      OUT/SUITE/plot.png
OUT/SUITE/runs/*.json    one file a run: it is not repeated while its settings stay the same
OUT/projects/            the scenes
With a page its result sets, figures/*.json beside it, get those of this command, and the page is written anew.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError
from ..files import write_json, write_text
from ..kernels.device import use_device
from ..params import BenchParams
from ..progress import Reporter, shortened
from . import machine, tables
from .jobs import Measure, run_all, unknown_origin
from .page import check_page, figures_folder, write_page
from .results import Asked, ResultSet, Row, grouped, write_set
from .scenes import available, data_folder, is_labelled, prepare, require_scenes, scene_name
from .suites import PUBLISHED_DROPS, SCENES, SECONDS, chosen_variants, plan


def bench(params: BenchParams, report: Reporter) -> dict[str, Any]:
    """Run a suite, or what is missing of it.

    Returns:
        {"suite", "machine", "runs", "failed", "rows": […], "notes": […], "files": […]}
    Raises:
        InputError: a named scene is not there. SettingError: an unknown variant or setting.
    """
    root = Path(params.out)
    out = root / params.suite
    if params.suite == "evidence":  # what one suite alone needs loads with it
        from .evidence.suite import evidence_suite

        return evidence_suite(params, out, root, command_of(params), report)
    if params.page is not None:
        check_page(params.page)
    if params.suite == "gpu" and use_device().type != "cuda":
        return _without_gpu(params, out, report)
    if params.suite == "measures":
        from .measures import measures_suite

        return measures_suite(params, out, command_of(params), report)
    chosen_variants(params)
    data = data_folder(params.data)
    projects, notes = _scenes(params, data, root, report)
    if params.suite == "labels":
        from .labels import labels_suite

        result = labels_suite(params, projects, out, command_of(params), report)
        return {**result, "notes": [*notes, *result["notes"]]}
    jobs = plan(params, list(projects))
    results = run_all(jobs, projects, out, report, params.keep, _measure_of(params.suite, root))
    rows = tables.make_rows(params.suite, results)
    described = machine.describe()
    if params.yardstick is not None and params.suite == "speed":
        seconds = min((job.seconds for job in jobs if job.seconds), default=SECONDS["speed"])
        notes.append(f"Yardstick {params.yardstick.name}: {machine.run_yardstick(params.yardstick, seconds, report)}")
    asked = None
    if params.suite == "gpu":
        from . import gpu

        synchronisations, waits, recorded = gpu.step_synchronisations(next(iter(projects.values())), report)
        checks, values = gpu.kernel_checks(params.tests), gpu.figures(rows, synchronisations, recorded)
        asked = Asked(figures=values, checks=checks, waits=waits)
    files = _write(params, out, rows, results, described, notes)
    if params.page is not None:
        files += _write_page(params, params.page, rows, results, notes, asked)
        unknown = [str(path) for path in unknown_origin(results, out)]
        if unknown:
            hint = "Remove these files to measure them again"
            report.warn(shortened(f"Runs whose machine and commit are not known are not on the page. {hint}", unknown))
    return {
        "suite": params.suite,
        "machine": described,
        "runs": len(results),
        "failed": sum("error" in result for result in results),
        "rows": rows,
        "notes": [*tables.verdicts(params.suite, rows), *notes],
        "files": [str(path) for path in files],
    }


def _measure_of(suite: str, root: Path) -> Measure | None:
    """What a suite measures of each trained run beside the figures of all."""
    if suite == "surface":
        from .surface import measure

        return partial(measure, root=root)
    if suite == "speed":
        from .speed import measure

        return measure
    if suite == "live":
        from .live import measure

        return measure
    return None


def _scenes(params: BenchParams, data: Path | None, root: Path, report: Reporter) -> tuple[dict[str, Path], list[str]]:
    """Projects of the suite's scenes, and a note for each that is left out. Scenes named by the user must be there."""
    notes, projects = [], {}
    require_scenes(params.scenes or [], data, root)
    for scene in params.scenes or SCENES[params.suite]:
        if not params.scenes and not available(scene, data):
            notes.append(f"{scene} is left out: there is no such data set in {data or '../shared/data'}.")
            continue
        project = prepare(scene, data, root, report)
        if params.suite == "surface":
            from .surface import read_truth

            read_truth(root, scene_name(scene))  # before anything is trained for nothing
        if not params.scenes and params.suite in ("ablation", "robustness", "labels") and not is_labelled(project):
            notes.append(f"{scene} is left out: it has no labels.")
            continue
        projects[scene_name(scene)] = project
    if not projects:
        raise InputError("None of the suite's scenes is there.", "Give a folder of data sets with --data.")
    return projects, notes


def command_of(params: BenchParams) -> str:
    """The command line that measures the same."""
    command = f"fieldwork bench --suite {params.suite}"
    for name in ("profile", "scenes", "variants", "tables", "seconds", "steps", "seeds", "preset"):
        value = getattr(params, name)
        if value != type(params).model_fields[name].default:
            text = (
                ",".join(map(str, value)) if isinstance(value, list) else f"{value:g}" if name == "seconds" else value
            )
            command += f' --{name} "{text}"' if name in ("scenes", "variants", "tables") else f" --{name} {text}"
    return command + "".join(f" --set {name}={value}" for name, value in params.set.items())


def _write(
    params: BenchParams,
    out: Path,
    rows: list[Row],
    results: list[dict[str, Any]],
    described: str,
    notes: list[str],
) -> list[Path]:
    """JSON, Markdown and plot of a suite."""
    files = [out / "results.json", out / "table.md", out / "plot.png"]
    if use_device().type == "cpu":
        notes = [*notes, "Peak memory on a CPU is that of the whole process up to then, all runs before included."]
    if params.suite == "robustness":
        limits = ", ".join(f"{name}: {p} dB, {m} points" for name, (p, m) in PUBLISHED_DROPS.items())
        notes = [*notes, f"Published drops of PSNR and mIoU: {limits}."]
    write_json(files[0], {"suite": params.suite, "machine": described, "notes": notes, "rows": rows, "runs": results})
    write_text(files[1], tables.markdown(params.suite, rows, described, command_of(params), notes))
    tables.plot(files[2], params.suite, rows, results)
    return files


def _write_page(
    params: BenchParams,
    page: Path,
    rows: list[Row],
    results: list[dict[str, Any]],
    notes: list[str],
    asked: Asked | None,
) -> list[Path]:
    """Add the result sets of this command to the page's, one for each machine and commit, and write the page anew."""
    files = []
    for taken, own in grouped(results, rows):
        columns, shown = tables.OWN[params.suite](own) if params.suite in tables.OWN else (None, own)
        result = ResultSet(
            suite=params.suite,
            title=f"{', '.join(dict.fromkeys(row['budget'] for row in own))} ({taken.date})",
            command="make gpu-check" if params.suite == "gpu" else command_of(params),
            source="bench",
            taken=taken,
            columns=columns,
            rows=shown,
            notes=[*tables.verdicts(params.suite, own), *notes],
            asked=asked,
        )
        files.append(write_set(figures_folder(page), result))
    write_page(page)
    return [*files, page]


def _without_gpu(params: BenchParams, out: Path, report: Reporter) -> dict[str, Any]:
    """The result where there is no GPU: every figure is there and says that it was not measured."""
    report.warn("No NVIDIA GPU: nothing of this suite was measured.")
    from . import gpu

    values = dict.fromkeys(gpu.ASKED)
    if params.page is not None:
        write_page(params.page)
    result = {
        "suite": "gpu",
        "machine": f"no NVIDIA GPU; PyTorch {torch.__version__}",
        "runs": 0,
        "failed": 0,
        "rows": [],
        "figures": values,
        "notes": ["not measured: no NVIDIA GPU"],
        "files": [str(out / "results.json")],
    }
    write_json(out / "results.json", result)
    return result
