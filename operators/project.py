"""The project of the scene: finding one that was moved, and edits that wait for the engine."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.types import Context, Event, Operator

from ..addon.jobs.queue import queue
from ..addon.project import edits, lists, snapshot
from ..addon.props import StringProperty
from ..addon.roles import Owner
from ..addon.text import t
from .base import deliver_edits


class FIELDWORK_OT_locate_project(Operator):
    """Choose the folder where the project of this scene is now"""

    bl_idname = "fieldwork.locate_project"
    bl_label = "Find Project…"
    bl_options = {"UNDO"}

    directory: StringProperty(name="Folder", description="Folder of the project", subtype="DIR_PATH")

    @classmethod
    def poll(cls, context: Context) -> bool:
        if snapshot.absence(context.scene.fieldwork) is None:
            cls.poll_message_set(t("The project is where the scene knows it"))
            return False
        return True

    def invoke(self, context: Context, event: Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Context) -> set[str]:
        settings = context.scene.fieldwork
        folder = Path(bpy.path.abspath(self.directory)).absolute()
        reason = refusal(settings, folder)
        if reason:
            self.report({"ERROR"}, reason)
            return {"CANCELLED"}
        from ..addon.scene.owned import hand_over  # not at the top: enabling the extension must be quick

        old = snapshot.folder_of(settings)
        hand_over(Owner.of(old, settings.project_key), snapshot.owner(folder))
        edits.move(old, folder)
        settings.project = str(folder)
        return {"FINISHED"}


def refusal(settings: bpy.types.PropertyGroup, folder: Path) -> str | None:
    """Why a folder does not hold the project that the scene knows, as a sentence; None when it does."""
    project = snapshot.project(folder)
    if project is None:
        return t("There is no project in {}: choose the folder that holds its project.json.", folder)
    if Path(settings.project_key).is_absolute():
        # It had no UUID when it was seen last: it is known by its photos.
        known = {image.name for image in settings.images}
        same = not known or any(image["name"] in known for image in project.get("images", []))
    else:
        same = snapshot.owner(folder).known_as(settings.project_key)
    if same:
        return None
    return t(
        "{} holds another project. To go on with that one, choose its folder in the field Project.",
        folder,
    )


class FIELDWORK_OT_save_edits(Operator):
    """Let the engine write edited classes and the training region into the project now"""

    bl_idname = "fieldwork.save_edits"
    bl_label = "Save Edits"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if not edits.waiting():
            cls.poll_message_set(t("Nothing was edited"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        deliver_edits()
        edit = edits.failed()
        if edit is not None and edit.error is not None:
            self.report({"ERROR"}, str(edit.error))
            return {"CANCELLED"}
        return {"FINISHED"}


class FIELDWORK_OT_discard_edits(Operator):
    """Show the classes and the training region as the project has them, without the edits that could not be saved"""

    bl_idname = "fieldwork.discard_edits"
    bl_label = "Discard Edits"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if edits.failed() is None:
            cls.poll_message_set(t("All edits are saved"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        edits.discard()
        for scene in bpy.data.scenes:
            lists.refresh(scene.fieldwork)
        queue.redraw()
        return {"FINISHED"}


CLASSES = [FIELDWORK_OT_locate_project, FIELDWORK_OT_save_edits, FIELDWORK_OT_discard_edits]
