"""The benchmark suites with tiny budgets, and what their tables say."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner
from fieldwork.nerfcore.bench import machine, suites, tables
from fieldwork.nerfcore.bench.jobs import Job, interrupted
from fieldwork.nerfcore.bench.machine import run_yardstick
from fieldwork.nerfcore.bench.page import figures_folder
from fieldwork.nerfcore.bench.results import read_sets
from fieldwork.nerfcore.bench.scenes import prepare
from fieldwork.nerfcore.errors import Cancelled, InputError, SettingError, TrainingError
from fieldwork.nerfcore.params import BenchParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.test_training import tiny_project  # noqa: F401
from PIL import Image

TINY = {**SMALL, "sampling.samples": "4", "render.samples": "4"}


@pytest.fixture(scope="module", autouse=True)
def small_frames() -> Iterator[None]:
    """Frames that only count samples are of 40×40."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (suites, tables):
            patch.setattr(module, "COUNTING_SIDE", 40)
        yield


class Recorder(Reporter):
    def __init__(self) -> None:
        super().__init__()
        self.fractions: list[float] = []
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)

    def progress(self, fraction: float, message: str = "") -> None:
        super().progress(fraction, message)
        self.fractions.append(fraction)


def bench(out: Path, project: Path, suite: str, report: Reporter | None = None, **values) -> dict:
    values = {"preset": "draft", "set": TINY, **values}
    params = BenchParams(suite=suite, out=out, scenes=[str(project)], **values)  # type: ignore[arg-type]
    return run_verb("bench", params, report or Reporter())


@pytest.fixture(scope="module")
def ablation(tiny_project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, Recorder]:  # noqa: F811
    out, report = tmp_path_factory.mktemp("bench"), Recorder()
    variants = ["hybrid", "explicit", "implicit", "semantic pdf", "uniform pdf"]
    return out, bench(out, tiny_project, "ablation", report, steps=12, variants=variants), report


def test_a_suite_writes_figures_table_and_plot(ablation: tuple[Path, dict, Recorder]) -> None:
    out, result, report = ablation
    assert result["runs"] == 5
    assert result["failed"] == 0
    assert all(Path(file).is_file() for file in result["files"])
    stored = json.loads((out / "ablation" / "results.json").read_text("utf-8"))
    assert [row["variant"] for row in stored["rows"]] == [row["variant"] for row in result["rows"]]
    for row in stored["rows"]:
        assert row["steps"] == 12
        assert 0 < row["psnr"] < 60
        assert 0 <= row["miou"] <= 1
        assert row["spr"] > 0
    # equal samples per ray is what makes the comparison fair
    by = {row["variant"]: row for row in stored["rows"]}
    assert by["uniform pdf"]["spr"] == pytest.approx(by["hybrid"]["spr"], rel=0.3)
    assert by["explicit"]["psnr_gain"] == pytest.approx(by["explicit"]["psnr"] - by["hybrid"]["psnr"], abs=1e-3)
    text = (out / "ablation" / "table.md").read_text("utf-8")
    assert "| explicit |" in text
    pairs = [(by["hybrid"][key], by[other][key]) for other in ("explicit", "implicit") for key in ("psnr", "miou")]
    assert f"hybrid {'beats' if all(ours > other for ours, other in pairs) else 'does not beat'} both" in text
    with Image.open(out / "ablation" / "plot.png") as picture:
        assert picture.width > 500
    assert report.fractions[-1] == pytest.approx(1.0)


def test_finished_runs_are_not_repeated_but_changed_ones_are(
    ablation: tuple[Path, dict, Recorder],
    tiny_project: Path,  # noqa: F811
) -> None:
    out, first, _ = ablation
    files = {p: p.stat().st_mtime_ns for p in (out / "ablation" / "runs").glob("*.json")}
    again = bench(out, tiny_project, "ablation", steps=12, variants=["hybrid", "explicit"])
    assert {p: p.stat().st_mtime_ns for p in files} == files
    assert again["rows"][0]["psnr"] == first["rows"][0]["psnr"]
    changed = {**TINY, "train.seed": "4"}
    bench(out, tiny_project, "ablation", steps=12, variants=["explicit"], set=changed)
    rewritten = [p for p in files if p.stat().st_mtime_ns != files[p]]
    assert [p.name for p in rewritten] == [
        "bench-" + re.sub(r"[^\w.-]+", "-", tiny_project.name) + "-explicit-12-steps.json"
    ]


