"""A run trained anew takes the place of the old one at once or not at all; a training goes on only with its own."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fieldwork.nerfcore.errors import Cancelled, DiskError, InputError, ProjectError
from fieldwork.nerfcore.evaluate.documentation import sections
from fieldwork.nerfcore.evaluate.verb import Comparison, evaluate, evaluated
from fieldwork.nerfcore.params import EvaluateParams, RegionParams, RenderParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project import runs
from fieldwork.nerfcore.project.edit import region
from fieldwork.nerfcore.project.runs import TrainingFolder, checkpoint_id, fresh_folder, run_folder, settle, swap_in
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.render.run import load_info, load_trained, save_info
from fieldwork.nerfcore.render.verb import render, rendered
from fieldwork.nerfcore.train.reuse import finished, held_out, unfinished
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from pydantic import ValidationError


class Killed(BaseException):
    """The process ends here."""


def pretend(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True)
    (folder / runs.CHECKPOINT).write_text(text)
    (folder / runs.METRICS).write_text("{}")
    return folder


def content(project: Path) -> str:
    return (run_folder(project, "main") / runs.CHECKPOINT).read_text()


def test_swap(tmp_path: Path) -> None:
    pretend(run_folder(tmp_path, "main"), "old")
    pretend(fresh_folder(tmp_path, "main"), "new")
    swap_in(tmp_path, "main")
    assert content(tmp_path) == "new"
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["main"]


@pytest.mark.parametrize("moment", range(5))
def test_killed_in_the_middle_of_the_exchange(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int) -> None:
    """Whichever step it comes to, one of the two runs is there afterwards, whole."""
    pretend(run_folder(tmp_path, "main"), "old")
    pretend(fresh_folder(tmp_path, "main"), "new")
    calls = []

    def dying(real):
        def call(*arguments, **named):
            calls.append(real.__name__)
            if len(calls) > moment:
                raise Killed
            return real(*arguments, **named)

        return call

    with monkeypatch.context() as patch:
        patch.setattr(runs.os, "rename", dying(os.rename))
        patch.setattr(runs.shutil, "rmtree", dying(shutil.rmtree))
        try:
            swap_in(tmp_path, "main")
        except Killed:
            assert moment < 3
    settle(tmp_path, "main")
    assert content(tmp_path) == ("old" if moment == 0 else "new")
    assert (run_folder(tmp_path, "main") / runs.METRICS).is_file()
    assert not (tmp_path / "runs" / runs.OLD / "main").exists()
    assert fresh_folder(tmp_path, "main").exists() == (moment == 0)


def test_a_half_trained_run_does_not_take_the_place(tmp_path: Path) -> None:
    """Killed after the old run was moved away, with a new one that has no checkpoint: the old one comes back."""
    pretend(tmp_path / "runs" / runs.OLD / "main", "old")
    fresh_folder(tmp_path, "main").mkdir(parents=True)
    settle(tmp_path, "main")
    assert content(tmp_path) == "old"


def test_a_run_that_is_in_use_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows a folder with an open file cannot be moved."""
    pretend(run_folder(tmp_path, "main"), "old")
    fresh = pretend(fresh_folder(tmp_path, "main"), "new")
    real = os.rename

    def refuse(source, target):
        if Path(source) == fresh:
            raise PermissionError(13, "in use")
        real(source, target)

    monkeypatch.setattr(runs.os, "rename", refuse)
    with pytest.raises(DiskError, match="main"):
        swap_in(tmp_path, "main")
    assert content(tmp_path) == "old"
    assert (fresh / runs.CHECKPOINT).read_text() == "new"


def test_where_a_training_writes(tmp_path: Path) -> None:
    first = TrainingFolder.anew(tmp_path, "main")
    assert not first.beside
    pretend(fresh_folder(tmp_path, "other"), "x")
    (first.folder / runs.CHECKPOINT).write_text("old")
    second = TrainingFolder.anew(tmp_path, "main")
    assert second.beside
    (second.folder / runs.EVENTS).write_text("half")
    again = TrainingFolder.anew(tmp_path, "main")
    assert list(again.folder.iterdir()) == []
    resumed = TrainingFolder.to_resume(tmp_path, "main")
    assert resumed is not None
    assert resumed.folder == first.folder
    assert TrainingFolder.to_resume(tmp_path, "none") is None


