"""The job type for Flamenco: what its compiler makes of the script, and that the command lines are ours."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore import cli
from fieldwork.nerfcore.params import RenderParams

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "docs/flamenco/fieldwork-render.js"
COMPILER = Path(__file__).parent / "support/flamenco_compiler.js"
NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="node is not installed")


def compiled(folder: Path, **settings: Any) -> dict[str, Any]:
    path = folder / "settings.json"
    values = {"project": "/mnt/vase", "camera": "/mnt/path.json", "render_output_path": "/mnt/out", **settings}
    path.write_text(json.dumps(values))
    found = subprocess.run(
        [str(NODE), str(COMPILER), str(SCRIPT), str(path)], capture_output=True, text=True, timeout=60
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


def asked_of_us(args: list[str], monkeypatch: pytest.MonkeyPatch) -> RenderParams:
    """What `fieldwork` makes of the arguments behind -c fieldwork."""
    assert args[:3] == ["-b", "-c", "fieldwork"]
    seen: list[dict[str, Any]] = []

    def run_command(name: str, values: dict[str, Any], *_: Any) -> int:
        assert name == "render"
        seen.append({key: value for key, value in values.items() if value is not None})
        return 0

    monkeypatch.setattr(cli, "run_command", run_command)
    assert cli.main(args[3:]) == 0
    return RenderParams.model_validate(seen[0])


def test_frames_become_tasks_that_render_all_of_them_once(tmp_path, monkeypatch):
    job = compiled(tmp_path, frames="0-9, 20, 22-25", chunk_size=4)
    assert job["label"] == "Fieldwork Render"
    *parts, whole = job["tasks"]
    frames: list[int] = []
    for task in parts:
        assert task["type"] == "blender"
        for command in task["commands"]:
            assert (command["name"], command["parameters"]["exe"]) == ("exec", "{blender}")
            params = asked_of_us(command["parameters"]["args"], monkeypatch)
            assert (params.project, params.out) == (Path("/mnt/vase"), Path("/mnt/out"))
            assert (params.camera, params.run) == (Path("/mnt/path.json"), "main")
            assert params.passes == ["rgb", "depth", "semantic"]
            first, last = params.frame_range
            frames += range(first, last + 1)
    assert frames == [*range(10), 20, *range(22, 26)]
    assert len(parts) == 4
    assert whole["dependencies"] == [task["name"] for task in parts]
    (command,) = whole["commands"]
    assert asked_of_us(command["parameters"]["args"], monkeypatch).frame_range is None


def test_settings_reach_the_command_line(tmp_path, monkeypatch):
    job = compiled(tmp_path, frames="3", chunk_size=1, baked=True, passes="rgb", run="fine", whole=False)
    (task,) = job["tasks"]
    params = asked_of_us(task["commands"][0]["parameters"]["args"], monkeypatch)
    assert (params.baked, params.passes, params.run, params.frame_range) == (True, ["rgb"], "fine", (3, 3))


def test_every_setting_tells_what_it_is(tmp_path):
    job = compiled(tmp_path, frames="0-3")
    assert all(setting["description"].strip() for setting in job["settings"])
    assert len(job["tasks"]) == 2
