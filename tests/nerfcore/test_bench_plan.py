"""Which runs a benchmark suite has, and what is read from their figures; nothing is trained."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.bench import tables
from fieldwork.nerfcore.bench.scenes import available
from fieldwork.nerfcore.bench.suites import ABLATION, ROBUSTNESS, TIMED, plan
from fieldwork.nerfcore.bench.verb import bench
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.errors import InputError, SettingError
from fieldwork.nerfcore.params import BenchParams
from fieldwork.nerfcore.progress import Reporter


def test_a_variant_is_what_its_name_says() -> None:
    (job,) = plan(
        BenchParams(suite="ablation", steps=5, variants=["explicit"], set={"field.branch": "implicit"}), ["a"]
    )
    assert job.settings["field.branch"] == "explicit"


def test_every_variant_is_made_of_settings_that_exist() -> None:
    for settings in (*ABLATION.values(), *ROBUSTNESS.values()):
        make_config("standard", settings)


def test_simulated_scenes_need_no_data(tmp_path: Path) -> None:
    assert available("museum", None)
    assert available("facade", tmp_path)
    assert not available("replica_room", None)
    assert not available("replica_room", tmp_path)


def test_wrong_names_are_told_before_anything_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.bench.verb.prepare", lambda *_: pytest.fail("a scene was made"))
    for values, error in (
        ({"scenes": ["museum", "musuem"]}, "There is no scene “musuem”"),
        ({"scenes": ["museum", "museum"]}, "Two scenes are called “museum”"),
        ({"variants": ["hybrid", "explict"]}, "has no variant “explict”"),
    ):
        with pytest.raises((InputError, SettingError), match=error):
            bench(BenchParams.model_validate({"suite": "ablation", "out": tmp_path, **values}), Reporter())


def test_the_plan_has_equal_steps_and_equal_time() -> None:
    jobs = plan(BenchParams(suite="ablation"), ["museum"])
    assert {job.variant for job in jobs if job.steps} >= set(ABLATION)
    assert {job.variant for job in jobs if job.seconds} == set(TIMED)
    assert len({job.name for job in jobs}) == len(jobs)
    assert {job.seconds for job in plan(BenchParams(suite="speed"), ["lego_400"])} == {120.0, 600.0}
    assert {(job.seconds, job.steps) for job in plan(BenchParams(suite="ablation", seconds=5), ["a"])} == {(5.0, None)}


def test_the_figures_are_trained_with_two_seeds_unless_one_is_set() -> None:
    jobs = plan(BenchParams(suite="figures"), ["museum"])
    assert [(job.steps, job.seconds, job.seed, job.settings["train.seed"]) for job in jobs] == [
        (600, None, 0, "0"),
        (600, None, 1, "1"),
    ]
    assert len({job.name for job in jobs}) == 2
    (job,) = plan(BenchParams(suite="figures", set={"train.seed": "7"}), ["museum"])
    assert (job.seed, job.settings["train.seed"]) == (None, "7")
    jobs = plan(BenchParams(suite="ablation", steps=5, seeds=[2, 3], variants=["hybrid", "explicit"]), ["museum"])
    assert [(job.variant, job.settings["train.seed"]) for job in jobs] == [
        ("hybrid", "2"),
        ("hybrid", "3"),
        ("explicit", "2"),
        ("explicit", "3"),
    ]


def test_rows_of_several_seeds_are_compared_within_their_seed() -> None:
    results = [
        {"job": {"scene": "a", "variant": variant, "steps": 5, "seed": seed}, "psnr": psnr, "miou": None}
        for variant, seed, psnr in (
            ("hybrid", 0, 20.0),
            ("hybrid", 1, 22.0),
            ("explicit", 0, 19.0),
            ("explicit", 1, 23.0),
        )
    ]
    assert [row.get("psnr_gain") for row in tables.make_rows("ablation", results)] == [None, None, -1.0, 1.0]


def test_ablation_verdicts_follow_the_figures() -> None:
    def row(variant: str, psnr: float, miou: float | None) -> dict:
        return {"scene": "a", "budget": "10 steps", "variant": variant, "psnr": psnr, "miou": miou}

    rows = [row("hybrid", 30, 0.9), row("explicit", 29, 0.8), row("implicit", 25, 0.85)]
    assert "hybrid beats both" in tables.verdicts("ablation", rows)[0]
    rows[1]["miou"] = 0.95
    assert "hybrid does not beat both" in tables.verdicts("ablation", rows)[0]
    rows[1]["miou"] = None
    assert tables.verdicts("ablation", rows) == []
