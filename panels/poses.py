"""The Poses panel: estimating the cameras, checking them photo by photo, up and scale, the training region."""

from __future__ import annotations

from bpy.types import Context, UIList

from ..addon.project import region, snapshot
from ..addon.scene import measured_line
from ..addon.text import t
from . import states
from .base import FieldworkPanel, StepPanel, columns, draw_verdict, draw_wrapped, text_width
from .capture import STATUS_ICONS
from .states import project_folder


class FIELDWORK_UL_poses(UIList):
    """One line for each photo: placed or not, points it sees, error in pixels."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row()
        row.active = item.status == "ok"
        row.label(text=item.name, icon=STATUS_ICONS.get(item.status, "QUESTION"))
        numbers = row.row()
        numbers.alignment = "RIGHT"
        if item.status == "ok" and item.points:
            numbers.label(text=t("{} pts, {:.2f} px", item.points, item.error_px))
        elif item.status != "ok":
            numbers.label(text=t("Not used") if item.status == "rejected" else t("Not placed"))


class FIELDWORK_PT_poses(StepPanel):
    bl_label = "Poses"
    state = staticmethod(states.poses)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        done = snapshot.has_poses(folder)
        column = columns(layout)
        column.enabled = not states.training(context)
        column.prop(settings, "pose_preset")
        row = layout.row(align=True)
        row.operator("fieldwork.poses", icon="CAMERA_DATA").restart = False
        if done:
            row.operator("fieldwork.poses", text=t("Start Over"), icon="FILE_REFRESH").restart = True
        if not (done and folder):
            return
        draw_verdict(layout, context, snapshot.last_result(folder, "poses"))
        layout.template_list("FIELDWORK_UL_poses", "poses", settings, "images", settings, "pose_index", rows=4)
        if 0 <= settings.pose_index < len(settings.images) and settings.images[settings.pose_index].reason:
            draw_wrapped(layout, settings.images[settings.pose_index].reason, text_width(context), icon="INFO")
        layout.operator("fieldwork.import_scene", text=t("Show in Scene"), icon="OUTLINER_OB_CAMERA")


class FIELDWORK_PT_poses_options(FieldworkPanel):
    bl_label = "Options"
    bl_parent_id = "FIELDWORK_PT_poses"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        settings = context.scene.fieldwork
        column = columns(self.layout)
        column.prop(settings, "keep_exposure")
        column.prop(settings, "pose_group")
        column.prop(settings, "scene_cameras")
        groups = snapshot.last_result(project_folder(context), "poses").get("groups", [])
        if len(groups) > 1:
            text = t("The photos fall into groups of {}.", ", ".join(map(str, groups)))
            draw_wrapped(self.layout, text, text_width(context), icon="INFO")


class FIELDWORK_PT_align(FieldworkPanel):
    bl_label = "Up and Scale"
    bl_parent_id = "FIELDWORK_PT_poses"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        frame = snapshot.frame(project_folder(context))
        if frame:
            known = t("Scale is set") if frame.get("scale_known") else t("Scale is unknown")
            layout.label(text=known, icon="CHECKMARK" if frame.get("scale_known") else "INFO")
        columns(layout).prop(settings, "up")
        for end in "ab":
            row = layout.row(align=True)
            name = row.row()
            name.ui_units_x = 0.8
            name.label(text=end.upper(), translate=False)
            row.prop(settings, f"point_{end}", text="")
            row.operator("fieldwork.pick_point", text="", icon="EYEDROPPER").end = end.upper()
            cursor = row.operator("fieldwork.pick_point", text="", icon="PIVOT_CURSOR")
            cursor.end, cursor.use_cursor = end.upper(), True
        now = measured_line.length(context.scene)
        if now is not None:
            layout.label(text=t("A to B as it is now: {:.4g} m", now), icon="DRIVER_DISTANCE")
        columns(layout).prop(settings, "distance")
        layout.operator("fieldwork.align", icon="ORIENTATION_GLOBAL")
        row = layout.row(align=True)
        for name, text, icon in (("ground", t("Level Ground"), "VIEW_ORTHO"), ("gps", t("From GPS"), "WORLD")):
            button = row.operator("fieldwork.align", text=text, icon=icon)
            button.up, button.use_scale = "auto", False
            setattr(button, name, True)


class FIELDWORK_PT_region(FieldworkPanel):
    bl_label = "Training Region"
    bl_parent_id = "FIELDWORK_PT_poses"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        layout = self.layout
        box = region.find(context.scene)
        draw_wrapped(
            layout,
            t("Move and scale the box in the viewport: the next training covers what lies inside.")
            if box
            else t("Everything the photos show is trained."),
            text_width(context),
            icon="CUBE",
        )
        layout.operator("fieldwork.crop_add", icon="ADD")
        layout.operator("fieldwork.crop_remove", icon="X")


CLASSES = [
    FIELDWORK_UL_poses,
    FIELDWORK_PT_poses,
    FIELDWORK_PT_poses_options,
    FIELDWORK_PT_align,
    FIELDWORK_PT_region,
]
