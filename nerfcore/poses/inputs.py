"""What poses are made from, and whether those that are there are still of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..params import PosesParams
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, files_digest
from ..project.schema import ImageRecord, Project, ProvenanceStep
from ..project.store import POSES_FILE, load_project

WORK_FOLDER = "poses/sfm"
STATE_FILE = "state.json"
EXPOSURE = "exposure"  # an input of poses, where photos keep theirs


def usable(project: Project) -> list[ImageRecord]:
    """The photos of a project that were not left out."""
    return [record for record in project.images if record.status != "rejected"]


def posing_inputs(folder: Path, project: Project, params: PosesParams) -> Fingerprint:
    """What poses depend on: the working copies, what is known of their lenses, masks, GPS."""
    records = usable(project)
    return {
        "photos": digest(
            [
                [r.name, r.camera_group, r.focal_px, files_digest([(r.file, folder / r.file)])]
                for r in sorted(records, key=lambda record: record.name)
            ]
        ),
        "masks": files_digest((r.name, folder / r.mask if r.mask else None) for r in records),
        "GPS": digest([[r.name, r.exif.get("gps")] for r in records]),
        "settings": digest([params.preset, params.group]),
        **({EXPOSURE: digest("kept")} if params.keep_exposure else {}),
    }


def recorded(project: Project) -> ProvenanceStep | None:
    """What the last estimation of poses was made from; records of before had no input for exposures that are kept."""
    made = project.last("poses")
    if made is None or not made.inputs or not made.settings.get("keep_exposure"):
        return made
    return made.model_copy(update={"inputs": {**made.inputs, EXPOSURE: digest("kept")}})


def posed(params: PosesParams) -> Earlier:
    """The poses that are there, if they are of the present photos, whose exposures are kept or not as asked for; other settings
    chosen by hand count as wished for."""
    folder = Path(params.project)
    project = load_project(folder)
    made = recorded(project)
    if made is None or not (folder / POSES_FILE).is_file():
        return Earlier()
    if not made.inputs:
        # Made by version 0.1: the photos whose features were found are on record.
        state = photos_found(folder / WORK_FOLDER)
        same = state is not None and _same_photos(state, photo_state(folder, usable(project)))
        return Earlier(made.result) if same else Earlier(reason="made by an earlier version from other photos")
    inputs = posing_inputs(folder, project, params)
    return compare(made, inputs | {"settings": made.inputs.get("settings", "")})


def photo_state(folder: Path, records: list[ImageRecord]) -> dict[str, list[Any]]:
    """What the features of each photo depend on."""
    return {
        r.name: [r.file, r.sha256, r.width, r.height, r.camera_group, r.mask]
        + ([files_digest([(r.mask, folder / r.mask)])] if r.mask else [])
        for r in records
    }


def _same_photos(before: dict[str, list[Any]], now: dict[str, list[Any]]) -> bool:
    """Whether these were the same photos, as far as an earlier version of the state says."""
    return before.keys() == now.keys() and not changed(before, now)


def changed(before: dict[str, list[Any]], now: dict[str, list[Any]]) -> bool:
    """Whether a photo that was there before is another one now. Earlier versions say less of each."""
    return any(now[name][: len(state)] != state for name, state in before.items() if name in now)


def photos_found(work: Path) -> dict[str, list[Any]] | None:
    """The photos whose features were found; None where that is not known."""
    try:
        value = json.loads((work / STATE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    right = isinstance(value, dict) and all(isinstance(state, list) for state in value.values())
    return value if right else None
