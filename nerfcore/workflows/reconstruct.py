"""The verb `reconstruct`: photos in, a labelled .blend out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import params as p
from ..blender.process import check_blend
from ..config import make_config
from ..data.load import load_scene
from ..data.readers import colmap, transforms
from ..errors import ProjectError
from ..evaluate.report import check_report, write_report
from ..files import require_writable
from ..progress import Reporter
from ..project.fingerprints import Earlier
from ..project.runs import holdout_of, read_metrics, run_folder
from ..project.store import is_project, load_project
from ..verdict import worst
from . import budget
from .stages import STAGES

AFTER_TRAINING = ("mesh", "blend", "evaluate")


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
        stage = STAGES[verb]()
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


def stages_of(params: p.ReconstructParams) -> list[str]:
    """The stages of a reconstruction in their order."""
    return [verb for verb in STAGES if verb != "blend" or params.blend is not None]


def stage_params(params: p.ReconstructParams, verb: str, spent: float = 0.0) -> p.Params | None:
    """What a stage of a reconstruction is asked for; None where it has nothing to do. `spent`: seconds since training.

    The project has to be as the stages before leave it: whether a training goes on, and whether photos are held out,
    stands there.
    """
    project, run = Path(params.out), "main"
    match verb:
        case "new":
            return p.NewParams(
                project=project,
                photos=params.photos,
                labels=params.labels,
                masks=params.masks,
                classes=params.classes,
                mask_mode=params.mask_mode,
                keep_backdrop=params.keep_backdrop,
            )
        case "poses":
            return p.PosesParams(project=project, keep_exposure=params.keep_exposure)
        case "train":
            from ..train.reuse import unfinished

            training = p.TrainParams(
                project=project,
                preset=params.preset,
                run=run,
                time_limit=params.time_limit,
                set=params.set,
                holdout=params.holdout,
            )
            return training.model_copy(update={"resume": unfinished(training)})
        case "mesh":
            return p.MeshParams(
                project=project,
                run=run,
                faces=params.faces,
                texture=params.texture,
                watertight=params.watertight,
                close_gaps=params.close_gaps,
            )
        case "evaluate":
            from ..train.reuse import held_out

            if not held_out(project, run):
                return None
            seconds = budget.share_of(params.time_limit, budget.EVALUATION, spent)
            return p.EvaluateParams(project=project, run=run, time_limit=None if params.time_limit is None else seconds)
        case "render":
            return _render_params(params, project, run, spent)
        case _:
            assert params.blend is not None
            return p.BlendParams(project=project, out=params.blend, run=run)


def renders_folder(params: p.ReconstructParams) -> Path:
    return params.renders or Path(params.out) / "exports" / "main" / "renders"


def run_stages(params: p.ReconstructParams, verbs: list[str], report: Reporter) -> Pipeline:
    """Do some stages of a reconstruction in turn, going on from what is there.

    Raises:
        any verb's error; the project is left so that the same call goes on.
    """
    pipeline = Pipeline(Path(params.out), report)
    for verb in verbs:
        if verb == "new":
            if is_project(pipeline.project) and load_project(pipeline.project).last("import") is not None:
                raise ProjectError(f"{pipeline.project} is an imported data set.", "Use train, mesh and blend on it.")
            _offer_poses(params.photos, report)
        values = stage_params(params, verb, pipeline.spent(*AFTER_TRAINING))
        if values is None:
            report.stage("evaluate: left out, no photos are held out")
        else:
            pipeline.do(verb, values)
    return pipeline


def reconstruct(params: p.ReconstructParams, report: Reporter) -> dict[str, Any]:
    """Run new, poses, train, mesh, blend, evaluate and render one after the other.

    An existing project at `out` is continued: a stage is done again only where what it depends on has changed.

    Returns:
        {"stages": {verb: seconds}, "reused": [verbs], "redone": {verb: why}, "new": {…}, "poses": {…}, "train": {…},
        "evaluate": {…}, "mesh": {…}, "render": {…}, "blend": {…}}
    Raises:
        any verb's error; the project is left so that the same command goes on.
    """
    check_asked(params)
    if params.time_limit is not None:
        report.note(budget.estimate(params.time_limit))
    made = run_stages(params, stages_of(params), report)
    return summed_up(params, made.seconds, made.reused, made.redone, made.results, report)


def check_asked(params: p.ReconstructParams) -> None:
    """Say what is wrong with settings and with files to write before hours of work. Raises SettingError, DiskError."""
    make_config(params.preset, params.set)
    if params.report is not None:
        check_report(params.report)
        require_writable(params.report)
    if params.blend is not None:
        check_blend(params.blend)
        require_writable(params.blend)
    if params.renders is not None:
        require_writable(params.renders / "view.png")


def summed_up(
    params: p.ReconstructParams,
    seconds: dict[str, float],
    reused: list[str],
    redone: dict[str, str],
    results: dict[str, Any],
    report: Reporter,
) -> dict[str, Any]:
    """What `reconstruct` returns, of stages that were done; writes the report that was asked for."""
    result = {
        "project": str(params.out),
        "stages": seconds,
        "reused": reused,
        "redone": redone,
        "verdict": worst({verb: made.get("verdict") for verb, made in results.items()}),
        **results,
    }
    if params.report is not None:
        write_report(params.report, Path(params.out), "main", renders_folder(params), result, report)
        result["report"] = str(params.report)
    return result


def _render_params(params: p.ReconstructParams, project: Path, run: str, spent: float) -> p.RenderParams:
    """Pictures of new views, as many and as large as there is time for."""
    size, count = None, params.render_count
    if params.time_limit is not None:
        from ..render.verb import orbit_cameras

        camera = orbit_cameras(load_scene(project, holdout_of(project, run)), count)[0][1]
        seconds = budget.share_of(params.time_limit, budget.PICTURES, spent)
        speed = (read_metrics(run_folder(project, run)).get("test") or {}).get("rps")
        size, count = budget.fitting_pictures((camera.width, camera.height), count, speed, seconds)
    passes: list[p.Pass] = ["rgb", "depth", "semantic"]
    return p.RenderParams(project=project, run=run, out=renders_folder(params), orbit=count, size=size, passes=passes)


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
