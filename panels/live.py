"""Fields in the scene: the Live View panel, and the properties of the render engine."""

from __future__ import annotations

import bpy
from bpy.types import Context, Panel, UILayout, UIList

from ..addon.live import fields, hint
from ..addon.live.engine import ENGINE
from ..addon.live.settings import look_name
from ..addon.project import snapshot
from ..addon.text import t
from ..operators.live import active_field
from . import states
from .base import StepPanel, columns, draw_wrapped, text_width


class FIELDWORK_UL_field_classes(UIList):
    """Color, name and visibility of each class of a field."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row(align=True)
        color = row.row()
        color.ui_units_x = 1.2
        color.prop(item, "color", text="")
        row.label(text=item.name, translate=False)
        row.operator("fieldwork.isolate_class", text="", icon="SOLO_OFF", emboss=False).index = index
        row.prop(item, "visible", text="", icon="HIDE_OFF" if item.visible else "HIDE_ON", emboss=False)


class FIELDWORK_UL_field_things(UIList):
    """Name and visibility of each thing of a field."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row(align=True)
        if item.tint > 0:
            color = row.row()
            color.ui_units_x = 1.2
            color.prop(item, "color", text="")
        row.label(text=item.name, translate=False)
        row.prop(item, "visible", text="", icon="HIDE_OFF" if item.visible else "HIDE_ON", emboss=False)


class FIELDWORK_PT_live(StepPanel):
    bl_label = "Live View"
    state = staticmethod(states.live)

    def draw(self, context: Context) -> None:
        layout, live = self.layout, context.scene.fieldwork_live
        layout.operator("fieldwork.add_field", icon="ADD")
        obj = active_field(context)
        if obj is not None:
            draw_field(layout, context, obj)
        column = columns(layout)
        column.prop(live, "viewport")
        row = column.row()
        row.active = live.viewport
        row.prop(live, "quality")
        layout.operator("fieldwork.setup_compositor", icon="NODE_COMPOSITING")
        layout.operator("fieldwork.catch_shadows", icon="LIGHT_SUN")


def draw_field(layout: UILayout, context: Context, obj) -> None:
    """What is set for a field of the scene, and why it is not to be seen, where it is not."""
    own = obj.fieldwork
    layout.prop(obj, "name", text="", icon="EMPTY_AXIS")
    layout.prop(own, "project", text="")
    for reason in why_not_drawn(context, own):
        draw_wrapped(layout.box(), reason, text_width(context) - 4, icon="INFO")
    row = layout.row(align=True)
    row.prop(own, "look", text=look_name(own.look), slider=True)
    if own.classes:
        layout.template_list("FIELDWORK_UL_field_classes", "", own, "classes", own, "class_index", rows=4)
        if 0 <= own.class_index < len(own.classes):
            column = columns(layout)
            column.prop(own.classes[own.class_index], "tint")
            column.prop(own.classes[own.class_index], "opacity")
    if own.things:
        draw_things(layout, context, own)
    if own.classes:
        layout.operator("fieldwork.refresh_field_classes", icon="FILE_REFRESH")
    row = layout.row(align=True)
    row.prop(own, "crop")
    row.operator("fieldwork.add_crop_box", text="", icon="ADD")


def draw_things(layout: UILayout, context: Context, own) -> None:
    """The things of a field, and how the chosen one is shown."""
    box = layout.box()
    box.label(text=t("Things of the Baked Field"))
    if reason := why_things_are_not_drawn(own):
        draw_wrapped(box, reason, text_width(context) - 6, icon="INFO")
    box.template_list("FIELDWORK_UL_field_things", "", own, "things", own, "thing_index", rows=3)
    if 0 <= own.thing_index < len(own.things):
        entry = own.things[own.thing_index]
        column = columns(box)
        column.prop(entry, "tint")
        column.prop(entry, "color")
        column.prop(entry, "opacity")
        row = box.row(align=True)
        row.operator("fieldwork.place_thing", icon="EMPTY_ARROWS")
        row.operator("fieldwork.place_thing", text=t("Copy Thing"), icon="DUPLICATE").copy = True
    box.operator("fieldwork.save_field_edits", icon="EXPORT")