@pytest.mark.parametrize("name", [".new", "..", ".", "", "a/b"])
def test_names_of_runs(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValidationError):
        TrainParams(project=tmp_path, run=name)


class Noting(Reporter):
    """Keeps the notes."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)


class Stopping(Reporter):
    """Cancels once training has done a step, or only watches."""

    def __init__(self, stop: bool = True) -> None:
        super().__init__()
        self.stop, self.running = stop, False
        self.previews: list[tuple[str, bool]] = []

    def stage(self, name: str) -> None:
        self.running = name == "Training"

    def check(self) -> None:
        if self.running and self.stop:
            self.cancel()
        super().check()

    def event(self, kind: str, **data) -> None:
        if kind == "preview":
            self.previews.append((data["path"], Path(data["path"]).is_file()))


def params(project: Path, **values) -> TrainParams:
    settings = {**SMALL, **values.pop("set", {})}
    return TrainParams.model_validate({"project": project, "preset": "draft", "steps": 12, "set": settings} | values)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    project = ball_project(tmp_path_factory.mktemp("runs") / "ball")
    train(params(project), Reporter())
    evaluate(EvaluateParams(project=project), Reporter())
    return project


@pytest.fixture
def project(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "ball"))


def test_a_cancelled_retraining_leaves_the_old_field(project: Path) -> None:
    folder = run_folder(project, "main")
    before = {path.name: path.read_bytes() for path in folder.glob("*.*")}
    with pytest.raises(Cancelled):
        train(params(project, steps=50), Stopping())
    assert {path.name: path.read_bytes() for path in folder.glob("*.*")} == before
    assert (folder / "evaluation").is_dir()
    assert load_trained(project, "main").state["steps"] == 12
    # And what was begun can go on.
    result = train(params(project, steps=20, resume=True), Reporter())
    assert result["steps"] == 20
    assert load_trained(project, "main").state["steps"] == 20
    assert not (folder / "evaluation").exists()
    assert not (project / "runs" / runs.NEW).exists()


def test_a_failed_retraining_leaves_the_old_field(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_):
        raise OSError(28, "full")

    before = checkpoint_id(project, "main")
    with monkeypatch.context() as patch:
        patch.setattr("fieldwork.nerfcore.train.verb.save_checkpoint", fail)
        with pytest.raises(OSError, match="full"):
            train(params(project), Reporter())
    assert checkpoint_id(project, "main") == before
    assert load_trained(project, "main").state["steps"] == 12


def test_a_checkpoint_worth_keeping_takes_over_while_training_goes_on(project: Path) -> None:
    report = Stopping(stop=False)
    often = {"train.checkpoint_every": "0.05", "train.preview_every": "0.01"}
    train(params(project, steps=40, set=often), report)
    assert report.previews
    assert all(there for _, there in report.previews)
    assert report.previews[-1][0] == str(run_folder(project, "main") / "preview.png")
    events = (run_folder(project, "main") / runs.EVENTS).read_text().splitlines()
    assert json.loads(events[-1])["step"] == 40
    assert "test" not in runs.read_metrics(run_folder(project, "main"))


def test_each_field_has_an_identity(project: Path) -> None:
    first = checkpoint_id(project, "main")
    assert first
    train(params(project, resume=True), Reporter())  # nothing is left to do
    assert checkpoint_id(project, "main") == first
    train(params(project, steps=14, resume=True), Reporter())
    second = checkpoint_id(project, "main")
    train(params(project, steps=14), Reporter())
    assert len({first, second, checkpoint_id(project, "main")}) == 3


def test_an_evaluation_is_of_the_field_that_was_measured(project: Path) -> None:
    asked = EvaluateParams(project=project)
    assert evaluated(asked).result is not None
    train(params(project, steps=14, resume=True), Reporter())
    assert evaluated(asked).reason == "changed: trained field"


def test_a_run_that_is_not_there_does_not_go_on(project: Path, tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match=r"has no run “mian”\. Its runs: main\."):
        train(params(project, run="mian", resume=True), Reporter())
    assert not run_folder(project, "mian").exists()
    # One that was stopped before its first checkpoint has nothing to go on from, and the first of a project neither.
    run_folder(project, "begun").mkdir()
    report = Noting()
    assert train(params(project, run="begun", steps=2, resume=True), report)["steps"] == 2
    assert any("“begun” has no checkpoint to go on from" in note for note in report.notes)
    first = ball_project(tmp_path / "first", views=3, side=16)
    assert train(params(first, steps=2, resume=True), Reporter())["steps"] == 2


def test_steps_that_come_again_after_a_kill_are_told_once(project: Path) -> None:
    path = run_folder(project, "main") / runs.EVENTS
    whole = path.read_text()
    late = json.dumps({"step": 15, "seconds": 9.0, "loss": 1.0, "psnr": 1.0, "rays_per_second": 1})
    path.write_text(f'{whole}{late}\n{{"step": 17, "sec')  # told after the last checkpoint, of step 12
    train(params(project, steps=20, resume=True), Reporter())
    assert path.read_text().startswith(whole)
    steps = [event["step"] for event in runs.read_events(run_folder(project, "main"))]
    assert steps == sorted(set(steps))
    assert 15 not in steps[: whole.count("\n") + 1]
    assert steps[-1] == 20


def test_a_run_of_another_project_does_not_go_on(project: Path, tmp_path: Path) -> None:
    other = ball_project(tmp_path / "other")
    shutil.copytree(project / "runs", other / "runs")
    with pytest.raises(ProjectError, match=r"trained in another project.*without --resume"):
        train(params(other, resume=True), Reporter())


def test_a_run_of_another_project_is_neither_used_again_nor_gone_on_with(project: Path) -> None:
    asked, metrics = params(project), run_folder(project, "main") / runs.METRICS
    assert finished(asked).result is not None
    here = load_project(project)
    save_project(project, here.model_copy(update={"uuid": "0" * 32}))
    assert finished(asked).reason == "trained in another project"
    metrics.unlink()  # as a training that was stopped leaves it
    assert not unfinished(asked)
    save_project(project, here)
    assert unfinished(asked)


def test_photos_of_training_that_are_evaluated_say_nothing_of_the_training(project: Path) -> None:
    place, asked = run_folder(project, "main"), EvaluateParams(project=project, split="train", time_limit=1)
    trained = runs.read_metrics(place)["train"]
    found = evaluate(asked, Reporter())
    assert runs.read_metrics(place)["train"] == trained, "by whose PSNR held-out photos are judged"
    assert runs.read_metrics(place)["train_photos"]["psnr"] == found["psnr"]
    (place / runs.METRICS).unlink()  # as a training that was stopped leaves it
    evaluate(asked, Reporter())
    assert unfinished(params(project)), "it goes on all the same"


def test_pictures_that_another_render_has_overwritten_are_rendered_again(project: Path, tmp_path: Path) -> None:
    first, second = (
        RenderParams(project=project, out=tmp_path / "out", orbit=2, size=(8, 8), passes=passes)
        for passes in (["rgb"], ["rgb", "depth"])
    )
    part = first.model_copy(update={"frame_range": (0, 0)})

    class Stops(Reporter):
        def progress(self, fraction: float, message: str = "") -> None:
            if message == "orbit_0001":
                raise Cancelled

    render(part, Reporter())
    render(first, Reporter())
    assert None not in (rendered(first).result, rendered(part).result)
    with pytest.raises(Cancelled):
        render(second, Stops())  # its first picture is there
    assert rendered(first).result is None
    assert rendered(part).result is None
    said = Noting()
    render(first, said)
    assert said.notes == [], "no frame is taken for one that was there already"
    elsewhere = first.model_copy(update={"orbit": None, "test": True})
    render(elsewhere, Reporter())
    render(part, Reporter())
    assert rendered(part).result is not None
    render(elsewhere, Reporter())
    assert rendered(part).result is not None, "its picture is not overwritten"


def test_the_time_of_an_evaluation_is_that_of_all_of_it(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]

    def now() -> float:
        clock[0] += 1e-6
        return clock[0]

    monkeypatch.setattr("fieldwork.nerfcore.evaluate.verb.time", SimpleNamespace(perf_counter=now))
    add = Comparison.add

    def preparing(*arguments: Any, **named: Any) -> Any:
        clock[0] += 10.0
        return load_trained(*arguments, **named)

    def slow(*arguments: Any) -> None:
        clock[0] += 2.0
        add(*arguments)

    monkeypatch.setattr("fieldwork.nerfcore.evaluate.verb.load_trained", preparing)
    monkeypatch.setattr(Comparison, "add", slow)
    for seconds, compared in ((5.0, 1), (14.5, 2), (16.5, 3)):
        asked = EvaluateParams(project=project, split="train", time_limit=seconds)
        clock[0] = 0.0
        assert len(evaluate(asked, Reporter())["per_image"]) == compared


def test_a_field_that_is_not_the_one_its_training_ended_with_is_not_finished(project: Path) -> None:
    asked, checkpoint = params(project), run_folder(project, "main") / runs.CHECKPOINT
    assert finished(asked).result is not None
    ended = checkpoint.read_bytes()
    train(params(project, run="second"), Reporter())
    other = (run_folder(project, "second") / runs.CHECKPOINT).read_bytes()
    steps = runs.checkpoint_state(checkpoint)["steps"]
    earlier = ended.replace(f'\\"steps\\": {steps},'.encode(), f'\\"steps\\": {steps - 1:{len(str(steps))}},'.encode())
    assert earlier != ended
    for contents in (b"cut off", other, earlier):
        checkpoint.write_bytes(contents)
        assert "is not what the training ended with" in finished(asked).reason
    checkpoint.write_bytes(ended)
    assert finished(asked).result is not None


def test_a_checkpoint_of_another_training_does_not_go_on(project: Path) -> None:
    train(params(project, run="second"), Reporter())
    shutil.copy(run_folder(project, "second") / runs.CHECKPOINT, run_folder(project, "main"))
    with pytest.raises(ProjectError, match="is not of the training"):
        train(params(project, steps=20, resume=True), Reporter())


@pytest.mark.parametrize("what", ["labels", "photos", "region"])
def test_a_training_does_not_go_on_with_other_inputs(project: Path, what: str) -> None:
    if what == "region":
        region(RegionParams(project=project, bounds=[[-1, -1, -1], [1, 1, 1]]), Reporter())
    else:
        folder = project / {"labels": "labels", "photos": "images"}[what]
        shutil.copy(folder / "03.png", folder / "05.png")
    with pytest.raises(ProjectError, match=rf"cannot go on: .*changed: {what}\."):
        train(params(project, steps=20, resume=True), Reporter())


def test_a_resumed_run_says_that_it_keeps_its_settings(project: Path) -> None:
    report = Reporter()
    train(params(project, steps=14, resume=True, preset="standard", set={"train.grid_rate": "0.5"}), report)
    assert any("goes on with the settings it began with" in warning for warning in report.warnings)
    step = load_project(project).provenance[-1]
    assert step.settings["config"]["train"]["grid_rate"] != 0.5
    assert step.settings["preset"] == "draft"


def test_a_resumed_run_takes_only_the_rendering_that_is_named(project: Path) -> None:
    before = load_info(project, "main").config.render
    other = {"render.samples": str(before.samples + 8)}
    report = Reporter()
    train(params(project, steps=14, resume=True, preset="standard", set=other), report)
    assert load_info(project, "main").config.render == before.model_copy(update={"samples": before.samples + 8})
    assert not any("goes on with the settings" in warning for warning in report.warnings)
    train(params(project, steps=16, resume=True, preset="high", holdout=5), report)
    assert any(warning.endswith("now: preset, holdout.") for warning in report.warnings)


def test_photos_of_another_exposure_are_other_inputs(project: Path) -> None:
    file = project / "poses" / "poses.json"
    poses = json.loads(file.read_text(encoding="utf-8"))
    for image in poses["images"]:
        image["gain"] = [1.3, 1.1, 0.8]
    file.write_text(json.dumps(poses), encoding="utf-8")
    with pytest.raises(ProjectError, match=r"cannot go on: .*changed: exposure\."):
        train(params(project, steps=20, resume=True), Reporter())
    info = load_info(project, "main")
    del info.origin.inputs["exposure"]  # as an earlier version noted it
    save_info(run_folder(project, "main"), info)
    train(params(project, steps=14, resume=True), Reporter())


def test_a_run_whose_events_were_cut_off_is_finished(project: Path) -> None:
    events = run_folder(project, "main") / runs.EVENTS
    whole = events.read_bytes()
    assert whole.count(b"\n") >= 1
    events.write_bytes(whole + b'{"step": 12, "sec')
    assert len(runs.read_events(events.parent)) == whole.count(b"\n")
    assert train(params(project, steps=14, resume=True), Reporter())["steps"] == 14
    assert events.read_bytes().startswith(whole)
    assert all(json.loads(line)["step"] for line in events.read_text().splitlines())


def test_lines_of_events_that_cannot_be_read_are_left_out(tmp_path: Path) -> None:
    """As versions left them that appended to a line which was cut off."""
    (tmp_path / runs.EVENTS).write_bytes(b'{"step": 1}\n{"step": 2, "se{"step": 3}\n\xff{}\n7\n{"step": 4}\n')
    assert [event["step"] for event in runs.read_events(tmp_path)] == [1, 4]


def test_runs_of_before_go_on(project: Path) -> None:
    """config.json and checkpoints without an origin, as version 0.1 wrote them."""
    path = run_folder(project, "main") / "config.json"
    value = json.loads(path.read_text())
    del value["origin"], value["holdout"]
    path.write_text(json.dumps(value))
    checkpoint = run_folder(project, "main") / runs.CHECKPOINT
    block = checkpoint.read_bytes()
    size = int.from_bytes(block[:8], "little")
    header = json.loads(block[8 : 8 + size])
    state = json.loads(header["__metadata__"]["fieldwork"])
    del state["training"]
    header["__metadata__"]["fieldwork"] = json.dumps(state)
    text = json.dumps(header).encode()
    checkpoint.write_bytes(len(text).to_bytes(8, "little") + text + block[8 + size :])
    assert train(params(project, steps=14, resume=True), Reporter())["steps"] == 14
    assert checkpoint_id(project, "main")
    assert load_info(project, "main").holdout == 8


def test_holdout(project: Path) -> None:
    every = [f"{i:02d}" for i in range(16)]
    assert load_info(project, "main").images == [name for name in every if name not in ("00", "08")]
    train(params(project, run="third", holdout=3), Reporter())
    assert load_info(project, "third").images == [name for i, name in enumerate(every) if i % 3]
    assert evaluate(EvaluateParams(project=project, run="third"), Reporter())["images"] == 6
    train(params(project, run="all", holdout=0), Reporter())
    assert load_info(project, "all").images == every
    with pytest.raises(InputError, match="no held-out photos: all were trained on"):
        evaluate(EvaluateParams(project=project, run="all"), Reporter())
    # Resuming keeps the split of the run.
    train(params(project, run="all", steps=14, resume=True), Reporter())
    assert load_info(project, "all").images == every


def hold_out(project: Path, *names: str) -> None:
    """Let the project hold out these photos, as photos that come or go may do."""
    value = load_project(project)
    for image in value.images:
        image.split = "test" if image.name in names else "train"
    save_project(project, value)


def test_photos_that_were_trained_on_are_not_held_out(project: Path, tmp_path: Path) -> None:
    hold_out(project, "00", "05")  # the run has held out 00 and 08
    for verb, values in ((evaluate, EvaluateParams(project=project)), (render, picture_of(project, tmp_path))):
        report = Reporter()
        result = verb(values, report)
        assert result.get("images", len({Path(frame).stem for frame in result.get("frames", [])})) == 1
        (warning,) = [text for text in report.warnings if "trained on" in text]
        assert "05" in warning
        assert "00" not in warning
    assert evaluated(EvaluateParams(project=project)).result is not None
    (cameras,) = (section for section in sections(project, "main", {}) if section.title == "Cameras")
    assert [row[0] for row in cameras.rows if "held out" in row] == ["00"]
    hold_out(project, "05")
    for verb, values in ((evaluate, EvaluateParams(project=project)), (render, picture_of(project, tmp_path))):
        with pytest.raises(InputError, match="trained on all 1 photos"):
            verb(values, Reporter())
    assert held_out(project, "main") == 0


def picture_of(project: Path, out: Path) -> RenderParams:
    return RenderParams(project=project, out=out / "renders", test=True, passes=["rgb"], size=(8, 8))


def test_hold_out_nothing_or_something(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="would hold out every photo"):
        TrainParams(project=tmp_path, holdout=1)
    with pytest.raises(ValidationError):
        TrainParams(project=tmp_path, holdout=-1)


def test_a_moved_project_works(project: Path, tmp_path: Path) -> None:
    moved = project.rename(tmp_path / "moved")
    assert train(params(moved, steps=14, resume=True), Reporter())["steps"] == 14
    assert evaluate(EvaluateParams(project=moved), Reporter())["images"] == 2
    with pytest.raises(ProjectError, match=r"the folder is not there.*Connect the disk"):
        train(params(project), Reporter())
