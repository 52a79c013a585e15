"""What a worker does with a task: answers, refusals, interrupts."""

from __future__ import annotations

import errno
import json
import time
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore import __version__
from fieldwork.nerfcore.blocks.plan import BlockPlan, Plan, block_folder, save_plan
from fieldwork.nerfcore.cluster import worker
from fieldwork.nerfcore.errors import PosesError
from fieldwork.nerfcore.params import BlocksParams, ReconstructParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows.blocks import run_stage, tasks_of
from fieldwork.nerfcore.workflows.stage_task import do_stage
from fieldwork.tests.nerfcore.support.photos import folder_of


def said(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    report.stage("Speaking")
    report.warn("A word.")
    if values.get("fails"):
        raise PosesError("No poses.", "Take more photos.")
    if values.get("refused"):
        raise OSError(values["refused"], "refused", "runs/main")
    if values.get("odd"):
        raise KeyError("odd")
    while values.get("long"):
        report.check()
        time.sleep(0.01)
    return {"said": values["what"]}


def ask(place: Path, /, **changes: Any) -> dict[str, Any]:
    job = {
        "function": f"{__name__}:said",
        "values": {"what": "ä"},
        "version": __version__,
        "folder": str(place),
        "cores": 1,
        "keep_free_gb": 0.0,
        **changes,
    }
    return json.loads(worker.execute(json.dumps(job), lambda _: None))


def test_a_worker_answers_in_json(tmp_path):
    answer = ask(tmp_path)
    assert (answer["state"], answer["result"], answer["warnings"]) == ("done", {"said": "ä"}, ["A word."])
    assert answer["free_gb"] > 0
    failed = ask(tmp_path, values={"fails": True})
    assert (failed["state"], failed["error"]) == (
        "failed",
        {"code": "poses", "message": "No poses.", "hint": "Take more photos."},
    )
    assert ask(tmp_path, values={"odd": True})["error"]["code"] == "internal"


@pytest.mark.parametrize(("number", "denied"), [(errno.EACCES, True), (errno.ENOSPC, None), (errno.EROFS, None)])
def test_a_worker_tells_files_it_may_not_write_from_disks_that_take_none(tmp_path, number, denied):
    error = ask(tmp_path, values={"refused": number})["error"]
    assert (error["code"], error.get("denied")) == ("disk", denied)


@pytest.mark.parametrize(
    ("changes", "state", "words"),
    [
        ({"version": "9.9"}, "refused", f"has Fieldwork {__version__}, this campaign 9.9"),
        ({"folder": "/not/here"}, "refused", "does not have the folder /not/here"),
        ({"keep_free_gb": 1e9}, "full", "GB free"),
    ],
)
def test_a_worker_refuses_what_it_cannot_do(tmp_path, changes, state, words):
    answer = ask(tmp_path, **changes)
    assert answer["state"] == state
    assert words in answer["error"]["message"]
    assert answer["error"]["hint"]


@pytest.mark.parametrize("link", ["images", "runs/main/field.safetensors"])
def test_a_worker_follows_no_link_out_of_the_campaign_s_folder(tmp_path, link):
    campaign, outside = tmp_path / "campaign", tmp_path / "elsewhere"
    project = campaign / "vase"
    (project / link).parent.mkdir(parents=True)
    folder_of(campaign / "photos", 3)
    outside.mkdir()
    (project / "depth").symlink_to(campaign / "photos")  # one that stays inside
    (project / "loop").symlink_to(project / "loop")
    (project / link).symlink_to(outside)
    capture = ReconstructParams(photos=campaign / "photos", out=project).model_dump(mode="json")
    with pytest.raises(worker.Refusal, match=f"{link} is outside of the campaign's folder"):
        do_stage({"capture": capture, "stage": "new", "folder": str(campaign)}, Reporter())
    assert list(outside.iterdir()) == []
    (project / link).unlink()
    worker.require_inside(project, campaign)
    block = BlockPlan(name="1", low=(0, 0, 0), high=(1, 1, 1), images=[])
    plan = Plan(low=block.low, high=block.high, blocks=[block])
    save_plan(project, plan)
    (block_folder(project, block) / "runs").mkdir(parents=True)
    (block_folder(project, block) / "runs/main").symlink_to(outside)
    with pytest.raises(worker.Refusal, match="runs/main is outside of the campaign's folder"):
        run_stage(tasks_of(BlocksParams(project=project), plan)[0].values, Reporter())


def test_an_interrupt_ends_the_work_of_a_worker(tmp_path):
    import _thread
    import threading

    threading.Timer(0.5, _thread.interrupt_main).start()
    begin = time.monotonic()
    assert ask(tmp_path, values={"long": True})["state"] == "cancelled"
    assert time.monotonic() - begin < 3.0
