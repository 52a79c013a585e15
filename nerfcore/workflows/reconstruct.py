"""The verb `reconstruct`: photos in, a labelled .blend out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from .. import params as p
from ..blender.blend import blend, blended
from ..capture.ingest import ingested, new
from ..data.load import load_scene
from ..data.readers import colmap, transforms
from ..errors import ProjectError
from ..evaluate.report import check_report, write_report
from ..evaluate.verb import evaluate, evaluated
from ..mesh.verb import mesh, meshed
from ..poses.estimate import estimate_poses, posed
from ..progress import Reporter
from ..project.fingerprints import Earlier
from ..project.runs import holdout_of
from ..project.store import is_project, load_project
from ..render.verb import orbit_cameras, render, rendered
from ..train.reuse import finished, held_out, train_or_keep, unfinished
from ..verdict import worst
from . import budget


class Stage(NamedTuple):
    """`earlier` says whether what an earlier call made may be used again."""

    run: Callable[[Any, Reporter], dict[str, Any]]
    earlier: Callable[[Any], Earlier]


STAGES = {
    "new": Stage(new, ingested),
    "poses": Stage(estimate_poses, posed),
    "train": Stage(train_or_keep, finished),
    "evaluate": Stage(evaluate, evaluated),
    "mesh": Stage(mesh, meshed),
    "render": Stage(render, rendered),
    "blend": Stage(blend, blended),
}


@dataclass
class Pipeline:
    """The stages of one reconstruction, done in turn: seconds and results by verb, the verbs whose earlier results were
    used again, and why others were done again."""

    project: Path
    report: Reporter
    seconds: dict[str, float] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)
    reused: list[str] = field(default_factory=list)
    redone: dict[str, str] = field(default_factory=dict)

    def do(self, verb: str, values: p.Params) -> None:
        """Run a stage, unless what an earlier call made of the same inputs is there."""
        begin = time.perf_counter()
        self.report.check()
        stage = STAGES[verb]
        earlier = stage.earlier(values) if is_project(self.project) else Earlier()
        if earlier.result is not None:
            self.results[verb], self.seconds[verb] = earlier.result, 0.0
            self.reused.append(verb)
            self.report.stage(f"{verb}: nothing has changed, kept")
            return
        if getattr(values, "resume", False):
            self.report.stage(f"{verb}: goes on where it was stopped")
        elif earlier.reason:
            self.redone[verb] = earlier.reason
            self.report.stage(f"{verb}: done again ({earlier.reason})")
        self.results[verb] = stage.run(values, self.report)
        self.seconds[verb] = round(time.perf_counter() - begin, 1)

    def spent(self, *verbs: str) -> float:
        """Seconds that these stages took."""
        return sum(self.seconds.get(verb, 0.0) for verb in verbs)


def reconstruct(params: p.ReconstructParams, report: Reporter) -> dict[str, Any]:
    """Run new, poses, train, mesh, blend, evaluate and render one after the other.

    An existing project at `out` is continued: a stage is done again only where what it depends on has changed.

    Returns:
        {"stages": {verb: seconds}, "reused": [verbs], "redone": {verb: why}, "new": {…}, "poses": {…}, "train": {…},
        "evaluate": {…}, "mesh": {…}, "render": {…}, "blend": {…}}
    Raises:
        any verb's error; the project is left so that the same command goes on.
    """
    if params.report is not None:
        check_report(params.report)
    project, run = Path(params.out), "main"
    pipeline = Pipeline(project, report)
    if params.time_limit is not None:
        report.note(budget.estimate(params.time_limit))
    if is_project(project) and load_project(project).last("import") is not None:
        raise ProjectError(f"{project} is an imported data set.", "Use train, mesh and blend on it.")
    _offer_poses(params.photos, report)
    pipeline.do(
        "new",
        p.NewParams(
            project=project,
            photos=params.photos,
            labels=params.labels,
            masks=params.masks,
            classes=params.classes,
            mask_mode=params.mask_mode,
        ),
    )
    pipeline.do("poses", p.PosesParams(project=project))
    training = p.TrainParams(
        project=project,
        preset=params.preset,
        run=run,
        time_limit=params.time_limit,
        set=params.set,
        holdout=params.holdout,
    )
    pipeline.do("train", training.model_copy(update={"resume": unfinished(training)}))
    pipeline.do("mesh", _mesh_params(params, project, run))
    renders = params.renders or project / "exports" / run / "renders"
    if params.blend is not None:  # what was asked for, before what says how good it is
        pipeline.do("blend", p.BlendParams(project=project, out=params.blend, run=run))
    if held_out(project, run):
        seconds = budget.share_of(params.time_limit, budget.EVALUATION, pipeline.spent("mesh", "blend"))
        limit = None if params.time_limit is None else seconds
        pipeline.do("evaluate", p.EvaluateParams(project=project, run=run, time_limit=limit))
    else:
        report.stage("evaluate: left out, no photos are held out")
    pipeline.do("render", _render_params(params, pipeline, run, renders))
    result = {
        "project": str(project),
        "stages": pipeline.seconds,
        "reused": pipeline.reused,
        "redone": pipeline.redone,
        "verdict": worst({verb: made.get("verdict") for verb, made in pipeline.results.items()}),
        **pipeline.results,
    }
    if params.report is not None:
        write_report(params.report, project, run, renders, result)
        result["report"] = str(params.report)
    return result


def _mesh_params(params: p.ReconstructParams, project: Path, run: str) -> p.MeshParams:
    faces, texture = params.faces or None, params.texture or None
    if budget.seconds_after(params.time_limit) >= budget.WHOLE_MESH:
        return p.MeshParams(project=project, run=run, faces=faces, texture=texture)
    texture = None if texture is None else min(texture, 2048)
    return p.MeshParams(project=project, run=run, faces=faces, texture=texture, resolution=256)


def _render_params(params: p.ReconstructParams, pipeline: Pipeline, run: str, renders: Path) -> p.RenderParams:
    """Pictures of new views, as many and as large as there is time for."""
    project, size, count = pipeline.project, None, params.render_count
    if params.time_limit is not None:
        camera = orbit_cameras(load_scene(project, holdout_of(project, run)), count)[0][1]
        seconds = budget.share_of(params.time_limit, budget.PICTURES, pipeline.spent("mesh", "blend", "evaluate"))
        speed = pipeline.results.get("evaluate", {}).get("rps")
        size, count = budget.fitting_pictures((camera.width, camera.height), count, speed, seconds)
    passes: list[p.Pass] = ["rgb", "depth", "semantic"]
    return p.RenderParams(project=project, run=run, out=renders, orbit=count, size=size, passes=passes)


def _offer_poses(photos: Path, report: Reporter) -> None:
    """Say that poses which lie beside the photos are not used: `import` is what reads them."""
    for folder in (photos, photos.parent):
        kind = "transforms.json" if transforms.matches(folder) else "a COLMAP model" if colmap.matches(folder) else None
        if folder.is_dir() and kind:
            report.warn(
                f"{folder} has {kind} with camera poses, which are estimated anew here. To keep those, use `fieldwork "
                f"import {folder} PROJECT`, then train and mesh."
            )
            return
