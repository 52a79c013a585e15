"""A batch on a cluster: the captures' stages as tasks, their answers as the report of a batch."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..capture.find import list_photos
from ..cluster import status as st
from ..cluster.estimate import Durations
from ..cluster.link import Link
from ..cluster.run import Options, Progress, Runner
from ..cluster.storage import Storage
from ..cluster.tasks import Need, Task
from ..cluster.working_copy import Copy
from ..config import make_config
from ..errors import Cancelled, FieldworkError, SettingError, explained
from ..evaluate.report import check_report
from ..params import BatchParams, ReconstructParams
from ..progress import Reporter
from .captures import Capture
from .reconstruct import stages_of, summed_up
from .stage_task import READ, WRITTEN, capture_name, tracked_paths

PAGE = st.PAGE
STAGE_TASK = f"{__package__}.stage_task:run_stage"
CORES = {"poses": 2.0, "train": 2.0, "mesh": 2.0}  # of the other stages: 1
ON_GPU = ("train", "evaluate", "mesh", "render")
PYTHON_GB = 1.5  # that libraries take before any photo is read
PHOTO_GB = {"poses": 0.02, "new": 0.01}  # a photo that is worked on, with its features
BYTES_A_PIXEL = 5  # colour, alpha and label
FIELD_FLOATS = 4  # value, gradient, two moments
SMALLEST_GPU_GB = 8.0  # shares of a GPU are for one of this size
MANY_PHOTOS, MOST_SHARES = 200, 16  # from so many on pairs are matched in parts, at most so many
PART = 32  # frames of a render that one worker makes
SHOWN = (("failed", 8), ("running", 20), ("waiting", 4))  # captures in the terminal's table
WRITE_EVERY, PAGE_EVERY = 2.0, 10.0  # seconds


def folder_of(path: Path) -> Path:
    """Where a campaign of this list tells how it stands."""
    return path.absolute().with_name(f"{path.stem}-campaign")


def run(
    params: BatchParams,
    captures: list[Capture],
    todo: list[Capture],
    entries: dict[str, dict[str, Any]],
    note: Callable[..., None],
    report: Reporter,
) -> None:
    """Reconstruct the captures `todo` on a cluster.

    Args:
        captures: all of the list. entries: what the report has of those that were done before.
        note: note(key, entry, write) takes a capture's entry in the report.
    Raises:
        SettingError: Ray is not installed, the address is none, or a capture writes outside of the list's folder.
        ClusterError, DiskError, Cancelled.
    """
    link = Link(params.cluster or "auto", params.wheel)
    folder = params.list.absolute().parent
    campaign = Campaign(params, captures, entries, note, report)
    tasks = plan(todo, folder, params.storage, campaign.name)
    for task in tasks:
        campaign.stages.setdefault(task.group, []).append(task)
    if params.storage:
        campaign.share(todo, folder, params.storage)
    options = Options(folder, params.retries, params.keep_free, params.storage)
    runner = Runner(tasks, link, options, report, campaign.ended, campaign.watch, known_durations(entries))
    report.stage(f"Campaign of {len(todo)} captures")
    try:
        runner.run()
        campaign.close("failed" if any(e["state"] == "failed" for e in entries.values()) else "done")
    except BaseException as error:
        campaign.close("cancelled" if isinstance(error, Cancelled) else "failed")
        raise


def plan(captures: list[Capture], folder: Path, storage: str | None = None, campaign: str = "") -> list[Task]:
    """The tasks of captures, in the order in which they are begun: a capture that was begun is brought to its end first.

    Raises:
        SettingError: a capture writes outside of `folder`, or its report has no known ending.
    """
    root, tasks = folder.resolve(), []
    for params, priority in captures:
        for name in (*WRITTEN, *(READ if storage else ())):
            path = getattr(params, name)
            if path is not None and not path.resolve().is_relative_to(root):
                raise SettingError(
                    f"{path} (“{name}”) is outside of {folder}, the only folder that workers of a campaign "
                    f"{'write to' if name in WRITTEN else 'are sent files of'}.",
                    "Put the list into a folder above all of its files.",
                )
        if params.report is not None:
            check_report(params.report)
        # Parts would write one list of files at the same time; with a limit of time nobody knows yet how many frames fit.
        whole = storage or params.time_limit is not None
        parts = [] if whole else frame_ranges(params.render_count)
        shares = 0 if storage else matching_shares(photos_in(params.photos))
        shared = {"folder": str(folder), "storage": storage, "campaign": campaign}
        tasks += capture_tasks(params, priority, parts, shared, shares)
    return tasks


def capture_tasks(
    params: ReconstructParams, priority: int, parts: list[tuple[int, int]], shared: dict[str, Any], shares: int = 0
) -> list[Task]:
    """The tasks of one capture, one after the other; beside each other are `parts` of the frames of its render, and
    `shares` of the pairs of its photos to match."""
    key, before, tasks = str(params.out), (), []
    values = {"capture": params.model_dump(mode="json"), **shared}
    memory = memory_gb(params)

    def add(stage: str, needs: tuple[str, ...], **more: Any) -> str:
        verb = stage.partition(" ")[0]
        known = {"function": STAGE_TASK, "values": {**values, "stage": verb, **more}, "needs": needs}
        tasks.append(Task(f"{key}:{stage}", key, stage, need=need_of(verb, memory), priority=priority, **known))
        return tasks[-1].id

    for stage in stages_of(params):
        if stage == "poses" and shares:
            before = (add("poses features", before, matching="features"),)
            before = tuple(add(f"poses pairs {k + 1}", before, matching=[k, shares]) for k in range(shares))
        if stage == "render" and parts:
            before = tuple(add(f"render {first}-{last}", before, frame_range=[first, last]) for first, last in parts)
        before = (add(stage, before),)
    return tasks


def frame_ranges(count: int) -> list[tuple[int, int]]:
    """The parts of a render of so many frames; none where it is too short to be worth it."""
    if count <= PART:
        return []
    return [(first, min(first + PART, count) - 1) for first in range(0, count, PART)]


def matching_shares(photos: int) -> int:
    """In how many parts the pairs of so many photos are matched; 0 where it is not worth it."""
    return 0 if photos < MANY_PHOTOS else min(MOST_SHARES, photos // (MANY_PHOTOS // 2))


def memory_gb(params: ReconstructParams) -> dict[str, float]:
    """GB that the stages of a capture take at most, by the plan of its run; “field” is what its training holds."""
    return held_gb(params.preset, params.set, photos_in(params.photos))


def held_gb(preset: str, settings: dict[str, str], count: int) -> dict[str, float]:
    """`memory_gb` of a run with these settings on so many photos."""
    field, side, kept = _sizes(preset, tuple(sorted(settings.items())))
    photos = kept or count * side * side * 0.75 * BYTES_A_PIXEL / 1e9
    held = PYTHON_GB + field + photos
    working = {stage: PYTHON_GB + each * min(count, 200) for stage, each in PHOTO_GB.items()}
    return {**working, "field": round(held, 2)}


@lru_cache(maxsize=64)
def _sizes(preset: str, settings: tuple[tuple[str, str], ...]) -> tuple[float, int, float | None]:
    """GB of a field with its optimiser, pixels of a photo's longer side, GB that photos may take where that is set."""
    config = make_config(preset, dict(settings))
    field = config.field.levels * 2**config.field.table_log2 * 4 * 4 * FIELD_FLOATS / 1e9
    return field, config.scene.image_size or 1600, config.scene.photo_memory


