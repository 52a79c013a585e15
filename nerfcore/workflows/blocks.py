"""The verb `blocks`: one large posed capture, trained and meshed in parts that overlap, joined into one mesh.

What a stage needs loads when it is reached."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import params as p
from ..blocks.plan import MAPS, PART, RUN, SIGHTS, BlockPlan, Plan, block_folder, cut, load_plan, save_plan
from ..blocks.projects import write_block
from ..cluster.estimate import Durations
from ..cluster.link import Link
from ..cluster.run import Options, Progress, Runner
from ..cluster.tasks import Task
from ..cluster.worker import require_inside
from ..config import make_config
from ..data.load import class_inputs, load_scene, view_inputs
from ..errors import FieldworkError
from ..files import require_writable
from ..mesh.formats import check_format
from ..progress import Reporter
from ..project.fingerprints import Fingerprint, compare, digest, read_made, write_made
from ..project.lock import awaited_lock
from ..project.runs import checkpoint_id, run_folder
from ..project.schema import step
from ..project.store import load_project, record_step
from .campaign import held_gb, need_of

TASK = f"{__name__}:run_stage"
STAGES = ("train", "maps", "part")  # of each block; a part needs the maps of all blocks


class BlockError(FieldworkError):
    """A block could not be made."""

    code = "blocks"


def blocks(params: p.BlocksParams, report: Reporter) -> dict[str, Any]:
    """Cut a posed capture into blocks, train and mesh each, and join their meshes.

    What is there of an earlier call is used again where photos, classes and settings are the same.

    Returns:
        what `write_whole` returns, and "stages": seconds of each task, "reused": the tasks that had nothing to do
    Raises:
        SettingError: too many blocks, or a setting is none. ProjectError, TrainingError, DiskError, ClusterError.
        BlockError: a task failed on the cluster.
    """
    folder = Path(params.project)
    if params.out is not None:
        check_format(params.out)
        require_writable(params.out)
    if params.turntable is not None:
        require_writable(params.turntable / "color_0.png")
    make_config(params.preset, settings_of(params))  # says what is wrong with the settings before anything is made
    link = Link(params.cluster, params.wheel) if params.cluster else None
    report.stage("Cutting into blocks")
    plan = cut(load_scene(folder, params.holdout), params.count)
    save_plan(folder, plan)
    for number, block in enumerate(plan.blocks):
        report.progress(number / len(plan.blocks), f"{len(block.images)} photos see block {block.name}")
        report.check()
        write_block(folder, plan, block, params.holdout)
    made = _here(params, plan, report) if link is None else _on_cluster(params, plan, link, report)
    from ..blocks.whole import write_whole

    result = write_whole(folder, plan, params, report)
    result["stages"] = {name: answer["seconds"] for name, answer in made.items()}
    result["reused"] = [name for name, answer in made.items() if answer["reused"]]
    record_step(folder, "blocks", params.model_dump(mode="json"), result)
    return result


def settings_of(params: p.BlocksParams) -> dict[str, str]:
    """Settings of the runs: what lies around a block is contracted, so that it is explained there."""
    return {"scene.contraction": "on", **params.set}


def training_of(params: p.BlocksParams, block: BlockPlan) -> p.TrainParams:
    """What `train` is asked for a block."""
    training = p.TrainParams(
        project=block_folder(Path(params.project), block),
        preset=params.preset,
        run=RUN,
        steps=params.steps,
        time_limit=params.time_limit,
        set=settings_of(params),
        holdout=params.holdout,
    )
    from ..train.reuse import unfinished

    return training.model_copy(update={"resume": unfinished(training)})


def run_stage(values: dict[str, Any], report: Reporter, patience: float | None = None) -> dict[str, Any]:
    """Do one stage of one block, unless what is there is still good.

    Args:
        values: "params": settings of `blocks`; "block": its name; "stage"; "folder": the only one that is written in.
        patience: seconds to wait for one who holds the block; None: until a worker whose head is gone has noticed.
    Returns:
        {"result", "seconds", "reused"}
    Raises:
        the errors of training and meshing. Refusal: the block's folder leads out of the campaign's.
    """
    params = p.BlocksParams.model_validate(values["params"])
    folder, begin = Path(params.project), time.perf_counter()
    plan = load_plan(folder)
    block = next(block for block in plan.blocks if block.name == values["block"])
    require_inside(block_folder(folder, block), Path(values["folder"]))
    with awaited_lock(block_folder(folder, block), "blocks", report.check, patience):
        result, reused = _STAGES[values["stage"]](params, plan, block, report)
    return {"result": result, "seconds": round(time.perf_counter() - begin, 1), "reused": reused}


def tasks_of(params: p.BlocksParams, plan: Plan) -> list[Task]:
    """The stages of all blocks as tasks of a cluster."""
    folder = Path(params.project).absolute()
    values = {"params": {**params.model_dump(mode="json"), "project": str(folder)}, "folder": str(folder)}
    tasks = []
    for stage in STAGES:
        for block in plan.blocks:
            before = {
                "train": (),
                "maps": (f"train {block.name}",),
                "part": tuple(f"maps {b.name}" for b in plan.blocks),
            }
            need = need_of(
                "train" if stage == "train" else "mesh", held_gb(params.preset, params.set, len(block.images))
            )
            name = f"{stage} {block.name}"
            own = {**values, "block": block.name, "stage": stage}
            tasks.append(Task(name, f"block {block.name}", name, TASK, own, needs=before[stage], need=need))
    return tasks


def _here(params: p.BlocksParams, plan: Plan, report: Reporter) -> dict[str, Any]:
    """All tasks one after the other: their answers by name."""
    made = {}
    for task in tasks_of(params, plan):
        report.check()
        report.stage(f"Block {task.values['block']} of {len(plan.blocks)}: {task.values['stage']}")
        made[task.id] = run_stage(task.values, report, patience=0.0)
    return made


def _on_cluster(params: p.BlocksParams, plan: Plan, link: Link, report: Reporter) -> dict[str, Any]:
    """All tasks on the workers of a cluster: their answers by name."""
    folder = Path(params.project).absolute()
    failed: list[Task] = []

    def ended(task: Task) -> None:
        if task.state == "failed":
            failed.append(task)

    def watch(progress: Progress) -> None:
        done = sum(task.state == "done" for task in progress.tasks.all.values())
        report.progress(done / len(progress.tasks.all), f"{done} tasks done, {len(progress.nodes)} workers")

    report.stage(f"{len(plan.blocks)} blocks")
    options = Options(folder, params.retries, params.keep_free)
    runner = Runner(tasks_of(params, plan), link, options, report, ended, watch, Durations())
    runner.run()
    if failed:
        error = failed[0].answer["error"]
        raise BlockError(f"{failed[0].stage}: {error['message']}", error["hint"])
    return {task.id: task.answer["result"] for task in runner.tasks.all.values()}


def _train(params: p.BlocksParams, plan: Plan, block: BlockPlan, report: Reporter) -> tuple[dict[str, Any], bool]:
    from ..train.reuse import finished, train_or_keep

    training = training_of(params, block)
    earlier = finished(training)
    return (earlier.result, True) if earlier.result is not None else (train_or_keep(training, report), False)


def _maps(params: p.BlocksParams, plan: Plan, block: BlockPlan, report: Reporter) -> tuple[dict[str, Any], bool]:
    from ..blocks.surface import make_maps
    from ..mesh.depth_maps import FLAT

    folder, own = Path(params.project), block_folder(Path(params.project), block)
    scene = load_scene(own, params.holdout)
    inputs = {"field": checkpoint_id(own, RUN), "plan": digest(plan.model_dump(mode="json"))}
    if any(scene.views[i].camera.model not in FLAT for i in scene.train):
        inputs["pictures"] = "cut"  # earlier versions made others of wide lenses
    run = run_folder(own, RUN)
    make = lambda: {"maps": make_maps(folder, plan, block, report)}  # noqa: E731
    return _kept([run / MAPS, run / SIGHTS], inputs, make)


def _part(params: p.BlocksParams, plan: Plan, block: BlockPlan, report: Reporter) -> tuple[dict[str, Any], bool]:
    from ..blocks.surface import make_part

    folder, own = Path(params.project), block_folder(Path(params.project), block)
    scene = load_scene(own, params.holdout)
    inputs = {
        "fields": digest([checkpoint_id(block_folder(folder, other), RUN) for other in plan.blocks]),
        "plan": digest(plan.model_dump(mode="json")),
        "region": digest(load_project(folder).frame.bounds),
        "classes": class_inputs(scene),
        "settings": digest([params.resolution, params.faces]),
        **view_inputs(scene, scene.train, files=True),
    }
    make = lambda: make_part(folder, plan, block, params.resolution, params.faces, report)  # noqa: E731
    return _kept([run_folder(own, RUN) / PART], inputs, make)


_STAGES = {"train": _train, "maps": _maps, "part": _part}


def _kept(paths: list[Path], inputs: Fingerprint, make: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], bool]:
    """What `make` returns, unless the files that it writes were made of the same inputs; a record of them is kept beside the
    first."""
    record = paths[0].with_suffix(".json")
    earlier = compare(read_made(record), inputs, paths)
    if earlier.result is not None:
        return earlier.result, True
    record.unlink(missing_ok=True)
    result = make()
    write_made(record, step("blocks", {}, result, inputs))
    return result, False
