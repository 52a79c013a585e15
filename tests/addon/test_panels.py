"""What the panels decide and say. How they look is tested in the window (tests/gui)."""

from __future__ import annotations

import json
import math

import pytest

pytest.importorskip("bpy")

from fieldwork.addon.jobs.job import Job
from fieldwork.panels.base import draw_verdict, duration, progress_text, reuse_text, verdict_of


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


def test_messages_name_the_settings_of_the_panels_instead_of_options(bpy_script):
    said = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.panels.base import with_labels
answer([with_labels(text, bpy.context) for text in [
    "Keep the surroundings with --keep-backdrop.", "--keep-exposure leaves them.", "--group 1 uses the next one",
    "Set it with --no-such-thing.",
]])
"""
    )
    assert said == [
        "Keep the surroundings with “Keep Dark Surroundings”.",
        "“Keep Exposures” leaves them.",
        "“Group” 1 uses the next one",
        "Set it with --no-such-thing.",
    ]


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


@pytest.mark.parametrize(("level", "red", "icon"), [("failed", True, "ERROR"), ("weak", False, "INFO")])
def test_a_failed_verdict_is_red(level, red, icon):
    from types import SimpleNamespace

    drawn = []
    column = SimpleNamespace(label=lambda text, icon: drawn.append((text, icon)))
    box = SimpleNamespace(alert=None, column=lambda **_: column)
    context = SimpleNamespace(preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)), region=None)
    result = {"verdict": {"level": level, "reasons": ["Only scraps came of it."]}}
    draw_verdict(SimpleNamespace(box=lambda: box), context, result)
    assert box.alert == red
    assert [text for text, _ in drawn] == ["Only scraps came of it."]
    assert drawn[0][1] == icon


def test_poses_and_evaluation_show_what_they_say_against_their_results(tmp_path, monkeypatch):
    from unittest.mock import MagicMock

    from fieldwork.panels import poses, train

    weak = {"verdict": {"level": "weak", "reasons": ["3 of 20 photos were not placed."]}}
    poor = {"psnr": 14.2, "verdict": {"level": "failed", "reasons": ["Held-out photos look different."]}}
    (tmp_path / "runs" / "main").mkdir(parents=True)
    (tmp_path / "runs" / "main" / "metrics.json").write_text(json.dumps({"train": {}, "test": poor}))
    provenance = [{"verb": "poses", "settings": {}, "result": weak}]
    (tmp_path / "project.json").write_text(json.dumps({"format": "fieldwork-project", "provenance": provenance}))
    shown = []
    context = MagicMock()
    context.scene.fieldwork.configure_mock(run="main", pose_index=-1, images=[])
    for module in (poses, train):
        monkeypatch.setattr(module, "project_folder", lambda context: tmp_path)
        monkeypatch.setattr(module, "draw_verdict", lambda layout, context, result: shown.append(result))
    monkeypatch.setattr(poses.snapshot, "has_poses", lambda folder: True)
    monkeypatch.setattr(poses.states, "training", lambda context: False)
    poses.FIELDWORK_PT_poses.draw(MagicMock(), context)
    train.FIELDWORK_PT_runs.draw(MagicMock(), context)
    assert shown == [weak, poor]


def test_results_of_another_run_are_not_shown(tmp_path, monkeypatch):
    from unittest.mock import MagicMock

    from fieldwork.panels import main, mesh, states, train

    results = {"first": {"faces": 7000}, "second": {"faces": 9000}}
    provenance = [
        {"verb": verb, "settings": {"run": run}, "result": result}
        for run, result in results.items()
        for verb in ("train", "mesh")
    ]
    (tmp_path / "project.json").write_text(json.dumps({"format": "fieldwork-project", "provenance": provenance}))
    shown = []
    for module in (mesh, states, train):
        monkeypatch.setattr(module, "project_folder", lambda context: tmp_path)
    for module in (mesh, train):
        monkeypatch.setattr(module, "draw_verdict", lambda layout, context, result: shown.append(result))
    monkeypatch.setattr(mesh, "open_folder", lambda layout, folder: None)
    monkeypatch.setattr(train, "draw_estimate", lambda layout, context: None)
    monkeypatch.setattr(main.snapshot, "folder_of", lambda settings: tmp_path)
    monkeypatch.setattr(main.snapshot, "absence", lambda settings: None)
    monkeypatch.setattr(main.snapshot, "has_poses", lambda folder: True)
    monkeypatch.setattr(main.runs, "can_resume", lambda folder, run: False)
    monkeypatch.setattr(main.runs, "has_run", lambda folder, run: True)
    context, said = MagicMock(), {}
    for run in ("first", "second", "third"):
        context.scene.fieldwork.configure_mock(run=run)
        shown.clear()
        mesh.FIELDWORK_PT_mesh.draw(MagicMock(), context)
        train.FIELDWORK_PT_train.draw(MagicMock(), context)
        said[run] = [*shown], tuple(states.mesh(context)), main.next_step(context).operator
    assert said == {
        "first": ([results["first"]] * 2, (True, "7 k faces"), "fieldwork.import_scene"),
        "second": ([results["second"]] * 2, (True, "9 k faces"), "fieldwork.import_scene"),
        "third": ([{}], (False, ""), "fieldwork.mesh"),
    }


def test_what_was_rendered_last_is_that_of_the_chosen_run(tmp_path, monkeypatch):
    from types import SimpleNamespace

    from fieldwork.panels import states

    def rendered(run, project, file):
        result = {"frames": [f"{file}.exr", f"{file}.png"]}
        return Job("render", {"run": run}, id=file, project=project, state="done", result=result)

    monkeypatch.setattr(states, "project_folder", lambda context: tmp_path)
    finished = [
        rendered("main", tmp_path, "a"),
        rendered("other", tmp_path, "b"),
        rendered("main", tmp_path / "c", "c"),
    ]
    monkeypatch.setattr(states.queue, "finished", finished)
    for run, shown in (("main", ["a.png"]), ("other", ["b.png"]), ("third", [])):
        context = SimpleNamespace(scene=SimpleNamespace(fieldwork=SimpleNamespace(run=run)))
        assert [str(path) for path in states.rendered(context)] == shown
        assert states.render(context).done == bool(shown)


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
    image = draw_curve(curve, 256, 128)
    assert image.shape == (128, 256, 4)
    for color, slope in ((PSNR_COLOR, 1), (LOSS_COLOR, -1)):
        rows, columns = (abs(image[..., :3] - color).max(-1) < 1e-6).nonzero()
        inside = (columns >= 72) & (columns < 184)
        rows, columns = rows[inside], columns[inside]
        left, right = rows[columns < 84].mean(), rows[columns >= 172].mean()
        assert (right - left) * slope > 50
    assert draw_curve([(0, 1.0, float("nan")), (1, 1.0, float("nan"))], 64, 32).shape == (32, 64, 4)


def test_axes_of_the_curve_are_numbered():
    from fieldwork.addon.pictures.curve import PSNR_COLOR, amount, count, draw_curve

    assert [amount(value) for value in (3.14159, 0.5, 0.0219, 0.00042)] == ["3.14", "0.50", ".022", ".0004"]
    assert [count(value) for value in (0, 950, 4000, 12500, 2_000_000)] == ["0", "950", "4k", "12.5k", "2M"]

    def letters(top):
        """What stands to the left of the axis: the PSNR's largest and smallest value."""
        image = draw_curve([(0, 1.0, 10.0), (100, 0.5, top)], 448, 320)
        return (abs(image[:, :72, :3] - PSNR_COLOR).max(-1) < 1e-6).sum(1)

    rows = letters(20.0)
    assert rows[300:].any()  # at the top
    assert rows[28:48].any()  # at the bottom
    assert not rows[48:300].any()
    assert (letters(25.0)[300:] != rows[300:]).any(), "another number, other letters"


