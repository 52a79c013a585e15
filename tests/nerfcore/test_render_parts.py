"""A render in parts, as several programs make it at the same time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.geometry.cameras import flip_camera_axes
from fieldwork.nerfcore.params import ReconstructParams, RenderParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.lock import lockable, project_lock
from fieldwork.nerfcore.render import verb as module
from fieldwork.nerfcore.render.pictures import pass_name
from fieldwork.nerfcore.render.verb import chosen_cameras, render, rendered
from fieldwork.nerfcore.workflows import stage_task
from fieldwork.nerfcore.workflows.campaign import capture_tasks, frame_ranges, plan
from fieldwork.nerfcore.workflows.captures import Capture
from fieldwork.nerfcore.workflows.reconstruct import stages_of
from fieldwork.tests.nerfcore.support.reconstructed import SETTINGS, place, reconstructed
from PIL import Image
from pydantic import ValidationError

__all__ = ["place", "reconstructed"]


def asked(place: Path, out: Path, frames: tuple[int, int] | None = None, **more) -> RenderParams:
    values = {"project": place / "p", "out": out, "orbit": 5, "size": (24, 16), "passes": ["rgb", "depth"], **more}
    return RenderParams(**values, frame_range=frames)


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {path.name: np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the frames that were rendered."""
    names, write = [], module.write_frame
    monkeypatch.setattr(module, "write_frame", lambda out, name, *rest: names.append(name) or write(out, name, *rest))
    return names


def test_parts_make_what_one_program_makes(place, tmp_path, drawn):
    render(asked(place, tmp_path / "whole"), Reporter())
    drawn.clear()
    # While another program holds the project.
    assert lockable(asked(place, tmp_path, (0, 1))) is None
    with project_lock(place / "p", "train"):
        for frames in ((0, 1), (2, 9)):
            render(asked(place, tmp_path / "parts", frames), Reporter())
    assert drawn == [f"orbit_{i:04d}" for i in range(5)]
    assert rendered(asked(place, tmp_path / "parts")).result is None, "parts are not the whole"
    assert rendered(asked(place, tmp_path / "parts", (0, 1))).result is not None
    drawn.clear()
    result = render(asked(place, tmp_path / "parts"), Reporter())
    assert drawn == [], "what parts have made is kept"
    assert len(result["frames"]) == 15
    assert rendered(asked(place, tmp_path / "parts")).result is not None
    whole, parts = pictures(tmp_path / "whole"), pictures(tmp_path / "parts")
    assert list(whole) == list(parts)
    assert len(whole) == 10
    for name in whole:
        assert np.array_equal(whole[name], parts[name]), name


def test_a_picture_that_is_gone_and_other_settings_are_rendered_again(place, tmp_path, drawn):
    render(asked(place, tmp_path, (0, 3)), Reporter())
    (tmp_path / "orbit_0001_depth.png").unlink()
    drawn.clear()
    render(asked(place, tmp_path), Reporter())
    assert drawn == ["orbit_0001", "orbit_0004"]
    drawn.clear()
    render(asked(place, tmp_path, size=(16, 16)), Reporter())
    assert len(drawn) == 5


def test_frames_called_like_passes_of_others_keep_their_pictures(place, tmp_path):
    cameras = cameras_of(place, tmp_path, ["a", "a_depth"])
    result = render(asked(place, tmp_path / "out", orbit=None, size=None, camera=cameras), Reporter())
    names = [Path(path).name for path in result["frames"]]
    assert names == ["a.png", "a__depth.png", "a.exr", "a_depth.png", "a_depth_depth.png", "a_depth.exr"]
    assert all(Path(path).is_file() for path in result["frames"])
    read = pictures(tmp_path / "out")
    assert not np.array_equal(read["a_depth.png"], read["a__depth.png"])
    assert (tmp_path / "out" / "a__depth.json").is_file()


