"""The suite `evidence`: every trial of a profile, one after the other, and the page made of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ...errors import FieldworkError, InputError, SettingError
from ...files import write_json
from ...kernels.device import use_device
from ...params import BenchParams
from ...progress import Reporter
from ..machine import describe
from ..scenes import available, data_folder, is_labelled, prepare, require_scenes, scene_name
from .page import add_results, check_page, folder_of, read_records, write_page
from .perceptual import Perceptual
from .protocol import Trial, expected_seconds, planned, protocol, trials_of
from .summary import trial_of
from .trial import failed, run_trial, stored, trial_file


def evidence_suite(params: BenchParams, out: Path, root: Path, command: str, report: Reporter) -> dict[str, Any]:
    """Run a profile of the protocol, or what is missing of it.

    The page is written after each trial, so that a stopped run leaves what it measured.

    Args:
        out: folder of the suite; a trial whose figures are there is not repeated, nor, with `add_to_page`, one on the
            page. root: where the scenes are.
    Returns:
        {"suite", "machine", "runs", "failed", "rows", "notes", "files"}
    Raises:
        InputError: another benchmark is at work in this folder, or a scene that was named is not there.
    """
    if params.steps is not None:
        raise SettingError("The suite evidence is limited by seconds or rays, not by steps.", "Leave out --steps.")
    if params.page is not None:
        check_page(params.page)
    if params.add_to_page:
        if params.page is None:
            raise SettingError("add_to_page needs the page that is added to.", "Name it with --page.")
        _adopt(params.page, params.profile, out)
    asked = trials_of(
        params.profile, params.scenes, params.variants, params.seeds, params.seconds, params.set, params.tables
    )
    projects, notes = _projects(params, root, sorted({trial.scene for _, trial in asked}), report)
    tables = [(table, trial) for table, trial in asked if _fits(trial, projects)]
    trials = list({trial.name: trial for _, trial in tables}.values())
    if not trials:
        raise InputError("Nothing of the suite can be trained: no scene is there.", "Name a folder with --data.")
    perceptual = None if params.lpips is None else Perceptual(params.lpips, use_device())
    out.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(out / ".lock", timeout=0):
            shown, shown_command = tables, command
            if params.add_to_page:  # all of the profile that there is, whatever part is measured now
                shown = list(
                    {
                        (t, trial.name): (t, trial) for t, trial in [*_possible(params.profile, projects), *tables]
                    }.values()
                )
                shown_command = f"fieldwork bench --suite evidence --profile {params.profile}"
            keep = partial(_kept, params, out, shown_command, shown, notes)
            results = _run(trials, params.profile, projects, out, perceptual, keep, report)
    except Timeout as error:
        hint = "Wait for it, or choose another folder: trainings beside each other would change the times."
        raise InputError(f"Another benchmark is at work in {out}.", hint) from error
    good = [result for result in results.values() if "error" not in result]
    rows = [{"table": table, **results[trial.name]} for table, trial in tables]
    files = keep(results)
    return {
        "suite": "evidence",
        "machine": describe(),
        "runs": len(results),
        "failed": len(results) - len(good),
        "rows": [_row(row) for row in rows],
        "notes": notes,
        "files": [str(path) for path in files],
    }


def _adopt(page: Path, profile: str, out: Path) -> None:
    """Write the figures on a page as finished trials into the suite's folder `out`, where it has none of them.

    Raises:
        InputError: the page's record cannot be read.
    """
    record = next((r for r in read_records(folder_of(page)) if r["profile"] == profile), {"rows": []})
    for row in record["rows"]:
        trial = trial_of(row)
        if "error" not in row and stored(trial, out) is None:
            figures = {key: value for key, value in row.items() if key != "table"}
            write_json(trial_file(trial, out), figures)


def _kept(
    params: BenchParams,
    out: Path,
    command: str,
    tables: list[tuple[str, Trial]],
    notes: list[str],
    results: dict[str, dict[str, Any]],
) -> list[Path]:
    """Write the record of what is measured by now, and the page with it; returns the files."""
    found = {trial.name: results.get(trial.name) or stored(trial, out) for _, trial in tables}
    rows = [{"table": table, **known} for table, trial in tables if (known := found[trial.name]) is not None]
    left = sum(known is None for known in found.values())
    part = [f"{len(found) - left} of {len(found)} trials are measured."] if left else []
    record = {"profile": params.profile, "command": command, "rows": rows, "notes": [*notes, *part]}
    files = [out / f"{params.profile}.json"]
    write_json(files[0], record)
    if params.page is not None:
        files += add_results(params.page, record, out / "pictures")
        write_page(params.page)
        files.append(params.page)
    return files


def _projects(params: BenchParams, root: Path, names: list[str], report: Reporter) -> tuple[dict[str, Path], list[str]]:
    """Projects of the scenes that are there, and a note for each that is not."""
    data, notes, projects = data_folder(params.data), [], {}
    require_scenes(params.scenes or [], data, root)
    given = {scene_name(scene): scene for scene in params.scenes or []}
    for name in names:
        scene = given.get(name, name)
        if not params.scenes and not available(scene, data):
            notes.append(f"{scene} is left out: there is no such data set in {data or '../shared/data'}.")
            continue
        projects[name] = prepare(scene, data, root, report)
    return projects, notes


def _possible(profile: str, projects: dict[str, Path]) -> list[tuple[str, Trial]]:
    """Tables and trials of a profile, without those of which a scene of `projects` is known not to have what they need."""
    return [each for each in trials_of(profile) if each[1].scene not in projects or _fits(each[1], projects)]


def _fits(trial: Trial, projects: dict[str, Path]) -> bool:
    """Whether its scene is there, with labels where it learns from them."""
    if trial.scene not in projects:
        return False
    return not protocol().variants[trial.variant].labelled or is_labelled(projects[trial.scene])


def _run(
    trials: list[Trial],
    profile: str,
    projects: dict[str, Path],
    out: Path,
    perceptual: Perceptual | None,
    keep: Callable[[dict[str, dict[str, Any]]], object],
    report: Reporter,
) -> dict[str, dict[str, Any]]:
    """Figures by the trial's name, kept after each trial; one that fails does not stop the others."""
    known = {trial.name: stored(trial, out) for trial in trials}
    for line in planned(trials, profile, [known[trial.name] is not None for trial in trials]):
        report.note(line)
    total, done, results = sum(expected_seconds(trial, profile) for trial in trials), 0.0, {}
    report.stage(f"{len(trials)} trials")
    for number, trial in enumerate(trials, 1):
        title = f"trial {number} of {len(trials)}, {trial.title}"
        share = expected_seconds(trial, profile) / total
        found = known[trial.name]
        if found is None:
            try:
                inner = _Inner(report, done, share, title)
                found = run_trial(trial, projects[trial.scene], out, perceptual, inner)
            except FieldworkError as error:
                report.warn(f"{title} failed: {error}")
                found = failed(trial, error)
            keep({**results, trial.name: found})
        results[trial.name] = found
        done += share
        report.progress(min(done, 1.0), title)
    return results


class _Inner(Reporter):
    """A trial's progress as a share of the suite's."""

    def __init__(self, outer: Reporter, begin: float, share: float, title: str) -> None:
        super().__init__()
        self.outer, self.begin, self.share, self.title = outer, begin, share, title
        self.part = (0.0, 0.0)

    def stage(self, name: str) -> None:
        self.part = {"Training": (0.0, 0.6), "Comparing": (0.6, 1.0)}.get(name, (self.part[1], self.part[1]))

    def progress(self, fraction: float, message: str = "") -> None:
        low, high = self.part
        done = low + (high - low) * min(fraction, 1.0)
        self.outer.progress(self.begin + self.share * done, f"{self.title}: {message}")

    def warn(self, message: str) -> None:
        self.outer.warn(f"{self.title}: {message}")

    def check(self) -> None:
        self.outer.check()


def _row(row: dict[str, Any]) -> dict[str, Any]:
    """What a command tells of a trial."""
    trial = row["trial"]
    kept = {key: row.get(key) for key in ("psnr", "ssim", "lpips", "miou", "params_m", "steps", "rays", "error")}
    named = {key: trial[key] for key in ("scene", "variant", "noise", "seed")}
    return {"table": row["table"], **named, **kept}
