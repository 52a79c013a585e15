"""The main panel of the tab: the project, what is running, the next step; and the status bar."""

from __future__ import annotations

import bpy
from bpy.types import Context, STATUSBAR_HT_header

from ..addon import jobs, preferences, state
from .base import FieldworkPanel, draw_error, draw_job, draw_wrapped, progress_text, project_folder, text_width


def next_step(context: Context) -> tuple[str, str] | None:
    """Operator and icon of the one obvious next thing to do; None when something runs or all is done."""
    settings = context.scene.fieldwork
    folder = state.folder_of(settings)
    if jobs.queue.current is not None:
        return None
    if not state.has_project(folder):
        return ("fieldwork.new", "IMAGE_DATA") if settings.photos else ("fieldwork.open", "FILE_FOLDER")
    if not state.has_poses(folder):
        return "fieldwork.poses", "CAMERA_DATA"
    if not state.has_run(folder, settings.run):
        return "fieldwork.train", "PLAY"
    return "fieldwork.mesh", "MESH_DATA"


class FIELDWORK_PT_main(FieldworkPanel):
    bl_label = "Fieldwork"

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        if preferences.engine_python() is None:
            box = layout.box()
            draw_wrapped(box, "The engine is not installed yet.", text_width(context), icon="INFO")
            box.operator("fieldwork.open_preferences", text="Install Engine…", icon="IMPORT")
        row = layout.row(align=True)
        row.prop(settings, "project", text="")
        if settings.project and not state.has_project(project_folder(context)):
            note = layout.row()
            note.active = False
            note.label(text="New project")
        job = jobs.queue.current
        if job is not None:
            draw_job(layout, job)
            for waiting in jobs.queue.waiting:
                if waiting is not job:
                    draw_job(layout, waiting)
        last = jobs.queue.last
        if last is not None and last.state == "failed":
            draw_error(layout, context, last)
        step = next_step(context)
        if step is not None:
            row = layout.row()
            row.scale_y = 1.5
            row.operator(step[0], icon=step[1])


def draw_status(self: STATUSBAR_HT_header, context: Context) -> None:
    job = jobs.queue.current
    if job is None:
        return
    row = self.layout.row(align=True)
    row.ui_units_x = 14
    row.progress(factor=job.fraction or 0.0, text=f"Fieldwork: {progress_text(job)}", type="BAR")
    row.operator("fieldwork.cancel", text="", icon="X")


CLASSES = [FIELDWORK_PT_main]


def register() -> None:
    bpy.types.STATUSBAR_HT_header.append(draw_status)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(draw_status)
