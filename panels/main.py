"""The main panel of the tab: the project, what is running, the next step; and the status bar."""

from __future__ import annotations

from typing import NamedTuple

import bpy
from bpy.types import Context, STATUSBAR_HT_header, UILayout

from ..addon import machine
from ..addon.jobs.queue import queue
from ..addon.project import edits, runs, snapshot
from ..addon.project.recent import recent
from ..addon.text import t
from ..operators.base import need_project_folder
from ..operators.reconstruct import need_source
from .base import FieldworkPanel, draw_job, draw_outcome, draw_wrapped, progress_text, reuse_text, text_width
from .menus import draw_recent
from .states import project_folder

BIG = 1.5  # height of the button that leads on, in rows
FEW = 5  # recent projects shown where none is open


class Step(NamedTuple):
    """One thing to do: a button. `text` replaces the operator's own name; `resume` is handed to the training."""

    operator: str
    icon: str
    text: str = ""
    resume: bool = False


def next_step(context: Context) -> Step | None:
    """The one obvious next thing to do; None while something runs."""
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    if queue.current is not None:
        return None
    if snapshot.absence(settings):
        return Step("fieldwork.locate_project", "FILE_FOLDER")
    if not snapshot.has_project(folder):
        return Step("fieldwork.new", "IMAGE_DATA") if settings.photos else Step("fieldwork.open", "FILE_FOLDER")
    if not snapshot.has_poses(folder):
        return Step("fieldwork.poses", "CAMERA_DATA")
    if runs.can_resume(folder, settings.run):
        return Step("fieldwork.train", "PLAY", "Resume Training", resume=True)
    if not runs.has_run(folder, settings.run):
        return Step("fieldwork.train", "PLAY")
    if not snapshot.last_result(folder, "mesh", settings.run):
        return Step("fieldwork.mesh", "MESH_DATA")
    return Step("fieldwork.import_scene", "SCENE_DATA")


def offers_reconstruct(context: Context) -> bool:
    """Whether one button can take the photos all the way: until there is a mesh, and where the photos are known."""
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    idle = queue.current is None and need_project_folder(context) is None
    return idle and need_source(context) is None and not snapshot.last_result(folder, "mesh", settings.run)


class FIELDWORK_PT_main(FieldworkPanel):
    bl_label = "Fieldwork"

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        if machine.engine_python() is None:
            box = layout.box()
            draw_wrapped(box, t("The engine is not installed yet."), text_width(context), icon="INFO")
            box.operator("fieldwork.open_preferences", text=t("Install Engine…"), icon="IMPORT")
        folder = project_folder(context)
        row = layout.row(align=True)
        row.menu("FIELDWORK_MT_recent", text="", icon="DOWNARROW_HLT")
        row.prop(settings, "project", text="")
        if snapshot.has_project(folder):
            row.operator("wm.path_open", text="", icon="WINDOW").filepath = str(folder)
        absence = snapshot.absence(settings)
        if absence:
            draw_wrapped(layout, absence, text_width(context), icon="ERROR")
        elif settings.project and not snapshot.has_project(project_folder(context)):
            note = layout.row()
            note.active = False
            note.label(text=t("New project"))
        failed = edits.failed()
        if failed:
            draw_edits(layout, context, failed)
        job = queue.current
        if job is not None:
            draw_job(layout, job)
            if job.project is not None and job.project != project_folder(context):
                note = layout.row()
                note.active = False
                note.label(text=t("for {}", job.project.name))
            for waiting in queue.waiting:
                if waiting is not job:
                    draw_job(layout, waiting)
        outcome = queue.outcome
        if outcome is not None:
            draw_outcome(layout, context, outcome)
        last = queue.last
        if last is not None and last.verb == "reconstruct" and last.state == "done" and job is None:
            for text in reuse_text(last.result or {}):
                draw_wrapped(layout, text, text_width(context), icon="CHECKMARK")
        step = next_step(context)
        if step is None:
            return
        whole = offers_reconstruct(context)
        if whole:
            row = layout.row()
            row.scale_y = BIG
            row.operator("fieldwork.reconstruct", icon="SHADERFX")
        row = layout.row()
        row.scale_y = 1.0 if whole else BIG
        text = {"text": step.text} if step.text else {}
        button = row.operator(step.operator, icon=step.icon, **text)
        if step.resume:
            button.resume = True
        if not settings.project and recent():
            layout.label(text=t("Recent Projects"))
            draw_recent(layout.column(align=True), FEW)


def draw_edits(layout: UILayout, context: Context, failed: list[edits.Edit]) -> None:
    """Edits that the engine could not take: why, and what to do."""
    texts = {
        "classes": t("The edited classes of “{}” are not saved yet."),
        "region": t("The training region of “{}” is not saved yet."),
    }
    box = layout.box()
    for edit in failed:
        text = f"{texts[edit.verb].format(edit.folder.name)} {edit.error}"
        draw_wrapped(box, text, text_width(context) - 4, icon="ERROR")
    row = box.row()
    row.operator("fieldwork.save_edits", text=t("Try Again"))
    row.operator("fieldwork.discard_edits", text=t("Discard"))


def draw_status(self: STATUSBAR_HT_header, context: Context) -> None:
    job = queue.current
    if job is None:
        return
    row = self.layout.row(align=True)
    row.ui_units_x = 14
    row.progress(factor=job.fraction or 0.0, text=t("Fieldwork: {}", progress_text(job)), type="BAR")
    row.operator("fieldwork.cancel", text="", icon="X")


CLASSES = [FIELDWORK_PT_main]


def register() -> None:
    bpy.types.STATUSBAR_HT_header.append(draw_status)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(draw_status)
