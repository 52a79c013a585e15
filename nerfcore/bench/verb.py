"""The verb `bench`: reproduce a table of figures on this machine.

OUT/SUITE/results.json   every figure      OUT/SUITE/table.md   the table      OUT/SUITE/plot.png
OUT/SUITE/runs/*.json    one file a run: it is not repeated while its settings stay the same
OUT/projects/            the scenes
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ..errors import InputError
from ..files import write_json, write_section, write_text
from ..kernels.device import use_device
from ..params import BenchParams
from ..progress import Reporter
from . import gpu, machine, tables
from .jobs import run_all
from .scenes import available, data_folder, is_labelled, prepare, scene_name
from .suites import MISSING_BASELINES, PUBLISHED_DROPS, SCENES, SECONDS, plan


def bench(params: BenchParams, report: Reporter) -> dict[str, Any]:
    """Run a suite, or what is missing of it.

    Returns:
        {"suite", "machine", "runs", "failed", "rows": […], "notes": […], "files": […]}
    Raises:
        InputError: a named scene is not there. SettingError: an unknown variant or setting.
    """
    root = Path(params.out)
    out = root / params.suite
    if params.suite == "gpu" and use_device().type != "cuda":
        return _without_gpu(params, out, report)
    data = data_folder(params.data)
    projects, notes = _scenes(params, data, root, report)
    jobs = plan(params, list(projects))
    results = run_all(jobs, projects, out, report, keep=params.keep)
    rows = tables.make_rows(params.suite, results)
    described = machine.describe()
    if params.yardstick is not None and params.suite == "speed":
        seconds = min((job.seconds for job in jobs if job.seconds), default=SECONDS["speed"])
        notes.append(f"Yardstick {params.yardstick.name}: {machine.run_yardstick(params.yardstick, seconds, report)}")
    if params.suite == "baselines":
        notes += [f"{name} is not there: it {why}." for name, why in MISSING_BASELINES.items()]
    places: dict[str, int] = {}
    if params.suite == "gpu":
        synchronisations, places = gpu.step_synchronisations(next(iter(projects.values())), report)
        checks = gpu.kernel_checks(params.tests)
        values = gpu.figures(rows, synchronisations)
        _write_gpu_page(params, described, checks, values, rows, places)
    files = _write(params, out, rows, results, described, notes)
    return {
        "suite": params.suite,
        "machine": described,
        "runs": len(results),
        "failed": sum("error" in result for result in results),
        "rows": rows,
        "notes": [*tables.verdicts(params.suite, rows), *notes],
        "files": [str(path) for path in files],
    }


def _scenes(params: BenchParams, data: Path | None, root: Path, report: Reporter) -> tuple[dict[str, Path], list[str]]:
    """Projects of the suite's scenes, and a note for each that is left out. Scenes named by the user must be there."""
    notes, projects = [], {}
    for scene in params.scenes or SCENES[params.suite]:
        if not params.scenes and not available(scene, data):
            notes.append(f"{scene} is left out: there is no such data set in {data or '../shared/data'}.")
            continue
        project = prepare(scene, data, root, report)
        if not params.scenes and params.suite in ("ablation", "robustness") and not is_labelled(project):
            notes.append(f"{scene} is left out: it has no labels.")
            continue
        if scene_name(scene) in projects:
            raise InputError(f"Two scenes are called “{scene_name(scene)}”.", "Rename one of the folders.")
        projects[scene_name(scene)] = project
    if not projects:
        raise InputError("None of the suite's scenes is there.", "Give a folder of data sets with --data.")
    return projects, notes


def _write(
    params: BenchParams,
    out: Path,
    rows: list[tables.Row],
    results: list[dict[str, Any]],
    described: str,
    notes: list[str],
) -> list[Path]:
    """JSON, Markdown and plot of a suite."""
    files = [out / "results.json", out / "table.md", out / "plot.png"]
    command = f"fieldwork bench --suite {params.suite}"
    for name in ("scenes", "variants", "seconds", "steps", "preset"):
        value = getattr(params, name)
        if value != type(params).model_fields[name].default:
            command += f" --{name} " + (f'"{",".join(value)}"' if isinstance(value, list) else f"{value}")
    command += "".join(f" --set {name}={value}" for name, value in params.set.items())
    if use_device().type == "cpu":
        notes = [*notes, "Peak memory on a CPU is that of the whole process up to then, all runs before included."]
    if params.suite == "robustness":
        limits = ", ".join(f"{name}: {p} dB, {m} points" for name, (p, m) in PUBLISHED_DROPS.items())
        notes = [*notes, f"Published drops of PSNR and mIoU: {limits}."]
    write_json(files[0], {"suite": params.suite, "machine": described, "notes": notes, "rows": rows, "runs": results})
    write_text(files[1], tables.markdown(params.suite, rows, described, command, notes))
    tables.plot(files[2], params.suite, rows, results)
    return files


def _write_gpu_page(
    params: BenchParams,
    described: str | None,
    checks: str | None,
    values: dict[str, float | None],
    rows: list[tables.Row],
    places: dict[str, int],
) -> None:
    if params.page is None:
        return
    columns = {"scene": "scene", "budget": "training", "psnr": "PSNR (dB)", "miou": "mIoU", "spr": "samples/ray"}
    columns |= {f"{key}_800": heading for key, heading in tables.SPEED.items()}
    text = gpu.section(described, checks, values, tables.table(columns, rows), places)
    write_section(params.page, "GPU", text)


def _without_gpu(params: BenchParams, out: Path, report: Reporter) -> dict[str, Any]:
    """The result where there is no GPU: every figure is there and says that it was not measured."""
    report.warn("No NVIDIA GPU: nothing of this suite was measured.")
    values = dict.fromkeys(gpu.ASKED)
    _write_gpu_page(params, None, None, values, [], {})
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
