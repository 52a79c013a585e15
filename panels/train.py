"""The Train panel: preset and time, the curve and the preview while it runs, the runs there are."""

from __future__ import annotations

from pathlib import Path

from bl_ui.utils import PresetPanel
from bpy.types import Context, Panel, UILayout

from ..addon.jobs import computer
from ..addon.jobs.job import Job
from ..addon.pictures import thumbnails
from ..addon.project import runs, snapshot
from ..addon.text import t
from . import states
from .base import FieldworkPanel, StepPanel, columns, draw_verdict, duration
from .states import project_folder


class FIELDWORK_PT_train_presets(PresetPanel, Panel):
    bl_label = "Training Presets"
    preset_subdir = "fieldwork/train"
    preset_operator = "script.execute_preset"
    preset_add_operator = "fieldwork.train_preset_add"


class FIELDWORK_PT_train(StepPanel):
    bl_label = "Train"
    state = staticmethod(states.train)

    def draw_header_preset(self, context: Context) -> None:
        super().draw_header_preset(context)
        FIELDWORK_PT_train_presets.draw_panel_header(self.layout)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        job = states.training_job(context)
        active = job is not None and job.active
        checkpoint = runs.can_resume(folder, settings.run)
        if not active and not checkpoint and runs.has_run(folder, settings.run):
            draw_verdict(layout, context, snapshot.last_result(folder, "train", settings.run))
        column = columns(layout)
        column.enabled = not active
        column.prop(settings, "preset")
        column.prop(settings, "run")
        column.prop(settings, "hold_out")
        if not active:
            draw_estimate(layout, context)
        if active:
            layout.operator("fieldwork.cancel", text=t("Pause"), icon="PAUSE").job = job.id
        else:
            row = layout.row(align=True)
            if checkpoint:
                row.operator("fieldwork.train", text=t("Resume"), icon="PLAY").resume = True
            again, icon = (t("Restart"), "FILE_REFRESH") if checkpoint else (t("Train"), "PLAY")
            row.operator("fieldwork.train", text=again, icon=icon).resume = False
        if job is not None:
            draw_curve(layout, job)


class FIELDWORK_PT_train_options(FieldworkPanel):
    bl_label = "Options"
    bl_parent_id = "FIELDWORK_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        column = columns(self.layout)
        column.enabled = not states.training(context)
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
        draw_verdict(layout, context, runs.evaluation(folder, settings.run))
        layout.operator("fieldwork.evaluate", icon="VIEWZOOM")


def draw_estimate(layout: UILayout, context: Context) -> None:
    """Before a training: on what, and about how long."""
    settings, facts = context.scene.fieldwork, computer.known()
    lines = [(t("On {}", computer.title(facts)), "DESKTOP")] if facts else []
    if settings.time_limit > 0:
        lines.append((t("Ends after {}", duration(settings.time_limit)), "TIME"))
    elif estimate := runs.time_estimate(project_folder(context), settings):
        lines.append((t("About {}, as the last time", duration(estimate)), "TIME"))
    elif rough := computer.rough_seconds(facts, settings.preset, settings.steps):
        lines.append((t("Roughly {}", duration(rough)), "TIME"))
    column = layout.column(align=True)
    column.active = False
    for text, icon in lines:
        column.label(text=text, icon=icon)
    if not facts:
        layout.operator("fieldwork.doctor", text=t("How Fast Is This Computer?"), icon="DESKTOP")


def draw_curve(layout: UILayout, job: Job) -> None:
    """Loss and PSNR so far, and the newest picture of a held-out photo."""
    icon = thumbnails.curve_icon(job.id, job.curve)
    if icon:
        layout.template_icon(icon_value=icon, scale=10.0)
    if job.latest:
        layout.label(text=t("Step {:,}", job.latest.get("step", 0)))
        row = layout.row()
        loss, psnr = job.latest.get("loss"), job.latest.get("psnr")
        # The colors are those of the two lines.
        row.label(text=t("PSNR –") if psnr is None else t("PSNR {:.1f} dB", psnr), icon="COLLECTION_COLOR_05")
        row.label(text=t("Loss –") if loss is None else t("Loss {:.4f}", loss), icon="COLLECTION_COLOR_02")
    # A reconstruction has other pictures too, such as that of the cameras.
    if job.preview and "runs" in Path(job.preview).parts:
        preview = thumbnails.picture(job.preview, job.preview_count)
        if preview:
            whole = job.params.get("holdout") == 0
            layout.label(text=t("Render of a photo") if whole else t("Render of a held-out photo"))
            layout.template_icon(icon_value=preview, scale=9.0)


CLASSES = [FIELDWORK_PT_train_presets, FIELDWORK_PT_train, FIELDWORK_PT_train_options, FIELDWORK_PT_runs]
