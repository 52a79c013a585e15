"""Preferences of the extension: where the engine is, and how it behaves."""

from typing import TYPE_CHECKING

import bpy
from bpy.types import AddonPreferences, Context, UILayout

from .engine import place
from .engine.place import tail
from .machine import engine_folder, engine_python
from .props import EnumProperty, IntProperty, StringProperty
from .registration import ROOT_PACKAGE
from .text import t

if TYPE_CHECKING:
    from .engine.install import Installer


class FIELDWORK_AP_preferences(AddonPreferences):
    bl_idname = ROOT_PACKAGE

    engine_python: StringProperty(
        name="Environment",
        description="Python of an existing environment that has the engine's packages; empty: the installed engine",
        subtype="FILE_PATH",
        blend_relative=False,
    )
    device: EnumProperty(
        name="Device",
        description="Which build of PyTorch the installer fetches",
        items=[
            ("auto", "Automatic", "The build that fits this machine"),
            ("cuda", "NVIDIA GPU (CUDA)", "For NVIDIA graphics cards"),
            ("rocm", "AMD GPU (ROCm)", "For AMD graphics cards on Linux; slower than the kernels for NVIDIA"),
            ("mps", "Apple GPU (MPS)", "For Macs with Apple silicon; slower than the kernels for NVIDIA"),
            ("cpu", "CPU", "No graphics card; the smallest download"),
        ],
    )
    base_python: StringProperty(
        name="Base Python",
        description="Python 3.11 or newer that the engine's environment is made from; empty: Blender's own",
        subtype="FILE_PATH",
        blend_relative=False,
    )
    wheels: StringProperty(
        name="Package Folder",
        description="Folder of package files (wheels) for a machine without network; empty: download",
        subtype="DIR_PATH",
        blend_relative=False,
    )
    on_close: EnumProperty(
        name="When Blender Closes",
        description="What becomes of a running job",
        items=[
            ("stop", "Stop with a Checkpoint", "The job stops and can be resumed later"),
            ("continue", "Keep Running", "The job goes on; Blender finds it again with its project"),
        ],
    )
    idle_minutes: IntProperty(
        name="Release After",
        description="Minutes without a job after which the engine ends and frees its memory; 0: never",
        default=5,
        min=0,
        soft_max=60,
    )

    def draw(self, context: Context) -> None:
        draw_preferences(self, self.layout)


def draw_preferences(preferences: FIELDWORK_AP_preferences, layout: UILayout) -> None:
    from .jobs.queue import queue

    layout.use_property_split = True
    layout.use_property_decorate = False
    box = layout.box()
    draw_engine(box, queue.installer)
    column = box.column()
    column.prop(preferences, "device")
    column.prop(preferences, "base_python")
    column.prop(preferences, "wheels")
    layout.prop(preferences, "engine_python")
    layout.prop(preferences, "on_close")
    layout.prop(preferences, "idle_minutes")


def draw_engine(layout: UILayout, installer: "Installer | None") -> None:
    """State of the installed engine, and the one button that changes it."""
    folder = engine_folder()
    known = place.installed(folder)
    if installer is not None and installer.is_alive():
        row = layout.row(align=True)
        row.progress(factor=installer.fraction, text=installer.message, type="BAR")
        row.operator("fieldwork.engine_install_cancel", text="", icon="X")
        column = layout.column(align=True)
        column.active, column.scale_y = False, 0.7
        for line in tail(folder / place.LOG, 5):
            column.label(text=line[:120])
        return
    if known:
        doctor = known.get("doctor", {})
        text = t("Engine installed: PyTorch {} on {}", doctor.get("torch"), doctor.get("device"))
        layout.label(text=text, icon="CHECKMARK")
        if not place.up_to_date(folder):
            layout.label(text=t("This version of Fieldwork needs other packages: press Update"), icon="INFO")
    elif engine_python() is not None:
        layout.label(text=t("Using the environment of {}", engine_python()), icon="CHECKMARK")
    else:
        layout.label(text=t("The engine is not installed"), icon="INFO")
        layout.label(text=t("It takes about 2 GB of disk for the CPU, more for a graphics card"), icon="BLANK1")
    if not bpy.app.online_access:
        layout.label(text=t("Online access is off: allow it under System > Network"), icon="INTERNET_OFFLINE")
    if installer is not None and installer.error:
        import textwrap

        column = layout.column(align=True)
        for number, line in enumerate(textwrap.wrap(installer.error, 80)):
            column.label(text=line, icon="BLANK1" if number else "ERROR")
    row = layout.row(align=True)
    action = t("Install Engine") if not known else t("Repair") if place.up_to_date(folder) else t("Update")
    row.operator("fieldwork.engine_install", text=action, icon="IMPORT")
    row.operator("fieldwork.engine_remove", text=t("Remove"), icon="TRASH")
    row.operator("fieldwork.engine_install_log", text=t("Log"), icon="TEXT")


CLASSES = [FIELDWORK_AP_preferences]