def test_sizes_are_said_with_as_many_digits_as_they_are_sure():
    from fieldwork.panels.measure import amount_text

    row = {"area": 1.2384, "area_low": 1.2088, "area_high": 1.268, "volume": None}
    assert amount_text(row, "area", "m²") == "1.238 ± 0.030 m²"
    assert amount_text(row | {"area": 140.2, "area_low": 120, "area_high": 160}, "area", "") == "140 ± 20"
    cut_off = row | {"area": 0.8, "area_low": 0.0, "area_high": 2.3}
    assert amount_text(cut_off, "area", "") == "0.8 ± 1.5"
    assert amount_text(row, "volume", "m³") == ""


def test_the_whole_surface_is_said_before_the_classes():
    from fieldwork.panels.measure import measured_rows

    half = {"area": 1.2384, "area_low": 1.2088, "area_high": 1.268, "volume": None}
    whole = {"name": "whole surface", "area": 140.2, "area_low": 120, "area_high": 160}
    measures = {"unit": "m", "whole": whole | {"volume": 9, "volume_low": 8, "volume_high": 10}, "classes": []}
    assert measured_rows(measures) == [("Whole", "140 ± 20 m²   9.0 ± 1.0 m³")]
    measures = {"unit": "scene units", "classes": [{"name": "Gold", **half}]}
    assert measured_rows(measures) == [("Gold", "1.238 ± 0.030")]
    measures = {"unit": "scene units", "classes": [{"name": "Gold", **half, "area_guessed": half["area"] / 4}]}
    assert measured_rows(measures) == [("Gold", "1.238 ± 0.030   25.0% a guess")]
    measures["classes"][0]["area_guessed"] = 1e-4
    assert measured_rows(measures) == [("Gold", "1.238 ± 0.030")]


