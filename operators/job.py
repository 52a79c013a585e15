"""Running jobs and the engine: cancel, report, stop, check."""

from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon import machine, registration
from ..addon.jobs.follow import reattach
from ..addon.jobs.queue import queue
from ..addon.live.engine import frames_run, rest_frames
from ..addon.props import StringProperty
from ..addon.text import t
from .base import VerbOperator


class FIELDWORK_OT_cancel(Operator):
    """Stop the running job; training leaves a checkpoint to resume from"""

    bl_idname = "fieldwork.cancel"
    bl_label = "Cancel"

    job: StringProperty(options={"SKIP_SAVE", "HIDDEN"})

    @classmethod
    def poll(cls, context: Context) -> bool:
        current = queue.current
        if current is None:
            cls.poll_message_set(t("Nothing is running"))
        elif current.state == "cancelling" and not queue.waiting:
            cls.poll_message_set(t("The job is stopping already"))
        else:
            return True
        return False

    def execute(self, context: Context) -> set[str]:
        meant = next((job for job in (queue.current, *queue.waiting) if job and job.id == self.job), None)
        # The job of a button may have ended while the mouse was on its way.
        if meant is not None or not self.job:
            queue.cancel(meant)
        return {"FINISHED"}


class FIELDWORK_OT_copy_report(Operator):
    """Copy what happened to the clipboard, for a bug report"""

    bl_idname = "fieldwork.copy_report"
    bl_label = "Copy Report"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if queue.last is None and queue.current is None:
            cls.poll_message_set(t("Nothing has run yet"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        job = queue.outcome or queue.last or queue.current
        context.window_manager.clipboard = job.report()
        self.report({"INFO"}, t("The report is on the clipboard"))
        return {"FINISHED"}


class FIELDWORK_OT_dismiss(Operator):
    """Put the message away"""

    bl_idname = "fieldwork.dismiss"
    bl_label = "Dismiss"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if queue.outcome is None:
            cls.poll_message_set(t("There is no message"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        for job in queue.finished:
            job.dismissed = True
        return {"FINISHED"}


class FIELDWORK_OT_stop_engine(Operator):
    """End the engine and free its memory; a running job stops and can be resumed"""

    bl_idname = "fieldwork.stop_engine"
    bl_label = "Stop Engine"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if (queue.link is None or not queue.link.alive) and not frames_run():
            cls.poll_message_set(t("The engine is not running"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        queue.stop_engine()
        rest_frames()
        return {"FINISHED"}


class FIELDWORK_OT_detach(Operator):
    """Let the running job go on by itself, also when Blender is closed; the panel follows it from its files"""

    bl_idname = "fieldwork.detach"
    bl_label = "Keep Running Without Blender"

    @classmethod
    def poll(cls, context: Context) -> bool:
        job = queue.running
        if job is None or job.project is None:
            cls.poll_message_set(t("No job of a project is running"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        job = queue.running
        queue.stop_engine(detach=True)
        reattach(queue, job.project)
        return {"FINISHED"}


class FIELDWORK_OT_doctor(VerbOperator):
    """Check that the engine, the device and the disk are in order"""

    bl_idname = "fieldwork.doctor"
    bl_label = "Check Engine"
    verb = "doctor"

    def parameters(self, context: Context) -> dict[str, Any]:
        return {}


class FIELDWORK_OT_open_log(Operator):
    """Show the engine's log in the text editor"""

    bl_idname = "fieldwork.open_log"
    bl_label = "Open Log"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if not machine.engine_log().is_file():
            cls.poll_message_set(t("The engine has not run yet"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        text = bpy.data.texts.get("Fieldwork Engine Log") or bpy.data.texts.new("Fieldwork Engine Log")
        text.from_string(machine.engine_log().read_text(encoding="utf-8", errors="replace"))
        self.report({"INFO"}, t("See “{}” in the text editor", text.name))
        return {"FINISHED"}


class FIELDWORK_OT_open_preferences(Operator):
    """Open the preferences of Fieldwork"""

    bl_idname = "fieldwork.open_preferences"
    bl_label = "Preferences"

    def execute(self, context: Context) -> set[str]:
        bpy.ops.preferences.addon_show(module=registration.ROOT_PACKAGE)
        return {"FINISHED"}


CLASSES = [
    FIELDWORK_OT_cancel,
    FIELDWORK_OT_copy_report,
    FIELDWORK_OT_dismiss,
    FIELDWORK_OT_stop_engine,
    FIELDWORK_OT_detach,
    FIELDWORK_OT_doctor,
    FIELDWORK_OT_open_log,
    FIELDWORK_OT_open_preferences,
]
