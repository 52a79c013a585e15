"""Dataset from Scene, below Capture: the other way round, from a scene to photos."""

from __future__ import annotations

from bpy.types import Context, Panel

from ..addon.jobs.queue import queue
from ..addon.text import t
from .base import FieldworkPanel, draw_wrapped, text_width


class FIELDWORK_PT_dataset(FieldworkPanel, Panel):
    bl_label = "Dataset from Scene"
    bl_parent_id = "FIELDWORK_PT_capture"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        layout = self.layout
        draw_wrapped(
            layout,
            t("Photograph this scene with poses, labels and depth."),
            text_width(context),
            icon="RENDER_RESULT",
        )
        layout.operator_context = "INVOKE_DEFAULT"
        layout.operator("fieldwork.dataset", text=t("Dataset from Scene…"), icon="OUTLINER_OB_CAMERA")
        last = next((j for j in reversed(queue.finished) if j.verb == "dataset" and j.state == "done"), None)
        if last is not None and last.result:
            text = t("{} photos in {}", last.result["images"], last.result["folder"])
            draw_wrapped(layout, text, text_width(context), icon="CHECKMARK")


CLASSES = [FIELDWORK_PT_dataset]
