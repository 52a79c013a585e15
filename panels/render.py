"""The Render panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon.jobs.queue import queue
from ..addon.project import runs
from ..addon.text import t
from .base import StepPanel, columns, project_folder


class FIELDWORK_PT_render(StepPanel):
    bl_label = "Render"

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        last = next((j for j in reversed(queue.finished) if j.verb == "render" and j.state == "done"), None)
        if last is not None:
            count = sum(str(path).endswith(".exr") for path in (last.result or {}).get("frames", []))
            self.draw_state(True, t("{} images rendered", count) if count != 1 else t("1 image rendered"))
        elif runs.has_run(folder, settings.run):
            self.draw_state(False, t("Ready to render"))
        else:
            self.draw_state(False, t("Run “{}” is not trained yet", settings.run))
        column = columns(layout)
        column.prop(settings, "render_from")
        if settings.render_from == "orbit":
            column.prop(settings, "orbit")
        column.prop(settings, "size")
        layout.column_flow(columns=3, align=True).prop(settings, "passes")
        columns(layout).prop(settings, "show_as")
        layout.operator("fieldwork.render", icon="RENDER_STILL")


CLASSES = [FIELDWORK_PT_render]
