"""The suite `evidence`: its protocol, a trial of each kind on a tiny capture, and the page made of records."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.bench.baselines import instant_ngp
from fieldwork.nerfcore.bench.baselines.hash_grid import hash_levels
from fieldwork.nerfcore.bench.evidence import scores, suite
from fieldwork.nerfcore.bench.evidence.page import MARK, folder_of, page_text, read_records, write_page
from fieldwork.nerfcore.bench.evidence.perceptual import Perceptual
from fieldwork.nerfcore.bench.evidence.protocol import (
    Profile,
    Protocol,
    SceneEntry,
    Table,
    expected_seconds,
    protocol,
    trials_of,
)
from fieldwork.nerfcore.bench.evidence.summary import over_seeds, published
from fieldwork.nerfcore.bench.evidence.trial import run_trial
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.errors import InputError, SettingError
from fieldwork.nerfcore.evaluate.metrics import BoundaryOverlap, boundary, calibration_error
from fieldwork.nerfcore.files import write_json
from fieldwork.nerfcore.images.picture import Picture
from fieldwork.nerfcore.kernels.device import use_device
from fieldwork.nerfcore.params import BenchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.image import Frame
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from PIL import Image

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_protocol_names_what_there_is_and_has_two_seeds() -> None:
    known = protocol()
    for name, profile in known.profiles.items():
        assert len(profile.seeds) >= 2
        assert {table.name for table in profile.tables} == {"time", "rays", "noise", "ablation", "extras"}
        for table in profile.tables:
            assert (table.seconds is None) != (table.rays is None)
            assert set(table.scenes) <= known.scenes.keys()
            assert set(table.variants) <= known.variants.keys()
        for _, trial in trials_of(name):
            if trial.method == "ours":
                make_config("standard", trial.settings)
    assert set(published()["main"]) <= known.variants.keys()


def test_a_quick_run_takes_a_quarter_of_an_hour() -> None:
    trials = {trial.name: trial for _, trial in trials_of("quick")}
    assert sum(expected_seconds(trial, "quick") for trial in trials.values()) <= 15 * 60


def test_tables_share_trials_and_other_settings_are_other_trials() -> None:
    by_table = {name: {t.name for table, t in trials_of("quick") if table == name} for name in ("time", "noise")}
    assert len(by_table["time"] & by_table["noise"]) == 2  # ours without noise, two seeds
    (first,), (second,) = (
        {t.name for _, t in trials_of("quick", ["room"], ["ours"], [0], seconds)} & {t.name for t in chosen}
        for seconds in (3.0, 4.0)
        for chosen in [[t for table, t in trials_of("quick", ["room"], ["ours"], [0], seconds) if table == "time"]]
    )
    assert first != second
    with pytest.raises(SettingError, match="no variant “vqrf”"):
        trials_of("quick", variants=["vqrf"])
    assert {table for table, _ in trials_of("quick", tables=["noise", "rays"])} == {"noise", "rays"}
    with pytest.raises(SettingError, match="no table “colour”"):
        trials_of("quick", tables=["colour"])


def test_a_boundary_is_the_rim_of_a_mask() -> None:
    mask = np.zeros((100, 100), bool)
    mask[20:80, 20:80] = True
    rim = boundary(mask)  # 2 % of the diagonal: three pixels
    assert rim.sum() == 60**2 - 54**2
    full = np.ones((100, 100), bool)
    assert not boundary(full).any()  # the picture's border is no outline


def test_boundary_iou_sees_what_iou_hides() -> None:
    truth = np.zeros((100, 100), int)
    truth[20:80, 20:80] = 1
    shifted = np.roll(truth, 3, 0)
    overlap = BoundaryOverlap([1])
    overlap.add(truth, truth)
    assert overlap.mean() == 1
    overlap = BoundaryOverlap([1])
    overlap.add(truth, shifted)
    there, told = boundary(truth == 1), boundary(shifted == 1) & (truth == 1)
    assert overlap.mean() == pytest.approx((there & told).sum() / (there | told).sum())
    assert overlap.mean() < 0.6 < (truth & shifted).sum() / (truth | shifted).sum()
    assert BoundaryOverlap([1]).mean() is None


def test_calibration_error_is_the_gap_between_sure_and_right() -> None:
    sure = np.array([0.95] * 10 + [0.55] * 10)
    right = np.array([True] * 9 + [False] + [True] * 3 + [False] * 7)
    assert calibration_error(sure, right) == pytest.approx((10 * 0.05 + 10 * 0.25) / 20)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], Path, list[str]]:
    """The suite with a tiny protocol on the ball, with true depth; the second call repeats nothing."""
    folder = tmp_path_factory.mktemp("evidence")
    project = ball_project(folder / "ball", side=24, depth=True)
    small = {**SMALL, "sampling.samples": "4", "render.samples": "4"}
    variants = ["ours", "instant-ngp", "s-nerf-pp"]
    tiny = Profile(
        about="tiny",
        clock="processor",
        image_size=32,
        held_out=1,
        seeds=[0, 1],
        rays=16,
        settings={k: v for k, v in small.items() if k != "train.seed"},
        tables=[
            Table(name="time", scenes=["ball"], variants=variants[:2], seconds=0.3),
            Table(name="rays", scenes=["ball"], variants=variants[2:], rays=64),
            Table(name="noise", scenes=["ball"], variants=["ours"], noise=[0.0, 0.05], seconds=0.3),
            Table(name="ablation", scenes=["ball"], variants=["ours", "explicit"], seconds=0.3),
            Table(name="extras", scenes=["ball"], variants=["no-semantics"], seconds=0.3),
        ],
    )
    scene = SceneEntry(held_out="every 8th photo", source="a formula")
    known = protocol()
    small_protocol = Protocol(
        scenes={"ball": scene}, variants=known.variants, profiles={**known.profiles, "quick": tiny}
    )
    notes: list[str] = []

    class Recorder(Reporter):
        def note(self, message: str) -> None:
            notes.append(message)

    page = folder / "docs" / "evidence.md"
    with pytest.MonkeyPatch.context() as patch:
        for module in ("protocol", "suite", "summary", "page"):
            patch.setattr(f"fieldwork.nerfcore.bench.evidence.{module}.protocol", lambda: small_protocol)
        patch.setattr(instant_ngp, "hash_levels", lambda: hash_levels(16, 16, 256, 12))
        patch.setattr(instant_ngp, "CELLS", 32)
        patch.setattr(instant_ngp, "STEP", 0.02)
        params = BenchParams(suite="evidence", out=folder / "out", scenes=[str(project)], page=page)
        result = run_verb("bench", params, Recorder())
        before = {p: p.stat().st_mtime_ns for p in (folder / "out" / "evidence" / "trials").glob("*.json")}
        run_verb("bench", params, Recorder())
        assert before == {p: p.stat().st_mtime_ns for p in before}
        record = json.loads((folder_of(page) / "quick.json").read_text("utf-8"))
        lacking = [row for row in record["rows"] if (row["table"], row["trial"]["seed"]) != ("noise", 1)]
        copied = folder / "copied" / "docs" / "evidence.md"
        shutil.copytree(page.parent, copied.parent)
        (folder_of(copied) / "quick.json").write_text(json.dumps({**record, "rows": lacking}), encoding="utf-8")
        elsewhere = params.model_copy(update={"out": folder / "elsewhere", "page": copied, "add_to_page": True})
        only = elsewhere.model_copy(update={"tables": ["rays"]})
        run_verb("bench", only, Recorder())
        assert "11 of 12 trials are measured" in copied.read_text("utf-8")
        run_verb("bench", elsewhere, Recorder())
    return folder, result, page, notes


@pytest.mark.slow
def test_a_profile_is_measured_once_and_told(measured: tuple[Path, dict[str, Any], Path, list[str]]) -> None:
    folder, result, _, notes = measured
    assert result["failed"] == 0, [row["error"] for row in result["rows"]]
    assert result["runs"] == 2 * (2 + 1 + 1 + 1 + 1)
    assert any("12 of 12 trials to do, one after the other: about" in note for note in notes)
    assert any("0 of 12 trials to do" in note for note in notes)
    record = json.loads((folder / "out" / "evidence" / "quick.json").read_text("utf-8"))
    by = {row["trial"]["variant"]: row for row in record["rows"]}
    for name, row in by.items():
        assert 3 < row["psnr"] < 60, name
        assert row["lpips"] is None
        assert row["ms_frame"] == pytest.approx(row["ms_sampling"] + row["ms_network"], rel=0.01)
        assert row["curve"][-1][1] == row["rays"] > 0
        assert row["taken"]["machine"]["cpu"]
    assert by["s-nerf-pp"]["rays"] >= 64
    assert by["instant-ngp"]["miou"] is None
    assert by["no-semantics"]["miou"] is None
    for name in ("s-nerf-pp", "ours"):
        assert 0 <= by[name]["miou"] <= 1
        assert 0 <= by[name]["ece"] <= 1
        assert 0 <= by[name]["boundary_iou"] <= 1
    assert 0 < by["ours"]["depth_error"] < 1
    assert over_seeds(record["rows"], "psnr", variant="ours", noise=0.05).count == 2  # type: ignore[union-attr]


def test_one_seed_with_a_curve_is_enough_for_a_plot_over_time() -> None:
    from fieldwork.nerfcore.bench.evidence import plots

    def row(variant: str, seed: int, curve: list[list[float]]) -> dict[str, Any]:
        return {
            "table": "time",
            "trial": {"scene": "ball", "variant": variant, "seed": seed, "clock": "processor"},
            "curve": curve,
        }

    curve = [[1.0, 10, 20.0], [2.0, 20, 25.0]]
    rows = [row("ours", 0, []), row("ours", 1, curve), row("nerf", 0, curve)]
    lines = plots._time({"rows": rows}).axes[0].get_lines()
    assert sorted(line.get_label() for line in lines) == sorted(plots.title_of(v) for v in ("ours", "nerf"))
    assert plots._time({"rows": [*rows, row("mip-nerf", 0, [])]}) is None


def test_trials_that_no_scene_fits_are_not_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "is_labelled", lambda project: project.name != "lego_400")
    projects = {name: tmp_path / name for name in ("lego_400", "museum")}
    left = {(trial.scene, trial.variant) for _, trial in suite._possible("evening", projects)}
    assert ("lego_400", "ours") in left
    assert ("lego_400", "semantic-nerf") not in left
    assert ("museum", "semantic-nerf") in left
    assert ("facade", "semantic-nerf") in left  # not looked at yet


@pytest.mark.slow
def test_a_page_is_added_to_where_the_trials_are_gone(measured: tuple[Path, dict[str, Any], Path, list[str]]) -> None:
    """Only what the page lacks is trained; its other rows and plots stay as they are."""
    folder, _, page, notes = measured
    assert sum("1 of 12 trials to do" in note for note in notes) == 1
    assert sum("0 of 2 trials to do" in note for note in notes) == 1
    copied = folder / "copied" / "docs" / "evidence.md"
    old, new = (json.loads((folder_of(p) / "quick.json").read_text("utf-8"))["rows"] for p in (page, copied))
    anew = [row for row in new if (row["table"], row["trial"]["noise"], row["trial"]["seed"]) == ("noise", 0.05, 1)]
    assert len(anew) == 1
    assert anew[0] not in old
    assert [row for row in new if row not in anew] == [row for row in old if row["trial"] != anew[0]["trial"]]
    assert "trials are measured" not in copied.read_text("utf-8")
    assert (folder_of(copied) / "quick-crops.png").read_bytes() == (folder_of(page) / "quick-crops.png").read_bytes()


def test_adding_needs_a_page(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="page"):
        run_verb("bench", BenchParams(suite="evidence", out=tmp_path, add_to_page=True), Reporter())


@pytest.mark.slow
def test_the_page_has_a_table_for_each_published_one(measured: tuple[Path, dict[str, Any], Path, list[str]]) -> None:
    _, result, page, _ = measured
    text = page.read_text("utf-8")
    for heading in (
        "Quality at equal time",
        "Quality at equal rays",
        "Cost",
        "Noise",
        "Ablation",
        "Not in the publication",
    ):
        assert f"### {heading}: profile quick" in text
    assert "| ball | Instant-NGP | 32.5 dB | 0.3 s of a processor |" in text
    assert "| ball | ours | 0.05 | 27.4 dB, 66.2 points |" in text
    assert "18 times the" in text
    assert "not measured" in text
    for plot in ("time", "parameters", "noise", "ablation", "crops"):
        file = folder_of(page) / f"quick-{plot}.png"
        assert str(file) in result["files"]
        assert f"(evidence/quick-{plot}.png)" in text
        with Image.open(file) as image:
            assert len(np.unique(np.asarray(image.convert("L")))) > 20, plot  # something is drawn


@pytest.mark.slow
def test_the_baked_field_is_measured_like_the_others(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball", side=24)
    small = {**SMALL, "sampling.samples": "4"}
    trial = next(t for _, t in trials_of("cpu", [str(project)], ["baked"], [0], 2.0, small))
    figures = run_trial(
        trial.model_copy(update={"image_size": 32, "seconds": None, "rays": 60_000}),
        project,
        tmp_path / "out",
        None,
        Reporter(),
    )
    assert figures["psnr"] > 10
    assert figures["ms_network"] == figures["ms_frame"]
    assert not list((project / "runs").glob("*/*.safetensors"))


def test_photos_of_which_masks_leave_nothing_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And figures that nothing was measured for are None, which JSON has a word for."""
    project = ball_project(tmp_path / "ball", views=9, side=24)
    scene = load_scene(project, 2)
    grey = np.full((24, 24), 0.5, np.float32)
    picture = Picture(np.stack([grey] * 4, -1), alpha="associated")
    frame = Frame(picture, 1.0, grey, np.stack([grey] * 2, -1), np.stack([grey] * 3, -1))
    trainee = SimpleNamespace(
        scene=scene,
        info=SimpleNamespace(class_ids=[1, 2], image_size=24),
        device=use_device(),
        box_from_world=np.eye(4),
        background=1.0,
        frame=lambda *_: frame,
        sampling_share=lambda *_: 0.5,
    )
    hidden = {scene.views[scene.test[0]].name}
    true = scores.compared_with

    def compared(view: View, *rest: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        photo, keep, label = true(view, *rest)
        return (photo, np.zeros((24, 24), bool), label) if view.name in hidden else (photo, keep, label * 0)

    monkeypatch.setattr(scores, "compared_with", compared)
    _, trial = trials_of("quick")[0]
    trial = trial.model_copy(update={"held_out": len(scene.test)})
    figures = scores.scored(trial, trainee, project, tmp_path, None, Reporter())  # type: ignore[arg-type]
    assert figures["images"] == len(scene.test) - 1
    assert 0 < figures["psnr"] < 60
    assert (figures["miou"], figures["ece"]) == (None, None)
    write_json(tmp_path / "figures.json", figures)
    hidden.update(view.name for view in scene.views)
    with pytest.raises(InputError, match="masks leave nothing"):
        scores.scored(trial, trainee, project, tmp_path, None, Reporter())  # type: ignore[arg-type]


def test_a_page_that_somebody_wrote_is_left_alone(tmp_path: Path) -> None:
    page = tmp_path / "evidence.md"
    page.write_text("# Mine\n", encoding="utf-8")
    with pytest.raises(InputError, match="was not made by this command"):
        write_page(page)
    folder_of(tmp_path / "other.md").mkdir()
    (folder_of(tmp_path / "other.md") / "quick.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"quick\.json is not a record"):
        read_records(folder_of(tmp_path / "other.md"))


def test_the_page_of_this_repository_is_what_its_records_say() -> None:
    text = (DOCS / "evidence.md").read_text("utf-8")
    assert MARK in text
    assert text == page_text(DOCS / "evidence")


def test_two_runs_beside_each_other_and_steps_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = ball_project(tmp_path / "ball", side=16)
    out = tmp_path / "out"
    with pytest.raises(SettingError, match="not by steps"):
        run_verb("bench", BenchParams(suite="evidence", out=out, scenes=[str(project)], steps=3), Reporter())
    (out / "evidence").mkdir(parents=True)
    with suite.FileLock(out / "evidence" / ".lock"), pytest.raises(InputError, match="Another benchmark is at work"):
        run_verb("bench", BenchParams(suite="evidence", out=out, scenes=[str(project)]), Reporter())


def test_lpips_without_its_package_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "lpips", None)
    with pytest.raises(InputError, match="needs the package lpips"):
        Perceptual(tmp_path / "vgg16.pth", use_device())