def why_not_drawn(context: Context, own) -> list[str]:
    """Sentences that say why the viewport does not show the field."""
    from ..addon.live import voxels  # not at the top: enabling the extension must be quick
    from ..addon.live.training import trainings
    from ..addon.live.viewport import viewport

    reasons = []
    if hint.lacks_overlays(context.space_data):
        return [t("Show overlays to see the field: this version of Blender needs them.")]
    folder = fields.folder_of(own)
    if folder is not None and trainings.run_of(folder) == own.run:
        return [t("In training: shown as it converges, coarse where the view moves.")]
    if folder is not None and not snapshot.has_project(folder):
        return [t("There is no project in {}: choose the folder that holds its project.json.", folder)]
    baked = voxels.baked(folder, own.run) if folder is not None else None
    if baked is None:
        reasons.append(t("Bake the field to see it here: the viewport draws baked fields."))
    elif viewport.error:
        reasons.append(t("The field cannot be drawn: {}", viewport.error))
    elif (asset := viewport.assets.get(baked.key)) is not None and asset.error:
        reasons.append(t("The baked field cannot be read: {} Bake it again.", asset.error))
    return reasons


def why_things_are_not_drawn(own) -> str:
    """A sentence that says why the viewport does not show edits of things; empty where it does, or there is nothing to edit in it.
    What is needed for that is asked for."""
    from ..addon.live import thing_texels, voxels

    project = fields.folder_of(own)
    baked = None if project is None or bpy.app.background else voxels.baked(project, own.run)
    if baked is None:
        return ""
    known = thing_texels.answers.of(baked, project, own.run)
    if known.waits:
        return t("Telling the things apart: soon the viewport shows how they are edited.")
    return t("Only renders show how things are edited: {}", known.error) if known.error else ""


class _RenderProperties(Panel):
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    COMPAT_ENGINES = {ENGINE}

    @classmethod
    def poll(cls, context: Context) -> bool:
        return context.engine in cls.COMPAT_ENGINES


class FIELDWORK_PT_engine_settings(_RenderProperties):
    bl_label = "Field"
    bl_context = "render"

    def draw(self, context: Context) -> None:
        live = context.scene.fieldwork_live
        column = columns(self.layout)
        column.prop(live, "source")
        column.prop(live, "samples")
        column.prop(context.scene.render, "filter_size")
        column.prop(live, "objects_hide")
        column.prop(context.scene.render, "film_transparent")


class FIELDWORK_PT_engine_motion_blur(_RenderProperties):
    bl_label = "Motion Blur"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}

    def draw_header(self, context: Context) -> None:
        self.layout.prop(context.scene.render, "use_motion_blur", text="")

    def draw(self, context: Context) -> None:
        render = context.scene.render
        column = columns(self.layout)
        column.active = render.use_motion_blur
        column.prop(render, "motion_blur_position")
        column.prop(render, "motion_blur_shutter")


class FIELDWORK_PT_engine_passes(_RenderProperties):
    bl_label = "Passes"
    bl_context = "view_layer"

    def draw(self, context: Context) -> None:
        layer = context.view_layer
        column = columns(self.layout)
        for name in ("use_pass_z", "use_pass_position", "use_pass_normal"):
            column.prop(layer, name)
        for name in ("use_class_index", "use_class_color", "use_confidence"):
            column.prop(layer.fieldwork, name)
        column.separator()
        column.prop(layer, "use_pass_cryptomatte_object", text=t("Cryptomatte of Instances"))
        column.prop(layer, "use_pass_cryptomatte_material", text=t("Cryptomatte of Classes"))
        column.prop(layer, "use_pass_cryptomatte_asset", text=t("Cryptomatte of Fields"))
        column.prop(layer, "pass_cryptomatte_depth", text=t("Levels"))


CLASSES = [
    FIELDWORK_UL_field_classes,
    FIELDWORK_UL_field_things,
    FIELDWORK_PT_live,
    FIELDWORK_PT_engine_settings,
    FIELDWORK_PT_engine_motion_blur,
    FIELDWORK_PT_engine_passes,
]
