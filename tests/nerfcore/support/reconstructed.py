"""A project that `reconstruct` made of photos of a ball, for tests of what a second call does again."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.mesh.build import Built
from fieldwork.nerfcore.mesh.region import Region
from fieldwork.nerfcore.params import PosesParams, ReconstructParams
from fieldwork.nerfcore.poses.inputs import posed, posing_inputs
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import PosedImage, Poses
from fieldwork.nerfcore.project.store import edit_project, save_poses
from fieldwork.nerfcore.workflows import stages
from fieldwork.nerfcore.workflows.reconstruct import reconstruct
from fieldwork.tests.nerfcore.support.ball import SMALL, camera_poses, draw
from PIL import Image

SIDE, VIEWS = 72, 10
CAMERA = Camera(width=SIDE, height=SIDE, fx=1.375 * SIDE, fy=1.375 * SIDE, cx=SIDE / 2, cy=SIDE / 2)
STAGES = ["new", "poses", "train", "mesh", "evaluate", "render"]
SETTINGS = {**SMALL, "train.steps": "8"}


def known_poses(params: PosesParams, report: Reporter) -> dict[str, Any]:
    """Instead of structure from motion: the poses the photos were drawn with."""
    folder = Path(params.project)
    true = camera_poses(VIEWS + 2)
    with edit_project(folder) as project:
        records = [record for record in project.images if record.status != "rejected"]
        images = [PosedImage(name=r.name, camera=0, camera_to_world=true[int(r.name[1:])].tolist()) for r in records]
        save_poses(folder, Poses(source="sfm", cameras=[CAMERA], images=images), Points.empty())
        result = {"registered": len(images), "total": len(images)}
        project.record("poses", params.model_dump(mode="json"), result, posing_inputs(folder, project, params))
    return result


def take_photos(folder: Path, count: int = VIEWS) -> None:
    (folder / "labels").mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(camera_poses(VIEWS + 2)[:count]):
        rgba, label, _ = draw(CAMERA, pose)
        Image.fromarray(rgba).save(folder / f"p{i:02d}.png")
        Image.fromarray(label).save(folder / "labels" / f"p{i:02d}.png")


@pytest.fixture(scope="session")
def reconstructed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos/ and the project p/ that was reconstructed from them."""
    place = tmp_path_factory.mktemp("reuse")
    take_photos(place / "photos")
    with pytest.MonkeyPatch.context() as patch:
        fake(patch)
        result = call(place)
    assert result["reused"] == []
    assert result["redone"] == {}
    return place


def fake(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("fieldwork.nerfcore.mesh.verb.build", triangle)
    patch.setitem(stages.STAGES, "poses", lambda: stages.Stage(known_poses, posed))
    # Small enough for a test (a texture of 4096 takes 20 s); what is asked of each stage stays the same from call to call.
    small = {
        "mesh": {"resolution": 24, "texture": 64},
        "render": {"orbit": 1, "size": (16, 16), "passes": ["rgb"]},
    }
    for verb, values in small.items():
        patch.setitem(stages.STAGES, verb, smaller(stages.STAGES[verb], values))


def triangle(*_: Any) -> Built:
    """Instead of a surface, for which a field would have to be trained for longer."""
    corners, face = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    region = Region(np.zeros(3), np.ones(3), 0.1)
    return Built(corners, face, corners, np.full((3, 3), 128, np.uint8), region, (corners, face))


def smaller(stage: Callable[[], stages.Stage], values: dict[str, Any]) -> Callable[[], stages.Stage]:
    def changed(function: Callable) -> Callable:
        return lambda params, *rest: function(params.model_copy(update=values), *rest)

    return lambda: stages.Stage(*map(changed, stage()))


def call(place: Path, **values: Any) -> dict[str, Any]:
    values = {"photos": place / "photos", "out": place / "p", "preset": "draft", "set": SETTINGS, **values}
    return reconstruct(ReconstructParams.model_validate(values), values.pop("report", None) or Reporter())


@pytest.fixture
def place(reconstructed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    fake(monkeypatch)
    copy = Path(shutil.copytree(reconstructed, tmp_path / "place"))
    # A copy keeps the times of the photos; what the project remembers of where they lay is another place.
    path = copy / "p" / "project.json"
    path.write_text(path.read_text().replace(str(reconstructed), str(copy)))
    return copy


def redone(result: dict[str, Any]) -> list[str]:
    """The stages that were done, of which `redone` says why where they had been done before."""
    done = [verb for verb in STAGES if verb not in result["reused"]]
    assert set(result["redone"]) <= set(done)
    return done


class Stopping(Reporter):
    def __init__(self) -> None:
        super().__init__()
        self.running = False

    def stage(self, name: str) -> None:
        self.running = name == "Training"

    def check(self) -> None:
        if self.running:
            self.cancel()
        super().check()