def test_distances_are_told_beside_what_is_known_of_them():
    from fieldwork.panels.measure import distance_rows

    told = {"name": "door", "length": 2.0121, "low": 2.0021, "high": 2.0221, "known": 2.0, "difference": 0.0121}
    free = {**told, "name": "sill", "known": None, "difference": None}
    assert distance_rows({"unit": "m", "distances": [told, free]}) == [
        ("door", "2.012 ± 0.010 m   +0.0121 m off"),
        ("sill", "2.012 ± 0.010 m"),
    ]
    assert distance_rows({"unit": "scene units", "distances": [free]}) == [("sill", "2.012 ± 0.010")]
    assert distance_rows({"unit": "m"}) == []


def test_headers_say_the_state_of_each_step(bpy_script, tmp_path):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.jobs.queue import queue
from fieldwork.panels import states
settings = bpy.context.scene.fieldwork
folder = Path(project)
names = ("capture", "poses", "classes", "train", "render", "mesh", "measure", "export")
def look():
    return {name: list(getattr(states, name)(bpy.context)) for name in names}
def write(name, value):
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(value))
empty = look()
images = [{"name": str(n), "status": "ok" if n else "unregistered"} for n in range(3)]
images.append({"name": "d", "status": "rejected"})
write("project.json", {
    "format": "fieldwork-project", "version": 2, "uuid": "a" * 32, "images": images,
    "provenance": [{"verb": "mesh", "result": {"faces": 54368}}],
    "classes": [{"id": 1, "name": "stone", "color": [0, 0, 0], "priority": 1.0}],
})
write("poses/poses.json", {})
write("runs/main/field.safetensors", "")
write("runs/main/metrics.json", {"train": {"psnr": 30}, "test": {"psnr": 27.34, "miou": 0.9}})
write("exports/main/measures.json", {"classes": [{"name": "stone"}]})
settings.project = project
rendered = queue.make("render", {"project": project})
rendered.state, rendered.result = "done", {"frames": ["a.png", "a.exr"]}
written = queue.make("blend", {"project": project})
written.state, written.result = "done", {"file": "/out/museum.blend"}
queue.finished = [rendered, written]
full = look()
queue.running = queue.make("train", {"project": project})
queue.running.state, queue.running.fraction = "running", 0.34
write("exports/main/measures.json", {"whole": {"area": 1}, "classes": []})
answer({"empty": empty, "full": full, "training": look()["train"], "no classes": look()["measure"], "locked": states.training(bpy.context)})
""",
        project=tmp_path / "project",
    )
    assert all(not done and not text for done, text in facts["empty"].values())
    assert facts["full"] == {
        "capture": [True, "3 of 4 photos"],
        "poses": [True, "2/3"],
        "classes": [True, "1"],
        "train": [True, "27.3 dB"],
        "render": [True, "1 image"],
        "mesh": [True, "54 k faces"],
        "measure": [True, "1 class"],
        "export": [True, "museum.blend"],
    }
    assert facts["training"] == [False, "34%"]
    assert facts["no classes"] == [True, ""]
    assert facts["locked"]


def test_one_button_takes_known_photos_all_the_way(bpy_script, tmp_path):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.jobs.queue import queue
from fieldwork.panels.main import offers_reconstruct
settings = bpy.context.scene.fieldwork
seen, asked = [], []
class Link:
    alive = True
    def run_blocking(self, verb, params, take=None):
        asked.append([verb, params])
        return {}
queue._engine = Link
def look():
    seen.append(offers_reconstruct(bpy.context))
def provenance(*steps):
    Path(project).mkdir(exist_ok=True)
    value = {"format": "fieldwork-project", "version": 2, "uuid": "a" * 32, "provenance": steps}
    Path(project, "part").write_text(json.dumps(value))
    os.replace(Path(project, "part"), Path(project, "project.json"))
look()
settings.photos = "/photos"
look()
settings.project = project
look()
settings.photos = ""
read = {"verb": "new", "settings": {"photos": "/first", "labels": "/labels", "mask_mode": "empty"}}
provenance(read)
look()
bpy.ops.fieldwork.reconstruct()
provenance(read, {"verb": "mesh", "result": {"faces": 8}})
look()
provenance({"verb": "import", "settings": {"dataset": "/set"}})
settings.photos = "/photos"
look()
verb, params = asked[0]
names = ("photos", "labels", "masks", "mask_mode", "out")
settings.project = project + "2"
bpy.ops.fieldwork.reconstruct()
settings.mask_mode = "ignore"
bpy.ops.fieldwork.reconstruct()
modes = [given.get("mask_mode") for asked_verb, given in asked if asked_verb == "reconstruct"][1:]
answer({"seen": seen, "verb": verb, "params": {name: params.get(name) for name in names}, "modes": modes})
""",
        project=tmp_path / "project",
    )
    # Nothing known; no project; both; a project that was opened; its mesh is there; its cameras came with it.
    assert facts["seen"] == [False, False, True, True, False, False]
    assert facts["verb"] == "reconstruct"
    assert facts["params"] == {
        "photos": "/first",
        "labels": "/labels",
        "masks": None,
        "mask_mode": "empty",
        "out": str(tmp_path / "project"),
    }
    assert facts["modes"] == [None, "ignore"]  # "Automatic" leaves it to the engine


