"""The verb `reconstruct`: photos in, a labelled .blend out."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import params as p
from ..blender.blend import blend
from ..capture.ingest import new
from ..errors import ProjectError
from ..evaluate.report import write_report
from ..evaluate.verb import evaluate
from ..mesh.verb import mesh
from ..poses.estimate import estimate_poses
from ..progress import Reporter
from ..project.store import is_project, load_project
from ..render.verb import render
from ..train.verb import train

STAGES: dict[str, Callable[[Any, Reporter], dict[str, Any]]] = {
    "new": new,
    "poses": estimate_poses,
    "train": train,
    "evaluate": evaluate,
    "mesh": mesh,
    "render": render,
    "blend": blend,
}


def reconstruct(params: p.ReconstructParams, report: Reporter) -> dict[str, Any]:
    """Run new, poses, train, evaluate, mesh, render and blend one after the other.

    An existing project at `out` is continued: what is done is not done again.

    Returns:
        {"stages": {verb: seconds}, "new": {…}, "poses": {…}, "train": {…}, "evaluate": {…}, "mesh": {…}, "blend": {…}}
    Raises:
        any verb's error; the project is left so that the same command goes on.
    """
    project, run = Path(params.out), "main"
    stages: dict[str, float] = {}
    results: dict[str, Any] = {}

    def do(verb: str, values: p.Params) -> None:
        begin = time.perf_counter()
        results[verb] = STAGES[verb](values, report)
        stages[verb] = round(time.perf_counter() - begin, 1)

    known = {step.verb: step.result for step in load_project(project).provenance} if is_project(project) else {}
    if "import" in known:
        raise ProjectError(f"{project} is an imported data set.", "Use train, mesh and blend on it.")
    do(
        "new",
        p.NewParams(
            project=project, photos=params.photos, labels=params.labels, masks=params.masks, classes=params.classes
        ),
    )
    if "poses" in known and (project / "poses" / "poses.json").is_file():
        results["poses"], stages["poses"] = known["poses"], 0.0
    else:
        do("poses", p.PosesParams(project=project))
    do(
        "train",
        p.TrainParams(
            project=project, preset=params.preset, run=run, time_limit=params.time_limit, set=params.set, resume=True
        ),
    )
    if results["new"]["images"] >= 8:
        do("evaluate", p.EvaluateParams(project=project, run=run))
    do("mesh", p.MeshParams(project=project, run=run))
    renders = params.renders or project / "exports" / run / "renders"
    do("render", p.RenderParams(project=project, run=run, out=renders, orbit=8, passes=["rgb", "depth", "semantic"]))
    if params.blend is not None:
        do("blend", p.BlendParams(project=project, out=params.blend, run=run))
    result = {"project": str(project), "stages": stages, **results}
    if params.report is not None:
        write_report(params.report, project, run, renders, result)
        result["report"] = str(params.report)
    return result
