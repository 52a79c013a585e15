"""What the suite `gpu` reports, with and without a GPU."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from fieldwork.nerfcore.bench import gpu, gpu_check
from fieldwork.nerfcore.bench.page import figures_folder
from fieldwork.nerfcore.bench.results import Asked, write_set
from fieldwork.nerfcore.params import BenchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import config_of
from fieldwork.tests.nerfcore.test_bench_page import some_set


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_nothing_is_made_up(tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    result = run_verb("bench", BenchParams(suite="gpu", out=tmp_path, page=page), Reporter())
    assert set(result["figures"].values()) == {None}
    assert "Not measured: no NVIDIA GPU" in page.read_text("utf-8")
    assert not figures_folder(page).exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_what_one_measured_stays(tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    asked = Asked(figures={"800×800 colour (frames/s)": 75.0}, checks="12 of 12", waits={"model.py:12": 3})
    write_set(figures_folder(page), some_set(suite="gpu", command="make gpu-check", asked=asked))
    run_verb("bench", BenchParams(suite="gpu", out=tmp_path, page=page), Reporter())
    text = page.read_text("utf-8")
    assert "| 800×800 colour (frames/s) | ≥ 60 | 75 | met |" in text
    assert "| lego_400: PSNR after 30 s (dB) | ≥ 33 | not measured |  |" in text
    assert "Kernels: 12 of 12" in text
    assert "no NVIDIA GPU was at hand" not in text


def test_the_gpu_page_says_what_was_met_and_what_was_missed(tmp_path: Path) -> None:
    rows = [
        {
            "scene": "lego_400",
            "budget": "30 s",
            "psnr": 33.4,
            "miou": None,
            "fps_800": 75.0,
            "memory_training_mb": 900.0,
        },
        {
            "scene": "replica_room",
            "budget": "30 s",
            "psnr": 29.0,
            "miou": 0.9,
            "fps_800": 50.0,
            "memory_training_mb": 800.0,
        },
    ]
    tests = tmp_path / "tests.xml"
    tests.write_text('<testsuites><testsuite tests="14" skipped="2" failures="1" errors="0"/></testsuites>')
    values = gpu.figures(rows, 3.0, 0.75)
    text = gpu.section("Some GPU", gpu.kernel_checks(tests), values, "TABLE", {"model.py:12": 3})
    assert "11 of 12 agree with their twins" in text
    assert "| lego_400: PSNR after 30 s (dB) | ≥ 33 | 33.4 | met |" in text
    assert "| 800×800 colour and classes (frames/s) | ≥ 120 | 50 | missed |" in text
    assert "| peak memory, rendering (MiB) | ≤ 1144 | not measured |  |" in text
    assert "| host synchronisations in an ordinary step | ≤ 0 | 3 | missed |" in text
    assert "| share of the steps that were recorded | ≥ 0.5 | 0.75 | met |" in text
    assert "`model.py:12` (3×)" in text


class _Cpu:
    """The calls of torch.cuda that the check makes."""

    @staticmethod
    def set_sync_debug_mode(mode: str) -> None:
        assert mode in ("warn", "default")


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_the_whole_check_runs_as_far_as_the_cpu_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    real, page = gpu_check.commands, tmp_path / "benchmarks.md"

    def few(*arguments: Any) -> dict[str, list[str]]:
        planned = real(*arguments)
        planned["kernels and steps"][planned["kernels and steps"].index("tests/nerfcore")] = (
            "tests/nerfcore/test_fused.py"
        )
        return planned

    monkeypatch.setattr(gpu_check, "commands", few)
    monkeypatch.setattr("sys.argv", ["gpu_check", "--out", str(tmp_path / "out"), "--page", str(page)])
    assert gpu_check.main() == 0
    assert (tmp_path / "out" / "tests.xml").is_file()
    assert "Not measured: no NVIDIA GPU" in page.read_text("utf-8")
    assert "figures: done" in capfd.readouterr().out


def test_kernels_are_profiled_where_the_profiler_is(tmp_path: Path) -> None:
    planned = gpu_check.commands("python3", tmp_path, tmp_path / "page.md", ["--keep"], "/usr/bin/ncu")
    assert list(planned) == ["kernels and steps", "figures", "profile"]
    assert planned["profile"][0] == "/usr/bin/ncu"
    assert planned["figures"][-1] == "--keep"
    assert "profile" not in gpu_check.commands("python3", tmp_path, tmp_path / "page.md", [], None)


def test_the_check_of_steps_runs_as_far_as_the_cpu_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a GPU machine runs first must not stop at a name that is wrong."""
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", _Cpu.set_sync_debug_mode)
    monkeypatch.setattr(gpu, "use_device", lambda: torch.device("cpu"))
    monkeypatch.setattr(gpu, "make_config", lambda preset: config_of())
    monkeypatch.setattr(gpu, "WARM_STEPS", 3)
    monkeypatch.setattr(gpu, "COUNTED_STEPS", 2)
    project = ball_project(tmp_path / "ball", views=4, side=16)
    synchronisations, waits, recorded = gpu.step_synchronisations(project, Reporter())
    assert (synchronisations, waits, recorded) == (0.0, {}, 0.0)


def test_synchronisations_are_counted_in_ordinary_steps_only() -> None:
    def step(index: int) -> None:
        if index % 4 == 0 or index == 9:
            warnings.warn("called a synchronizing CUDA operation (Triggered internally)", UserWarning, stacklevel=1)
        warnings.warn("something else", UserWarning, stacklevel=1)

    counted, places = gpu.count_synchronisations(step, 8, 8, 4)
    assert counted == 6
    assert sum(places.values()) == 1
    assert next(iter(places)).startswith("nerfcore/test_bench_gpu.py:")
