"""The Mesh panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon.project import runs, snapshot
from ..addon.text import t
from .base import StepPanel, columns, draw_verdict, project_folder


class FIELDWORK_PT_mesh(StepPanel):
    bl_label = "Mesh"

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        result = snapshot.last_result(folder, "mesh", settings.run)
        if result:
            closed = t("{:,} triangles, closed") if result.get("watertight") else t("{:,} triangles, open")
            self.draw_state(True, closed.format(result.get("faces", 0)))
            draw_verdict(layout, context, result)
        elif runs.has_run(folder, settings.run):
            self.draw_state(False, t("Ready to extract"))
        else:
            self.draw_state(False, t("Run “{}” is not trained yet", settings.run))
        column = columns(layout)
        column.prop(settings, "mesh_region")
        for name in ("resolution", "detail", "watertight", "faces", "lods", "texture"):
            column.prop(settings, name)
        if settings.texture != "0":
            column.prop(settings, "texture_kind")
        column.prop(settings, "mesh_file")
        if settings.mesh_file:
            column.prop(settings, "split")
        column.prop(settings, "turntable")
        layout.operator("fieldwork.mesh", icon="MESH_DATA")
        row = layout.row(align=True)
        row.operator("fieldwork.import_scene", icon="SCENE_DATA")
        row.operator("fieldwork.pick_surface", icon="EYEDROPPER")


CLASSES = [FIELDWORK_PT_mesh]