def test_names_of_passes_are_no_others():
    frames = {"a", "a_depth", "a_", "b"}
    made = [pass_name(frame, kind, frames) for frame in sorted(frames) for kind in ("rgb", "depth")]
    assert len(set(made)) == len(made)
    assert pass_name("b", "depth", frames) == "b_depth"
    assert pass_name("B", "rgb", {"b"}) == "B"
    assert pass_name("A", "depth", {"a", "a_depth"}) == "A__depth", "on Windows and macOS capitals are the same"


def cameras_of(place: Path, folder: Path, names: list[str]) -> Path:
    """A file of cameras that see what the photos do."""
    (_, camera, pose), *_ = chosen_cameras(asked(place, folder), load_scene(place / "p", 8))
    frame = {
        "w": 24,
        "h": 16,
        "fl_x": camera.fx / camera.width * 24,
        "transform_matrix": flip_camera_axes(pose).tolist(),
    }
    path = folder / "cameras.json"
    path.write_text(json.dumps({"frames": [{**frame, "file_path": name} for name in names]}))
    return path


def test_wrong_ranges_are_told(place, tmp_path):
    with pytest.raises(SettingError, match="has the frames 0 to 4"):
        render(asked(place, tmp_path, (5, 6)), Reporter())
    for frames in ((3, 2), (-1, 2)):
        with pytest.raises(ValidationError, match="no range of frames"):
            asked(place, tmp_path, frames)
    with pytest.raises(ValidationError, match="at least 1 item"):
        RenderParams(project=place, out=tmp_path, orbit=1, passes=[])


def test_a_long_render_of_a_campaign_is_spread_over_workers(place, monkeypatch):
    assert frame_ranges(8) == []
    assert frame_ranges(70) == [(0, 31), (32, 63), (64, 69)]
    params = ReconstructParams(photos=place / "photos", out=place / "p", preset="draft", set=SETTINGS, render_count=4)
    tasks = capture_tasks(params, 0, [(0, 1), (2, 3)], {"folder": str(place), "storage": None})
    names = [task.stage for task in tasks]
    *before, first, second, last = names
    assert (first, second, last) == ("render 0-1", "render 2-3", "render")
    assert [*before, "render"] == stages_of(params)
    by_stage = {task.stage: task for task in tasks}
    assert by_stage["render 2-3"].needs == by_stage["render 0-1"].needs == (by_stage[before[-1]].id,)
    assert set(by_stage["render"].needs) == {by_stage["render 0-1"].id, by_stage["render 2-3"].id}
    asked_for = []
    stage = stage_task.STAGES["render"]()

    def run(values, report):
        asked_for.append(values.frame_range)
        return render(values.model_copy(update={"orbit": 4, "size": (16, 16), "passes": ["rgb"]}), report)

    def earlier(values):
        return rendered(values.model_copy(update={"orbit": 4, "size": (16, 16), "passes": ["rgb"]}))

    monkeypatch.setitem(stage_task.STAGES, "render", lambda: stage._replace(run=run, earlier=earlier))
    for _ in range(2):
        made = [stage_task.run_stage(task.values, Reporter()) for task in tasks if task.stage.startswith("render")]
    assert asked_for == [(0, 1), (2, 3), None], "a second time nothing is rendered"
    assert [m["reused"] for m in made] == [True] * 3
    record = json.loads((place / "p/exports/main/renders/render.json").read_text())
    assert len(record["result"]["frames"]) == 8


def test_renders_that_may_become_shorter_are_not_spread(tmp_path):
    values = {"photos": tmp_path / "photos", "out": tmp_path / "p", "render_count": 70}
    for more, storage, count in (({}, None, 3), ({"time_limit": 30}, None, 0), ({}, "s3://bucket/x", 0)):
        tasks = plan([Capture(ReconstructParams(**values, **more))], tmp_path, storage)
        assert sum("frame_range" in task.values for task in tasks) == count
