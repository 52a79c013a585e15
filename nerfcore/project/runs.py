"""The folders of runs, and how a new training takes the place of an old one.

runs/<name>/        the field as everybody reads it
runs/.new/<name>/   the same run being trained anew, until it has a checkpoint worth keeping
runs/.old/<name>/   what was there before, for the moment of the exchange
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from ..errors import ProjectError
from ..files import disk_errors, json_lines, write_text
from .fingerprints import digest

CHECKPOINT = "field.safetensors"
INFO = "config.json"
EVENTS = "events.jsonl"
METRICS = "metrics.json"
VOXELS = "voxels"  # folder of the baked field
MESH_RECORD = "mesh.json"  # in exports/<run>: what the mesh beside it was made from
INSTANCES = "instances.json"  # in exports/<run>: what the numbers of instances on the mesh beside it mean
KEPT_INSTANCES = (
    "instances_kept.json"  # in exports/<run>: where these lie, and those known beyond the region of the mesh
)
SCENE_GRAPH = "scene_graph.json"  # in exports/<run>: how the instances of the mesh beside it stand to each other
MEASURES = "measures.json"  # in exports/<run>: areas and volumes of the mesh beside it
RENDER_RECORD = "render.json"  # in a folder of renders: what they were made from
NEW, OLD = ".new", ".old"
ACCEPTED = "accepted"  # in a checkpoint's state: which revision of the marks its classes are from, and when
# Every so many photos one is held out, unless a run says otherwise: as usual since NeRF (Mildenhall et al., 2020).
HOLDOUT = 8


def run_folder(project: Path, run: str) -> Path:
    return Path(project) / "runs" / run


def fresh_folder(project: Path, run: str) -> Path:
    """Where a run is written that is trained anew while the old one is still to be used."""
    return Path(project) / "runs" / NEW / run


def _old_folder(project: Path, run: str) -> Path:
    return Path(project) / "runs" / OLD / run


def known_runs(project: Path) -> list[str]:
    """The names of the runs of a project: what was trained, and what has a mesh."""
    trained = (path.name for path in run_folder(project, "").glob("[!.]*") if path.is_dir())
    meshed = (path.parent.name for path in (Path(project) / "exports").glob(f"*/{MESH_RECORD}"))
    return sorted({*trained, *meshed})


def no_such_run(project: Path, run: str) -> ProjectError:
    """The error that a project has no run of this name, and which ones it has."""
    known = known_runs(project)
    hint = f"Its runs: {', '.join(known)}." if known else "Run `fieldwork train` first."
    return ProjectError(f"{project} has no run “{run}”.", hint)


def is_begun(project: Path, run: str) -> bool:
    """Whether a run was trained, or has begun to be, with or without a checkpoint."""
    return any(folder.is_dir() for folder in (fresh_folder(project, run), run_folder(project, run)))


def has_checkpoint(folder: Path) -> bool:
    return (folder / CHECKPOINT).is_file()


def settle(project: Path, run: str) -> None:
    """Bring an exchange that was cut off to its end: call it before a run is read or written, holding the project."""
    folder, fresh, old = run_folder(project, run), fresh_folder(project, run), _old_folder(project, run)
    if not old.is_dir():
        return
    with disk_errors(folder):
        if not folder.is_dir():
            os.rename(fresh if has_checkpoint(fresh) else old, folder)
        shutil.rmtree(old, ignore_errors=True)


def swap_in(project: Path, run: str) -> None:
    """Put the run that was trained anew in the place of the old one.

    Killed at any moment, it leaves one of the two, whole; `settle` finishes.

    Raises:
        DiskError: a file of the old run is held by another program (Windows); everything is as before.
    """
    folder, fresh, old = run_folder(project, run), fresh_folder(project, run), _old_folder(project, run)
    settle(project, run)
    with disk_errors(folder):
        old.parent.mkdir(parents=True, exist_ok=True)
        if folder.is_dir():
            os.rename(folder, old)
        try:
            os.rename(fresh, folder)
        except OSError:
            if old.is_dir():
                os.rename(old, folder)
            raise
        shutil.rmtree(old, ignore_errors=True)
        for parent in (old.parent, fresh.parent):
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()


class TrainingFolder:
    """Where a training writes: beside the run that is there, until `keep`."""

    def __init__(self, project: Path, run: str, folder: Path) -> None:
        self.project, self.run, self.folder = Path(project), run, folder

    @classmethod
    def anew(cls, project: Path, run: str) -> TrainingFolder:
        """An empty folder for a training from the start. Raises DiskError."""
        settle(project, run)
        folder, fresh = run_folder(project, run), fresh_folder(project, run)
        with disk_errors(folder):
            if fresh.is_dir():
                shutil.rmtree(fresh)
            chosen = fresh if has_checkpoint(folder) else folder
            if chosen.is_dir():
                shutil.rmtree(chosen)
            chosen.mkdir(parents=True)
        return cls(project, run, chosen)

    @classmethod
    def to_resume(cls, project: Path, run: str) -> TrainingFolder | None:
        """The folder of the newest checkpoint of a run; None when it has none."""
        settle(project, run)
        for folder in (fresh_folder(project, run), run_folder(project, run)):
            if has_checkpoint(folder):
                return cls(project, run, folder)
        return None

    @property
    def beside(self) -> bool:
        """Whether the old run is still in its place."""
        return self.folder != run_folder(self.project, self.run)

    def keep(self) -> None:
        """Let the new training take the old one's place, now that it has a checkpoint. Raises DiskError."""
        if self.beside:
            swap_in(self.project, self.run)
            self.folder = run_folder(self.project, self.run)


