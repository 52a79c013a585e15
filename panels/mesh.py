"""The Mesh panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon.project import snapshot
from ..addon.text import t
from . import states
from .base import StepPanel, columns, draw_verdict, open_folder
from .states import project_folder


class FIELDWORK_PT_mesh(StepPanel):
    bl_label = "Mesh"
    state = staticmethod(states.mesh)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        result = snapshot.last_result(folder, "mesh", settings.run)
        if result:
            closed = t("{:,} triangles, closed") if result.get("watertight") else t("{:,} triangles, open")
            layout.label(text=closed.format(result.get("faces", 0)))
            if result.get("unseen", 0) >= 0.0005:  # what would not be shown as 0.0%
                layout.label(text=t("{:.1%} of its area is a guess").format(result["unseen"]))
            draw_verdict(layout, context, result)
        column = columns(layout)
        column.prop(settings, "mesh_region")
        for name in ("resolution", "detail", "watertight"):
            column.prop(settings, name)
        if not settings.watertight:
            column.prop(settings, "close_gaps")
        row = column.row(align=True, heading=t("Faces"))
        row.prop(settings, "all_faces", toggle=True)
        if not settings.all_faces:
            row.prop(settings, "faces", text="")
        for name in ("lods", "texture"):
            column.prop(settings, name)
        if settings.texture != "0":
            column.prop(settings, "texture_kind")
        column.prop(settings, "mesh_file")
        if settings.mesh_file:
            column.prop(settings, "split")
        column.prop(settings, "turntable")
        layout.operator("fieldwork.mesh", icon="MESH_DATA")
        if result:
            layout.operator("fieldwork.turntable", icon="RENDERLAYERS")
        columns(layout).prop(settings, "scene_split")
        row = layout.row(align=True)
        row.operator("fieldwork.import_scene", icon="SCENE_DATA")
        row.operator("fieldwork.pick_surface", icon="EYEDROPPER")
        if folder is not None:
            open_folder(layout, folder / "exports" / settings.run)


CLASSES = [FIELDWORK_PT_mesh]