def photos_in(photos: Path) -> int:
    """How many photos there are in a folder; 150 of a video, or where it cannot be read from here."""
    try:
        return len(list_photos(photos)[0])
    except (FieldworkError, OSError):
        return 150


def need_of(stage: str, memory: dict[str, float]) -> Need:
    """What a stage takes of a worker."""
    held = memory.get(stage, memory["field"])
    share = 0.0
    if stage in ON_GPU:
        share = min(1.0, max(1, round(4 * memory["field"] / SMALLEST_GPU_GB + 0.499)) / 4)
    return Need(CORES.get(stage, 1.0), round(held, 2), share)


def known_durations(entries: Mapping[str, dict[str, Any]]) -> Durations:
    """What stages took of captures that are done, as a report has them."""
    known: dict[str, list[float]] = {}
    for entry in entries.values():
        for stage, seconds in entry.get("stages", {}).items():
            if seconds:
                known.setdefault(stage, []).append(seconds)
    return Durations(known)


class Campaign:
    """What is known of the captures while their tasks run: entries of the report, rows of the status."""

    def __init__(
        self,
        params: BatchParams,
        captures: list[Capture],
        entries: dict[str, dict[str, Any]],
        note: Callable[..., None],
        report: Reporter,
    ) -> None:
        self.params, self.entries, self.note, self.report = params, entries, note, report
        self.captures = {str(capture.params.out): capture.params for capture in captures}
        self.numbers = {key: number for number, key in enumerate(self.captures)}
        self.folder, self.started = folder_of(params.list), time.time()
        self.name = uuid.uuid4().hex  # another one each time that it runs
        self.stages: dict[str, list[Task]] = {}
        self.pictures: dict[str, str] = {}
        self.copies: dict[str, Copy] = {}
        self.progress: Progress | None = None
        self.closed = False
        self.noted = self.written = self.paged = 0.0

    def share(self, todo: list[Capture], folder: Path, url: str) -> None:
        """Upload what captures are made of, and what there is of them already; results are fetched when they are done.

        Raises:
            StorageError, SettingError, Cancelled.
        """
        storage = Storage(url)
        self.report.stage("Uploading files")
        objects = storage.objects()
        for number, (params, _) in enumerate(todo):
            self.report.progress(number / len(todo), params.out.name)
            copy = Copy(storage, folder, capture_name(params, folder), tracked_paths(params))
            self.copies[str(params.out)] = copy
            copy.take(self.name)
            copy.mend(objects)
            if copy.changed():
                copy.upload()

    def ended(self, task: Task) -> None:
        """A task is done or failed: with the last one of a capture its entry is noted."""
        tasks = self.stages[task.group]
        if task.state == "done" and any(each.state != "done" for each in tasks):
            return
        params = self.captures[task.group]
        self._fetch(task)
        entry: dict[str, Any] = {"settings": params.model_dump(mode="json")}
        if task.state == "done":
            entry |= self._made(params, tasks)
        else:
            error = task.answer["error"]
            entry |= {"state": "failed", "error": error["message"], "hint": error["hint"], "stage": task.stage}
        entry["attempts"] = max(1, max(each.attempts for each in tasks) + (task.state == "done"))
        entry["losses"] = sum(each.losses for each in tasks)
        entry["seconds"] = round(sum(each.answer.get("seconds", 0.0) for each in tasks), 1)
        self.pictures[task.group] = st.add_picture(self.folder, Path(task.group), self.numbers[task.group])
        now = time.monotonic()
        write = now - self.noted > WRITE_EVERY
        self.noted = now if write else self.noted
        self.note(task.group, entry, write)

    def _fetch(self, task: Task) -> None:
        """Bring the files of a capture here; a storage that fails makes it a failed one."""
        copy = self.copies.get(task.group)
        if copy is None:
            return
        try:
            copy.fetch(keep_changes=True, warn=self.report.warn)
        except Exception as error:  # noqa: BLE001 - one capture's files must not stop the others
            known = explained(error)
            task.state = "failed"
            task.answer = {"error": {"code": known.code, "message": known.message, "hint": known.hint}}

    def _made(self, params: ReconstructParams, tasks: list[Task]) -> dict[str, Any]:
        """The result of all stages together, as `reconstruct` returns it."""
        made = {task.stage: task.answer["result"] for task in tasks if task.stage in stages_of(params)}
        made = {stage: answer for stage, answer in made.items() if answer["result"] is not None}
        try:
            result = summed_up(
                params,
                {stage: answer["seconds"] for stage, answer in made.items()},
                [stage for stage, answer in made.items() if answer["reused"]],
                {stage: answer["redone"] for stage, answer in made.items() if answer["redone"]},
                {stage: answer["result"] for stage, answer in made.items()},
                self.report,
            )
        except Exception as error:  # noqa: BLE001 - a report that cannot be written must not stop the other captures
            known = explained(error)
            return {"state": "failed", "error": known.message, "hint": known.hint, "stage": "report"}
        return {"state": "done", "stages": result["stages"], "result": result}

    def watch(self, progress: Progress) -> None:
        """Tell the terminal, now and then the files."""
        self.progress = progress
        now = time.monotonic()
        value = self._status("running")
        total = len(self.captures)
        done = value["counts"]["done"] + value["counts"]["failed"]
        shown = [row for state, most in SHOWN for row in [r for r in value["captures"] if r["state"] == state][:most]]
        self.report.event("campaign", **{**value, "captures": shown})
        self.report.progress(done / max(total, 1), f"{done} of {total} captures, {value['workers']} workers")
        if now - self.written > WRITE_EVERY:
            page = now - self.paged > PAGE_EVERY
            self.written, self.paged = now, now if page else self.paged
            st.write_status(self.folder, value, page)

    def close(self, state: str) -> None:
        """Write what is known, at the end: what was running waits for the next time."""
        self.closed = True
        st.write_status(self.folder, self._status(state), page=True)
        for key, entry in list(self.entries.items())[-1:]:
            self.note(key, entry, True)

    def _status(self, state: str) -> dict[str, Any]:
        ends = self.progress.ends if self.progress else {}
        rows = [self._row(key, ends) for key in self.captures]
        nodes = self.progress.nodes if self.progress else []
        return st.status(self.params.list.stem, state, self.started, rows, nodes, max(ends.values(), default=None))

    def _row(self, key: str, ends: dict[str, float]) -> dict[str, Any]:
        entry = self.entries.get(key)
        tasks = self.stages.get(key, [])
        if entry is not None and entry["state"] == "done":
            if key not in self.pictures:
                self.pictures[key] = st.add_picture(self.folder, Path(key), self.numbers[key])
            result = entry.get("result", {})
            known = {"verdict": result.get("verdict"), "figures": st.figures(result), "seconds": entry["seconds"]}
            return st.capture_row(key, "done", fraction=1.0, picture=self.pictures[key], **known)
        results = {task.stage: task.answer["result"]["result"] for task in tasks if task.state == "done"}
        known = {"figures": st.figures(results), "picture": self.pictures.get(key, "")}
        if entry is not None:
            return st.capture_row(key, "failed", error=entry["error"], hint=entry["hint"], **known)
        task = next((each for each in tasks if each.state != "done"), None)
        if task is None:
            return st.capture_row(key, "waiting", **known)
        eta = ends.get(tasks[-1].id)
        known |= {"stage": task.stage, "eta_s": None if eta is None else round(eta, 1)}
        begun = not self.closed and (task.state == "running" or bool(results))
        fraction = (len(results) + task.fraction) / len(tasks)
        return st.capture_row(key, "running" if begun else "waiting", fraction=round(fraction, 3), **known)
