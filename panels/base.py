"""What the panels share: the tab, and the look of a job."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bpy.types import Context, Panel, UILayout

from ..addon.jobs.job import Job
from ..addon.text import t
from .states import State

MOST_WARNINGS = 3  # of a job in the panel


class FieldworkPanel(Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Fieldwork"


class StepPanel(FieldworkPanel):
    """A step of the way from photos to a model, below the main panel."""

    bl_parent_id = "FIELDWORK_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    @staticmethod
    def state(context: Context) -> State:
        """What the header says of the step."""
        raise NotImplementedError

    def draw_header_preset(self, context: Context) -> None:
        draw_state(self.layout, self.state(context))


def draw_state(layout: UILayout, state: State) -> None:
    """The state of a step at the right of its header."""
    row = layout.row(align=True)
    row.active = state.done
    row.label(text=state.text, icon="CHECKMARK" if state.done else "NONE", translate=False)


def columns(layout: UILayout) -> UILayout:
    """A column with names left and values right."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    return column


def duration(seconds: float | None) -> str:
    """Seconds as people say them: 8 s, 3:05 min, 2:10 h."""
    if seconds is None:
        return ""
    seconds = max(0, round(seconds))
    if seconds < 60:
        return t("{} s", seconds)
    if seconds < 3600:
        return t("{}:{:02} min", seconds // 60, seconds % 60)
    return t("{}:{:02} h", seconds // 3600, seconds % 3600 // 60)


def progress_text(job: Job) -> str:
    """What the job is at, in one line."""
    if job.state == "cancelling":
        return t("Stopping…")
    parts = [job.stage or job.title]
    if job.fraction is not None and job.state == "running":
        parts.append(f"{job.fraction:.0%}")
    if job.eta is not None:
        parts.append(t("{} left", duration(job.eta)))
    return " · ".join(parts)


def draw_job(layout: UILayout, job: Job) -> None:
    """A running or waiting job: a bar with its estimate, and a button that stops it."""
    row = layout.row(align=True)
    row.progress(factor=job.fraction or 0.0, text=progress_text(job), type="BAR")
    row.operator("fieldwork.cancel", text="", icon="X").job = job.id
    if job.state != "queued":
        # Also without a message: panels that come and go make all below them slide.
        small = layout.row()
        small.active = False
        small.label(text=job.message or " ")


def draw_wrapped(layout: UILayout, text: str, width: int, icon: str = "NONE") -> None:
    """A text over several lines: labels do not wrap."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    for number, line in enumerate(textwrap.wrap(text, width)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


def text_width(context: Context) -> int:
    """Characters that fit into the sidebar beside an icon."""
    scale = context.preferences.system.ui_scale
    return max(20, int((context.region.width / scale - 60) / 6.3)) if context.region else 40


def verdict_of(result: dict[str, Any]) -> tuple[str, bool] | None:
    """What a stage says of its own result: the first sentence, and whether it failed; None where it says nothing."""
    judged = result.get("verdict") or {}
    reasons = judged.get("reasons") or []
    return (str(reasons[0]), judged.get("level") == "failed") if reasons else None


def draw_verdict(layout: UILayout, context: Context, result: dict[str, Any]) -> None:
    """What a stage says of its own result, red where that failed."""
    judged = verdict_of(result)
    if judged is not None:
        box = layout.box()
        box.alert = judged[1]
        draw_wrapped(box, judged[0], text_width(context) - 4, icon="ERROR" if judged[1] else "INFO")


def with_labels(text: str, context: Context) -> str:
    """A message of the engine in which options of the command line are named as the panels name them: “Keep Exposures”
    for --keep-exposure. What the panels do not have stays as it is."""
    settings = context.scene.fieldwork.bl_rna.properties

    def label(option: re.Match[str]) -> str:
        name = option[1].replace("-", "_")
        found = settings.get(name) or settings.get(f"pose_{name}")
        return f"“{t(found.name)}”" if found else option[0]

    return re.sub(r"--([a-z]+(?:-[a-z]+)*)", label, text)


def draw_outcome(layout: UILayout, context: Context, job: Job) -> None:
    """A job that failed, or has something to say: what happened, what to do, and the report."""
    width, box = text_width(context) - 4, layout.box()
    if job.error is not None:
        draw_wrapped(box, with_labels(job.error.message, context), width, icon="ERROR")
        if job.error.hint:
            draw_wrapped(box, with_labels(job.error.hint, context), width, icon="INFO")
    else:
        for warning in job.warnings[:MOST_WARNINGS]:
            draw_wrapped(box, with_labels(warning, context), width, icon="INFO")
        if len(job.warnings) > MOST_WARNINGS:
            box.label(text=t("{} more in the report", len(job.warnings) - MOST_WARNINGS), icon="BLANK1")
    row = box.row()
    row.operator("fieldwork.copy_report", icon="COPYDOWN")
    row.operator("fieldwork.dismiss")


STAGES = {
    "new": "photos",
    "poses": "poses",
    "train": "training",
    "evaluate": "measures",
    "mesh": "mesh",
    "render": "renders",
    "blend": ".blend",
}


def reuse_text(result: dict[str, Any]) -> list[str]:
    """What a reconstruction kept of an earlier one, and what it did anew and why, a sentence each."""

    def stages(verbs: Iterable[str]) -> str:
        return ", ".join(t(STAGES.get(verb, verb)) for verb in verbs)

    reused, redone = result.get("reused") or [], result.get("redone") or {}
    kept = [t("Kept from before: {}.", stages(reused))] if reused else []
    return kept + [t("Done anew: {}: {}.", stages([verb]), why) for verb, why in redone.items()]


def open_folder(layout: UILayout, folder: Path | None) -> None:
    """A button that shows a folder in the system's file browser, where there is one."""
    if folder is not None and folder.is_dir():
        layout.operator("wm.path_open", text=t("Open Folder"), icon="FILE_FOLDER").filepath = str(folder)
