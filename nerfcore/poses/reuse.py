"""Poses that stay while the exposures of their photos are judged anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..files import write_json
from ..params import PosesParams
from ..progress import Reporter
from ..project.store import POSES_FILE, edit_project, load_points, load_poses, load_project, load_visibility
from .estimate import estimate_poses, with_gains
from .inputs import EXPOSURE, posed, posing_inputs


def poses_or_gains(params: PosesParams, report: Reporter) -> dict[str, Any]:
    """`estimate_poses`; where only `keep_exposure` is another one than before, all poses stay and only the gains of photos change.

    Returns:
        what `estimate_poses` returned for these poses, and raises what it raises.
    """
    folder = Path(params.project)
    project = load_project(folder)
    made = project.last("poses")
    if made is None or posed(params).reason != f"changed: {EXPOSURE}":
        return estimate_poses(params, report)
    inputs = {**posing_inputs(folder, project, params), "settings": made.inputs["settings"]}
    poses = load_poses(folder)
    poses = poses.model_copy(update={"images": [image.model_copy(update={"gain": None}) for image in poses.images]})
    if not params.keep_exposure:
        seen = load_visibility(folder)
        points = [np.asarray(seen.get(image.name, ()), np.int64) for image in poses.images]
        view = np.repeat(np.arange(len(points)), [len(own) for own in points])
        poses = with_gains(folder, project.images, poses, load_points(folder), (view, np.concatenate(points)), report)
    with edit_project(folder) as project:
        write_json(folder / POSES_FILE, poses.model_dump(mode="json"))
        # The world is as it was, also where it was aligned since: what GPS said of its scale is not said again.
        result = {**{name: value for name, value in made.result.items() if name != "gps"}, "world_kept": True}
        project.record("poses", {**made.settings, "keep_exposure": params.keep_exposure}, result, inputs)
    return result