def test_recent_projects_are_remembered_and_opened(bpy_script, tmp_path):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon import machine
from fieldwork.addon.project import recent
machine.user_folder = lambda *parts: Path(user)
Path(user).mkdir()
before = [str(p) for p in recent.recent()]
for name in ("a", "b", "gone", "a"):
    folder = Path(user, name)
    folder.mkdir(exist_ok=True)
    value = {"format": "fieldwork-project", "version": 2, "uuid": "a" * 32}
    (folder / "project.json").write_text(json.dumps(value))
    recent.remember(folder)
(Path(user) / "gone" / "project.json").unlink()
bpy.ops.fieldwork.open_recent(folder=str(Path(user, "b")))
try:
    bpy.ops.fieldwork.open_recent(folder=str(Path(user, "gone")))
except RuntimeError as error:
    refused = str(error)
after = [path.name for path in recent.recent()]
answer({"before": before, "after": after, "open": bpy.context.scene.fieldwork.project, "refused": refused})
""",
        user=tmp_path / "user",
    )
    assert facts["before"] == []
    assert facts["after"] == ["a", "b"]
    assert facts["open"] == str(tmp_path / "user" / "b")
    assert "There is no project in" in facts["refused"]


def test_no_limit_of_faces_reads_all(bpy_script):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
settings = bpy.context.scene.fieldwork
seen = [[settings.all_faces, settings.faces]]
for keep in (True, False):
    settings.all_faces = keep
    seen.append([settings.all_faces, settings.faces])
answer(seen)
"""
    )
    assert facts == [[False, 200_000], [True, 0], [False, 200_000]]


def test_device_and_rough_time_are_known_before_the_first_training(tmp_path, monkeypatch):
    from fieldwork.addon import machine
    from fieldwork.addon.jobs import computer

    monkeypatch.setattr(machine, "user_folder", lambda *parts: tmp_path)
    assert computer.known() == {}
    computer.remember({"device": "cpu", "cores": 4})
    assert computer.title(computer.known()) == "CPU, 4 cores"
    assert computer.rough_seconds(computer.known(), "standard", 1000) == pytest.approx(115)
    assert computer.rough_seconds(computer.known(), "draft", 1000) == pytest.approx(90)
    assert computer.rough_seconds({}, "standard") is None
    card = {"device": "cuda", "device_name": "NVIDIA H100", "gpu_memory_gb": 79.6}
    assert computer.title(card) == "NVIDIA H100, 80 GB"
    assert computer.rough_seconds(card, "standard") is None


def test_measured_line_knows_its_ends_and_length(bpy_script):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.scene import measured_line
scene = bpy.context.scene
seen = [measured_line.length(scene)]
scene.fieldwork.point_a = (1, 0, 0)
seen.append(sorted(measured_line.ends(scene.fieldwork)))
scene.fieldwork.point_b = (1, 3, 4)
seen.append(measured_line.length(scene))
scene.unit_settings.scale_length = 0.01
seen.append(measured_line.length(scene))
answer(seen)
"""
    )
    assert facts == [None, ["A"], pytest.approx(5.0), pytest.approx(0.05)]
