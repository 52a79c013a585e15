"""The Train panel: preset and time, the curve and the preview while it runs, the runs there are."""

from __future__ import annotations

from bpy.types import Context, UILayout

from ..addon.jobs.job import Job
from ..addon.jobs.queue import queue
from ..addon.pictures import thumbnails
from ..addon.project import runs, snapshot
from ..addon.text import t
from .base import FieldworkPanel, StepPanel, columns, draw_verdict, duration, project_folder


def training_job(context: Context) -> Job | None:
    """The training of this scene's project: the one under way, else the last that ended."""
    folder = project_folder(context)
    candidates = [queue.running, queue.followed, *reversed(queue.finished)]
    return next((j for j in candidates if j and j.verb in ("train", "reconstruct") and j.project == folder), None)


class FIELDWORK_PT_train(StepPanel):
    bl_label = "Train"

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        job = training_job(context)
        active = job is not None and job.active
        checkpoint = runs.can_resume(folder, settings.run)
        if active:
            self.draw_state(True, t("Run “{}” is training", settings.run))
        elif checkpoint:
            self.draw_state(False, t("Run “{}” is paused", settings.run))
        elif runs.has_run(folder, settings.run):
            self.draw_state(True, t("Run “{}” is trained", settings.run))
            draw_verdict(layout, context, snapshot.last_result(folder, "train", settings.run))
        else:
            self.draw_state(False, t("Run “{}” is not trained yet", settings.run))
        row = layout.row(align=True)
        row.menu("FIELDWORK_MT_train_presets", text=t("My Presets"))
        row.operator("fieldwork.train_preset_add", text="", icon="ADD")
        row.operator("fieldwork.train_preset_add", text="", icon="REMOVE").remove_active = True
        column = columns(layout)
        column.prop(settings, "preset")
        column.prop(settings, "run")
        column.prop(settings, "hold_out")
        if not active:
            estimate = runs.time_estimate(folder, settings)
            text = t("About {}, as the last time", duration(estimate)) if estimate else ""
            if settings.time_limit > 0:
                text = t("Ends after {}", duration(settings.time_limit))
            if text:
                note = layout.row()
                note.active = False
                note.label(text=text, icon="TIME")
        if active:
            layout.operator("fieldwork.cancel", text=t("Pause"), icon="PAUSE").job = job.id
        else:
            row = layout.row(align=True)
            row.operator("fieldwork.train", text=t("Restart") if checkpoint else t("Train"), icon="PLAY").resume = False
            if checkpoint:
                row.operator("fieldwork.train", text=t("Resume"), icon="PLAY").resume = True
        if job is not None:
            draw_curve(layout, job)


class FIELDWORK_PT_train_options(FieldworkPanel):
    bl_label = "Options"
    bl_parent_id = "FIELDWORK_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        column = columns(self.layout)
        for name in ("time_limit", "steps", "settings"):
            column.prop(context.scene.fieldwork, name)


class FIELDWORK_PT_runs(FieldworkPanel):
    bl_label = "Runs"
    bl_parent_id = "FIELDWORK_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        names = runs.runs(folder)
        if not names:
            layout.label(text=t("No runs yet"))
        for name in names:
            row = layout.row(align=True)
            chosen = name == settings.run
            row.operator("fieldwork.use_run", text=name, icon="RADIOBUT_ON" if chosen else "RADIOBUT_OFF").run = name
            row.label(text=runs.quality(folder, name))
        layout.operator("fieldwork.evaluate", icon="VIEWZOOM")


def draw_curve(layout: UILayout, job: Job) -> None:
    """Loss and PSNR so far, and the newest picture of a held-out photo."""
    icon = thumbnails.curve_icon(job.id, job.curve)
    if icon:
        layout.template_icon(icon_value=icon, scale=7.0)
    if job.latest:
        layout.label(text=t("Step {:,}", job.latest.get("step", 0)))
        row = layout.row()
        loss, psnr = job.latest.get("loss"), job.latest.get("psnr")
        # The colors are those of the two lines.
        row.label(text=t("PSNR –") if psnr is None else t("PSNR {:.1f} dB", psnr), icon="COLLECTION_COLOR_05")
        row.label(text=t("Loss –") if loss is None else t("Loss {:.4f}", loss), icon="COLLECTION_COLOR_02")
    if job.preview:
        preview = thumbnails.picture(job.preview, job.preview_count)
        if preview:
            whole = job.params.get("holdout") == 0
            layout.label(text=t("Render of a photo") if whole else t("Render of a held-out photo"))
            layout.template_icon(icon_value=preview, scale=9.0)


CLASSES = [FIELDWORK_PT_train, FIELDWORK_PT_train_options, FIELDWORK_PT_runs]