def checkpoint_state(path: Path) -> dict[str, Any] | None:
    """The numbers in a checkpoint's header (safetensors: 8 bytes of length, then JSON); None when it has none."""
    try:
        with open(path, "rb") as file:
            size = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(size)) if size < 1 << 27 else {}
        state = json.loads(header["__metadata__"]["fieldwork"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return state if isinstance(state, dict) else None


def checkpoint_id(project: Path, run: str) -> str:
    """Which field a run holds: another one after each training and each further step; empty without a checkpoint."""
    return state_id(checkpoint_state(run_folder(project, run) / CHECKPOINT))


def geometry_id(project: Path, run: str) -> str:
    """Which density and colours a run holds, whatever classes it was given since; empty without a checkpoint."""
    state = checkpoint_state(run_folder(project, run) / CHECKPOINT)
    return state_id(None if state is None else {**state, ACCEPTED: None})


def state_id(state: dict[str, Any] | None) -> str:
    """The identity of a checkpoint with this state."""
    if state is None:
        return ""
    if not state.get("training"):
        return digest(state)
    accepted = [state[ACCEPTED]] if state.get(ACCEPTED) else []
    return digest([state["training"], state["steps"], *accepted])


def holdout_of(project: Path, run: str) -> int:
    """Every how manieth photo the run holds out; the usual number where there is no such run."""
    value = _said_of(project, run, "holdout")
    return value if isinstance(value, int) else HOLDOUT


def photos_of(project: Path, run: str) -> list[str]:
    """The names of the photos that a run was trained on; none where there is no such run."""
    value = _said_of(project, run, "images")
    return value if isinstance(value, list) else []


def _said_of(project: Path, run: str, key: str) -> Any:
    """A value of the record of a run; None where there is no such run, or it does not say."""
    try:
        return json.loads((run_folder(project, run) / INFO).read_text(encoding="utf-8")).get(key)
    except (OSError, ValueError, AttributeError):
        return None


def read_events(folder: Path) -> list[dict[str, Any]]:
    """The course of a training as its events tell it; a line that a kill or a full disk cut off is left out."""
    try:
        return json_lines((folder / EVENTS).read_bytes())
    except OSError:
        return []


def cut_events(folder: Path, steps: int) -> None:
    """Take away what a training that was killed told of steps after its last checkpoint, which come again, and a line that was
    cut off. Raises DiskError."""
    path = folder / EVENTS
    if path.is_file():
        kept = [event for event in read_events(folder) if event.get("step", 0) <= steps]
        write_text(path, "".join(json.dumps(event) + "\n" for event in kept))


def read_metrics(folder: Path) -> dict[str, Any]:
    """What was measured of a run: results of train ("train") and evaluate ("test", "train_photos", …); empty when nothing was."""
    try:
        value = json.loads((folder / METRICS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}
