"""Installing, repairing and removing the engine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy.types import Context, Event, Operator

from ..addon import machine
from ..addon.engine import place
from ..addon.jobs.queue import queue
from ..addon.live.engine import rest_frames
from ..addon.text import t

if TYPE_CHECKING:
    from ..addon.engine.install import Options


def options() -> Options:
    from ..addon.engine import install  # not at the top: enabling the extension must be quick

    chosen = machine.preferences()
    base, wheels = (os.path.expanduser(bpy.path.abspath(path)) for path in (chosen.base_python, chosen.wheels))
    return install.Options(
        folder=machine.engine_folder(),
        base=Path(base) if base else install.default_base(),
        device=chosen.device,
        wheels=wheels,
        online=bpy.app.online_access,
    )


class FIELDWORK_OT_engine_install(Operator):
    """Download the engine's packages into an environment of their own; Blender's Python stays as it is"""

    bl_idname = "fieldwork.engine_install"
    bl_label = "Install Engine"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if queue.installing:
            cls.poll_message_set(t("The installation is under way"))
        elif not bpy.app.online_access and not machine.preferences().wheels:
            cls.poll_message_set(t("Allow Online Access in the System preferences, or choose a folder of packages"))
        else:
            return True
        return False

    def execute(self, context: Context) -> set[str]:
        import threading

        from ..addon.engine import install

        queue.stop_engine()
        rest_frames()
        if not bpy.app.background:
            queue.installer = install.Installer(options())
            queue.installer.start()
            return {"FINISHED"}
        try:
            install.install(options(), lambda fraction, text: print(f"{fraction:4.0%} {text}"), threading.Event())
        except install.InstallError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class FIELDWORK_OT_engine_install_cancel(Operator):
    """Stop the installation; it can go on later"""

    bl_idname = "fieldwork.engine_install_cancel"
    bl_label = "Stop"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if not queue.installing:
            cls.poll_message_set(t("Nothing is being installed"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        queue.installer.cancelled.set()
        return {"FINISHED"}


class FIELDWORK_OT_engine_remove(Operator):
    """Remove the engine and its downloads from the disk; projects stay"""

    bl_idname = "fieldwork.engine_remove"
    bl_label = "Remove Engine"

    @classmethod
    def poll(cls, context: Context) -> bool:
        folder = machine.engine_folder()
        if queue.installing:
            cls.poll_message_set(t("The installation is under way"))
        elif not any((folder / name).exists() for name in (*place.ENVIRONMENTS, *place.DOWNLOADS)):
            cls.poll_message_set(t("There is no engine to remove"))
        else:
            return True
        return False

    def invoke(self, context: Context, event: Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, context: Context) -> set[str]:
        from ..addon.engine import install

        queue.stop_engine(timeout=5.0)
        rest_frames()
        try:
            install.remove(machine.engine_folder())
        except install.InstallError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        queue.installer = None
        return {"FINISHED"}


class FIELDWORK_OT_engine_install_log(Operator):
    """Show the log of the installation in the text editor"""

    bl_idname = "fieldwork.engine_install_log"
    bl_label = "Open Log"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if not (machine.engine_folder() / place.LOG).is_file():
            cls.poll_message_set(t("Nothing has been installed yet"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        name = "Fieldwork Installation Log"
        text = bpy.data.texts.get(name) or bpy.data.texts.new(name)
        path = machine.engine_folder() / place.LOG
        text.from_string(path.read_text(encoding="utf-8", errors="replace"))
        self.report({"INFO"}, t("See “{}” in the text editor", name))
        return {"FINISHED"}


CLASSES = [
    FIELDWORK_OT_engine_install,
    FIELDWORK_OT_engine_install_cancel,
    FIELDWORK_OT_engine_remove,
    FIELDWORK_OT_engine_install_log,
]
