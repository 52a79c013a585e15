"""What the panels decide and say. How they look is tested in the window (tests/gui)."""

from __future__ import annotations

import json
import math

import pytest

pytest.importorskip("bpy")

from fieldwork.addon.jobs.job import Job
from fieldwork.panels.base import duration, progress_text, reuse_text, verdict_of, wrap


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, ""), (0.2, "0 s"), (59.4, "59 s"), (60, "1:00 min"), (185, "3:05 min"), (3600, "1:00 h"), (7860, "2:11 h")],
)
def test_durations_are_said_as_people_do(seconds, text):
    assert duration(seconds) == text


def test_progress_says_what_how_much_and_how_long():
    job = Job("train", {}, "x", state="running")
    assert progress_text(job) == "Training"
    job.stage, job.fraction, job.eta = "Warming up", 0.254, 95.0
    assert progress_text(job) == "Warming up · 25% · 1:35 min left"
    job.state = "cancelling"
    assert progress_text(job) == "Stopping…"


def test_a_reconstruction_says_what_it_kept_and_why_not():
    result = {"reused": ["poses", "mesh"], "redone": {"train": "other preset"}}
    assert reuse_text(result) == ["Kept from before: poses, mesh.", "Done anew: training: other preset."]
    assert reuse_text({}) == []


def test_a_stage_says_what_is_wrong_with_its_result():
    assert verdict_of({}) is None
    assert verdict_of({"verdict": {"level": "good", "reasons": []}}) is None
    assert verdict_of({"verdict": {"level": "weak", "reasons": ["Coarse.", "Fog."]}}) == ("Coarse.", False)
    assert verdict_of({"verdict": {"level": "failed", "reasons": ["Scraps."]}}) == ("Scraps.", True)


def test_wrapped_text_keeps_its_words_and_breaks_long_paths():
    text = "Nothing could be read from /home/somebody/a/very/long/path/that/never/ends/photo.jpg at all"
    lines = wrap(text, 24)
    assert all(len(line) <= 25 for line in lines)
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")
    assert wrap("", 10) == []


def test_the_next_step_leads_from_nothing_to_the_model(bpy_script, tmp_path):
    steps = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.jobs.queue import queue
from fieldwork.panels.main import next_step
settings = bpy.context.scene.fieldwork
folder = Path(project)
seen = []
def look():
    step = next_step(bpy.context)
    seen.append(step and step.operator + (" resume" if step.resume else ""))
def write(name, value):
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(value))
look()
settings.photos = "/photos"
look()
settings.project = project
look()
write("project.json", {"format": "fieldwork-project"})
look()
write("poses/poses.json", {})
look()
write("runs/main/field.safetensors", "")
look()
write("runs/main/metrics.json", {"train": {"psnr": 30}})
look()
step = {"verb": "mesh", "result": {"faces": 8}}
write("project.json", {"format": "fieldwork-project", "provenance": [step]})
os.utime(folder / "project.json", (1, 1))
look()
settings.run = "second"
look()
queue.running = queue.make("train", {"project": project})
look()
answer(seen)
""",
        project=tmp_path / "project",
    )
    assert steps == [
        "fieldwork.open",
        "fieldwork.new",
        "fieldwork.new",
        "fieldwork.poses",
        "fieldwork.train",
        "fieldwork.train resume",
        "fieldwork.mesh",
        "fieldwork.import_scene",
        "fieldwork.train",
        None,
    ]


def test_quality_and_time_come_from_the_project(tmp_path, monkeypatch):
    from types import SimpleNamespace

    from fieldwork.addon import machine
    from fieldwork.addon.project import runs

    monkeypatch.setattr(machine, "user_folder", lambda *parts: tmp_path / "user")

    project = {
        "format": "fieldwork-project",
        "provenance": [
            {"verb": "train", "settings": {"preset": "draft"}, "result": {"seconds": 90.0}},
            {"verb": "train", "settings": {"preset": "draft", "time_limit": 5.0}, "result": {"seconds": 5.0}},
        ],
    }
    (tmp_path / "project.json").write_text(json.dumps(project))
    (tmp_path / "runs" / "main").mkdir(parents=True)
    (tmp_path / "runs" / "main" / "metrics.json").write_text(json.dumps({"test": {"psnr": 27.34, "miou": 0.871}}))
    settings = SimpleNamespace(time_limit=0.0, steps=0, preset="draft")
    assert runs.time_estimate(tmp_path, settings) == 90.0
    settings.preset = "high"
    assert runs.time_estimate(tmp_path, settings) is None
    runs.remember_time("high", 300.0)
    runs.remember_time("standard", 200.0)
    assert runs.time_estimate(tmp_path, settings) == 300.0, "from another project on this machine"
    assert runs.time_estimate(None, settings) == 300.0
    settings.steps = 10
    assert runs.time_estimate(tmp_path, settings) is None
    assert runs.quality(tmp_path, "main") == "27.3 dB, mIoU 0.87"
    assert runs.quality(tmp_path, "other") == ""


def test_curve_picture_shows_both_lines():
    from fieldwork.addon.pictures.curve import LOSS_COLOR, PSNR_COLOR, draw_curve

    curve = [(step, math.exp(-step / 50), 10 + step / 10) for step in range(100)]
    image = draw_curve(curve, 64, 32)
    assert image.shape == (32, 64, 4)
    for color, slope in ((PSNR_COLOR, 1), (LOSS_COLOR, -1)):
        rows, columns = (abs(image[..., :3] - color).max(-1) < 1e-6).nonzero()
        left, right = rows[columns < 8].mean(), rows[columns >= 56].mean()
        assert (right - left) * slope > 10
    assert draw_curve([(0, 1.0, float("nan")), (1, 1.0, float("nan"))], 8, 8).shape == (8, 8, 4)


def test_sizes_are_said_with_as_many_digits_as_they_are_sure():
    from fieldwork.panels.measure import amount_text

    row = {"area": 1.2384, "area_low": 1.21, "area_high": 1.27, "volume": None, "volume_low": None, "volume_high": None}
    assert amount_text(row, "area", "m²") == "1.24 ± 0.03 m²"
    assert amount_text(row | {"area": 140.2, "area_low": 120, "area_high": 160}, "area", "") == "140 ± 20"
    assert amount_text(row, "volume", "m³") == ""