def test_fields_are_removed_unless_they_are_kept(ablation: tuple[Path, dict, Recorder], tiny_project: Path) -> None:  # noqa: F811
    out, _, _ = ablation
    assert not list((out / "projects").glob("*/runs/*/field.safetensors"))
    bench(out, tiny_project, "ablation", steps=12, variants=["no semantics"], keep=True)
    assert len(list((out / "projects").glob("*/runs/*/field.safetensors"))) == 1


@pytest.mark.slow
def test_a_page_gets_the_figures_of_a_suite(
    tiny_project: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(machine, "checked_out", lambda: ("abc12345", False))
    page, report = tmp_path / "docs" / "benchmarks.md", Recorder()
    run = partial(bench, tmp_path, tiny_project, "figures", steps=6, page=page)
    result = run(report, seeds=[0, 3])
    assert [row["seed"] for row in result["rows"]] == [0, 3]
    assert any("2 seeds: PSNR" in note for note in result["notes"])
    assert report.notes[-1] == "2 of 2 runs to do, roughly 2 minutes."
    (measured,) = read_sets(figures_folder(page))
    assert (measured.source, measured.taken.commit) == ("bench", "abc12345")
    assert measured.command.endswith(
        "--steps 6 --seeds 0,3 --preset draft" + "".join(f" --set {k}={v}" for k, v in TINY.items())
    )
    assert measured.taken.machine.threads == torch.get_num_threads()
    assert [row["psnr"] for row in measured.rows] == [row["psnr"] for row in result["rows"]]
    text = page.read_text("utf-8")
    assert f"### 6 steps ({measured.taken.date})" in text
    assert measured.command in text
    assert measured.origin() in text
    again = Recorder()
    run(again, seeds=[0, 3])
    assert again.notes[-1].startswith("0 of 2 runs to do")
    assert len(read_sets(figures_folder(page))) == 1
    assert page.read_text("utf-8") == text


@pytest.mark.slow
def test_runs_of_unknown_origin_are_named_and_not_on_the_page(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    page, report = tmp_path / "docs" / "benchmarks.md", Recorder()
    bench(tmp_path, tiny_project, "figures", steps=6, seeds=[0, 1])
    first = sorted((tmp_path / "figures" / "runs").glob("*.json"))[0]
    old = {key: value for key, value in json.loads(first.read_text("utf-8")).items() if key != "taken"}
    first.write_text(json.dumps(old), encoding="utf-8")
    bench(tmp_path, tiny_project, "figures", report, steps=6, seeds=[0, 1], page=page)
    (measured,) = read_sets(figures_folder(page))
    assert [row["seed"] for row in measured.rows] == [1]
    assert any(str(first) in warning for warning in report.warnings)


def test_a_page_that_somebody_wrote_is_not_overwritten(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    page = tmp_path / "README.md"
    page.write_text("# Mine\n", encoding="utf-8")
    with pytest.raises(InputError, match="was not made by this command"):
        bench(tmp_path, tiny_project, "figures", steps=6, page=page)
    assert page.read_text("utf-8") == "# Mine\n"
    assert not (tmp_path / "figures" / "runs").exists()


@pytest.mark.slow
def test_speed_has_two_limits_and_two_frame_sizes(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    result = bench(tmp_path, tiny_project, "speed", seconds=0.4)
    assert [row["budget"] for row in result["rows"]] == ["0.4 s", "2 s"]
    for row in result["rows"]:
        for side in (400, 800):
            assert row[f"fps_{side}"] > 0
            assert row[f"ms_sampling_{side}"] > 0
            assert row[f"ms_network_{side}"] > 0
        assert row["rays_per_second"] > 0
        assert row["memory_training_mb"] > 50
        assert row["params_m"] > 0
        assert row["render_taken"] >= row["render_least"] > 0
        assert row["step_taken"] >= row["step_least"] > 0
    table = (tmp_path / "speed" / "table.md").read_text("utf-8")
    assert "Frames of 800×800" in table
    assert "times the least" in table


@pytest.mark.slow
def test_robustness_reports_drops_against_the_clean_run(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    result = bench(tmp_path, tiny_project, "robustness", steps=10, variants=["clean", "noise 0.05", "10 % labelled"])
    by = {row["variant"]: row for row in result["rows"]}
    assert by["clean"].get("psnr_gain") is None
    assert by["noise 0.05"]["psnr_gain"] == pytest.approx(by["noise 0.05"]["psnr"] - by["clean"]["psnr"], abs=1e-3)
    assert any("published 5.4" in note for note in result["notes"])


def test_a_cancelled_suite_goes_on_where_it_stopped(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    report = Reporter()
    failures: list[BaseException] = []

    def run() -> None:
        try:
            bench(tmp_path, tiny_project, "ablation", report, seconds=1.5, variants=["hybrid", "explicit"])
        except Cancelled as stop:
            failures.append(stop)

    thread = threading.Thread(target=run)
    thread.start()
    runs = tmp_path / "ablation" / "runs"
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline and not list(runs.glob("*.json")):
        time.sleep(0.05)
    report.cancel()
    thread.join(60)
    assert len(failures) == 1
    done = list(runs.glob("*.json"))
    assert len(done) == 1
    before = done[0].stat().st_mtime_ns
    result = bench(tmp_path, tiny_project, "ablation", seconds=1.5, variants=["hybrid", "explicit"])
    assert result["runs"] == 2
    assert done[0].stat().st_mtime_ns == before


def test_an_unfinished_run_goes_on_only_with_its_own_settings(tiny_project: Path) -> None:  # noqa: F811
    settings = {k: v for k, v in TINY.items() if k != "field.finest"}  # the photos decide
    job = Job("a", "unfinished", settings, steps=12)
    train = TrainParams(project=tiny_project, preset=job.preset, run=job.name, steps=4, set=settings)
    run_verb("train", train, Reporter())
    assert interrupted(job, tiny_project)
    assert not interrupted(replace(job, settings={**settings, "train.seed": "4"}), tiny_project)
    assert not interrupted(replace(job, variant="other"), tiny_project)


def test_two_scenes_of_one_name_are_refused(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    params = BenchParams(suite="speed", out=tmp_path, scenes=[str(tiny_project), str(tiny_project)])
    with pytest.raises(InputError, match="Two scenes are called"):
        run_verb("bench", params, Reporter())


def test_another_project_of_the_name_of_a_scene_is_not_taken_for_it(tmp_path: Path) -> None:
    first, other = (ball_project(tmp_path / folder / "vase", views=3, side=8) for folder in "ab")
    copied = prepare(str(first), None, tmp_path / "out", Reporter())
    assert prepare(str(first), None, tmp_path / "out", Reporter()) == copied
    with pytest.raises(InputError, match="not a copy of"):
        prepare(str(other), None, tmp_path / "out", Reporter())


def test_a_run_that_fails_does_not_stop_the_others(
    tiny_project: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def diverge(*_: object) -> None:
        raise TrainingError("Training diverged: the loss is no longer a number.")

    monkeypatch.setattr("fieldwork.nerfcore.train.verb._Loop.run", diverge)
    report = Reporter()
    result = bench(tmp_path, tiny_project, "ablation", report, steps=30, variants=["hybrid", "explicit"], set=TINY)
    assert result["failed"] == 2
    assert result["rows"][0]["psnr"] is None
    assert "diverged" in (tmp_path / "ablation" / "table.md").read_text("utf-8")
    assert not list((tmp_path / "ablation" / "runs").glob("*.json"))
    assert any("diverged" in warning for warning in report.warnings)


def test_unknown_variants_and_scenes_are_named(tiny_project: Path, tmp_path: Path) -> None:  # noqa: F811
    with pytest.raises(SettingError, match="no variant “warm”"):
        bench(tmp_path, tiny_project, "ablation", variants=["warm"])
    with pytest.raises(InputError, match="no scene “moon”"):
        run_verb("bench", BenchParams(suite="speed", out=tmp_path, data=tmp_path, scenes=["moon"]), Reporter())
    with pytest.raises(InputError, match="not a folder"):
        run_verb("bench", BenchParams(suite="speed", out=tmp_path, data=tmp_path / "nowhere"), Reporter())


def test_the_yardstick_runs_beside_us(tmp_path: Path) -> None:
    script = tmp_path / "other.py"
    script.write_text(
        "import json, sys\nprint('warming up')\nprint(json.dumps({'psnr': 24.5, 'asked': sys.argv[1]}))\n"
    )
    assert run_yardstick(script, 3, Reporter()) == {"psnr": 24.5, "asked": "3"}
    script.write_text("raise SystemExit('no data')\n")
    with pytest.raises(InputError, match="no data"):
        run_yardstick(script, 3, Reporter())


def test_the_command_line_has_the_verb() -> None:
    from fieldwork.nerfcore.cli import _command

    result = CliRunner().invoke(_command("bench"), ["--help"])
    assert result.exit_code == 0
    assert "--suite" in result.output
    assert "--yardstick" in result.output
