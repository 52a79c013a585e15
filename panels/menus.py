"""Fieldwork in Blender's menus, where operator search finds it too."""

from __future__ import annotations

import bpy
from bpy.types import Context, Menu, UILayout

from ..addon.project.recent import MOST, recent
from ..addon.text import t


class FIELDWORK_MT_steps(Menu):
    bl_label = "Fieldwork"

    def draw(self, context: Context) -> None:
        layout = self.layout
        layout.operator("fieldwork.open", text=t("Open Photos or Project…"), icon="FILE_FOLDER")
        layout.menu("FIELDWORK_MT_recent")
        layout.operator("fieldwork.import_dataset", text=t("Import Posed Data Set…"))
        layout.separator()
        layout.operator("fieldwork.reconstruct")
        layout.operator("fieldwork.new")
        layout.operator("fieldwork.poses")
        layout.operator("fieldwork.align")
        layout.operator("fieldwork.train").resume = False
        layout.operator("fieldwork.train", text=t("Resume Training")).resume = True
        layout.operator("fieldwork.evaluate").baked = False
        layout.operator("fieldwork.render").baked = False
        for name in ("label", "live", "mesh", "measure"):
            layout.menu(f"FIELDWORK_MT_{name}")
        layout.operator("fieldwork.report")
        layout.operator("fieldwork.import_scene")
        layout.operator("fieldwork.blend")
        layout.operator("fieldwork.export")
        layout.separator()
        layout.operator("fieldwork.dataset", text=t("Dataset from Scene…"))
        layout.operator("fieldwork.batch", text=t("Reconstruct Many…"))
        layout.operator("fieldwork.blocks", text=t("Reconstruct in Blocks…"))
        layout.operator("fieldwork.simulate", text=t("Simulate Capture…"))
        layout.separator()
        layout.operator("fieldwork.cancel")
        layout.operator("fieldwork.doctor")
        layout.operator("fieldwork.open_preferences", text=t("Preferences…"))


class FIELDWORK_MT_label(Menu):
    bl_label = "Label"

    def draw(self, context: Context) -> None:
        layout = self.layout
        layout.operator("fieldwork.label_photo")
        layout.operator("fieldwork.label_prepare")
        layout.operator("fieldwork.label_propagate")
        layout.operator("fieldwork.label_next")
        layout.operator("fieldwork.label_overlay")
        layout.operator("fieldwork.label_parts")
        layout.operator("fieldwork.label_carry").confirm = False
        layout.operator("fieldwork.label_carry", text=t("Confirm Carried Labels")).confirm = True
        layout.operator("fieldwork.label_accept")
        layout.operator("fieldwork.assist_embed")
        layout.operator("fieldwork.assist_segment")
        layout.operator("fieldwork.assist_suggest", text=t("Guess Classes…"))
        layout.operator("fieldwork.label_import", text=t("Import Labels…"))
        layout.operator("fieldwork.label_export", text=t("Export Labels…"))


class FIELDWORK_MT_live(Menu):
    bl_label = "Live View"

    def draw(self, context: Context) -> None:
        layout = self.layout
        layout.operator("fieldwork.bake")
        layout.operator("fieldwork.evaluate", text=t("Measure Baked Field")).baked = True
        layout.operator("fieldwork.render", text=t("Render Baked Field")).baked = True
        layout.operator("fieldwork.add_field")
        layout.operator("fieldwork.add_crop_box")
        layout.operator("fieldwork.setup_compositor")
        layout.operator("fieldwork.catch_shadows")


class FIELDWORK_MT_mesh(Menu):
    bl_label = "Mesh"

    def draw(self, context: Context) -> None:
        layout = self.layout
        layout.operator("fieldwork.mesh")
        layout.operator("fieldwork.turntable")
        layout.operator("fieldwork.relations")
        layout.operator("fieldwork.instances")
        layout.operator("fieldwork.pick_surface")


class FIELDWORK_MT_measure(Menu):
    bl_label = "Measure"

    def draw(self, context: Context) -> None:
        layout = self.layout
        layout.operator("fieldwork.measure")
        layout.operator("fieldwork.plan")
        layout.operator("fieldwork.section")
        layout.operator("fieldwork.compare")


class FIELDWORK_MT_recent(Menu):
    bl_label = "Recent Projects"

    def draw(self, context: Context) -> None:
        draw_recent(self.layout, MOST)


def draw_recent(layout: UILayout, most: int) -> None:
    """A button for each of the projects that were open last."""
    folders = recent()[:most]
    for folder in folders:
        button = layout.operator("fieldwork.open_recent", text=folder.name, icon="FILE_FOLDER", translate=False)
        button.folder = str(folder)
    if not folders:
        layout.label(text=t("No projects yet"))


def draw_object_menu(self: Menu, context: Context) -> None:
    self.layout.separator()
    self.layout.menu("FIELDWORK_MT_steps")


def draw_import(self: Menu, context: Context) -> None:
    self.layout.operator("fieldwork.open", text=t("Photos, Video or Project (Fieldwork)"))


def draw_export(self: Menu, context: Context) -> None:
    self.layout.operator("fieldwork.blend", text=t("Capture as .blend (Fieldwork)"))


CLASSES = [
    FIELDWORK_MT_steps,
    FIELDWORK_MT_label,
    FIELDWORK_MT_live,
    FIELDWORK_MT_mesh,
    FIELDWORK_MT_measure,
    FIELDWORK_MT_recent,
]
_ENTRIES = [
    ("VIEW3D_MT_object", draw_object_menu),
    ("TOPBAR_MT_file_import", draw_import),
    ("TOPBAR_MT_file_export", draw_export),
]


def register() -> None:
    for menu, draw in _ENTRIES:
        getattr(bpy.types, menu).append(draw)


def unregister() -> None:
    for menu, draw in _ENTRIES:
        getattr(bpy.types, menu).remove(draw)
