"""What the header of each step says: whether it is done, and a few words or numbers. No layout here."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from bpy.types import Context

from ..addon import machine
from ..addon.jobs.job import Job
from ..addon.jobs.queue import queue
from ..addon.live import fields
from ..addon.project import runs, snapshot
from ..addon.text import t


def project_folder(context: Context) -> Path | None:
    return snapshot.folder_of(context.scene.fieldwork)


class State(NamedTuple):
    """State of a step; an empty text where there is nothing to say."""

    done: bool
    text: str = ""


def capture(context: Context) -> State:
    statuses = photo_statuses(context)
    if not statuses:
        return State(False)
    used = sum(status != "rejected" for status in statuses)
    return State(True, t("{} photos", used) if used == len(statuses) else t("{} of {} photos", used, len(statuses)))


def poses(context: Context) -> State:
    if not snapshot.has_poses(project_folder(context)):
        return State(False)
    statuses = photo_statuses(context)
    usable = sum(status != "rejected" for status in statuses)
    return State(True, f"{statuses.count('ok')}/{usable}")


def photo_statuses(context: Context) -> list[str]:
    """How each photo of the project fares. Of the project's file: the scene's lists lag behind a job of many stages."""
    known = snapshot.project(project_folder(context)) or {}
    return [image.get("status", "ok") for image in known.get("images", [])]


def classes(context: Context) -> State:
    count = len(context.scene.fieldwork.classes)
    return State(count > 0, str(count) if count else "")


def training_job(context: Context) -> Job | None:
    """The training of this scene's project: the one under way, else the last that ended."""
    folder = project_folder(context)
    candidates = [queue.running, queue.followed, *reversed(queue.finished)]
    return next((j for j in candidates if j and j.verb in ("train", "reconstruct") and j.project == folder), None)


def training(context: Context) -> bool:
    """Whether this scene's project is being trained."""
    job = training_job(context)
    return job is not None and job.active


def train(context: Context) -> State:
    folder, run = project_folder(context), context.scene.fieldwork.run
    job = training_job(context)
    if job is not None and job.active:
        return State(False, "…" if job.fraction is None else f"{job.fraction:.0%}")
    if runs.can_resume(folder, run):
        return State(False, t("paused"))
    if not runs.has_run(folder, run):
        return State(False)
    return State(True, runs.quality(folder, run).partition(",")[0] or run)


def last_done(context: Context, *verbs: str) -> Job | None:
    """The last job of these verbs that went well for the run of the scene's project in this session."""
    folder, run = project_folder(context), context.scene.fieldwork.run
    done = (job for job in reversed(queue.finished) if job.verb in verbs and job.state == "done" and job.result)
    return next((job for job in done if job.project == folder and job.params.get("run", "main") == run), None)


def render(context: Context) -> State:
    last = last_done(context, "render")
    if last is None or last.result is None:
        return State(False)
    count = sum(str(path).endswith(".exr") for path in last.result["frames"])
    return State(True, t("{} images", count) if count != 1 else t("1 image"))


def rendered(context: Context) -> list[Path]:
    """The pictures that were rendered last."""
    last = last_done(context, "render")
    files = [Path(path) for path in last.result["frames"]] if last is not None and last.result else []
    return [path for path in files if path.suffix == ".png"]


def mesh(context: Context) -> State:
    result = snapshot.last_result(project_folder(context), "mesh", context.scene.fieldwork.run)
    return State(True, t("{} faces", in_short(result.get("faces", 0)))) if result else State(False)


def measures(context: Context) -> dict[str, Any] | None:
    """What was measured of the mesh of the scene's run."""
    folder, run = project_folder(context), context.scene.fieldwork.run
    return snapshot.cached_json(folder / "exports" / run / "measures.json") if folder else None


def measure(context: Context) -> State:
    known = measures(context)
    if not known:
        return State(False)
    count = len(known.get("classes", []))
    if not count:
        return State(True)  # the whole surface
    return State(True, t("{} classes", count) if count != 1 else t("1 class"))


def export(context: Context) -> State:
    file = exported(context)
    return State(True, file.name) if file is not None else State(False)


def exported(context: Context) -> Path | None:
    """The file that was written last."""
    last = last_done(context, "blend", "export")
    if last is None or last.result is None:
        return None
    return Path(last.result["file"] if last.verb == "blend" else last.result["files"][0])


def engine(context: Context) -> State:
    if machine.engine_python() is None:
        return State(False, t("not installed"))
    running = queue.link is not None and queue.link.alive
    return State(running, t("running") if running else "")


def in_short(count: int) -> str:
    """A number in few letters: 950, 54 k, 1.2 M."""
    if count < 1000:
        return str(count)
    return f"{count / 1e3:.0f} k" if count < 999_500 else f"{count / 1e6:.1f} M"


def live(context: Context) -> State:
    count = len({part.field for part in fields.all_parts(context.scene)})
    return State(count > 0, str(count) if count else "")
