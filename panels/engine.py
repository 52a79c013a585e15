"""The Engine panel: what it runs on, what it uses, stopping it, its log."""

from __future__ import annotations

from bpy.types import Context

from ..addon import machine
from ..addon.jobs.queue import queue
from ..addon.text import t
from . import states
from .base import StepPanel, draw_wrapped, text_width


class FIELDWORK_PT_engine(StepPanel):
    bl_label = "Engine"
    state = staticmethod(states.engine)

    def draw(self, context: Context) -> None:
        layout = self.layout
        running = queue.link is not None and queue.link.alive
        if not running:
            layout.label(text=t("Starts when needed") if machine.engine_python() else t("Not installed"))
        if running and queue.facts:
            memory = t("Memory {:.1f} GB", queue.facts.get("memory_mb", 0) / 1000)
            gpu = queue.facts.get("gpu_memory_mb")
            layout.label(text=memory + (t(", GPU {:.1f} GB", gpu / 1000) if gpu is not None else ""), icon="MEMORY")
        report = queue.doctor
        if report:
            name = report.get("device_name") or ""
            layout.label(text=t("Device: {} {}", report.get("device", "?"), name).strip(), icon="DESKTOP")
            layout.label(text=t("{:.0f} GB free on disk", report.get("free_disk_gb", 0)), icon="DISK_DRIVE")
            for problem in report.get("problems", []):
                draw_wrapped(layout, problem, text_width(context), icon="ERROR")
        grid = layout.grid_flow(columns=2, align=True, even_columns=True)
        grid.operator("fieldwork.doctor", text=t("Check"))
        grid.operator("fieldwork.stop_engine", text=t("Stop"))
        grid.operator("fieldwork.open_log", text=t("Log"))
        grid.operator("fieldwork.copy_report")
        layout.operator("fieldwork.detach", text=t("Keep Running Without Blender"), icon="UNLINKED")
        layout.operator("fieldwork.open_preferences", text=t("Preferences…"), icon="PREFERENCES")


CLASSES = [FIELDWORK_PT_engine]
