"""The project of the scene: finding one that was moved, and edits that wait for the engine."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Event, Operator

from ..addon import paths
from ..addon.errors import EngineError
from ..addon.jobs.queue import queue
from ..addon.live import fields
from ..addon.project import edits, lists, snapshot
from ..addon.props import StringProperty
from ..addon.roles import Owner
from ..addon.text import t
from .base import WithProject, absolute, deliver_edits, refresh_scenes


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
        folder = paths.absolute(self.directory)
        reason = refusal(settings, folder)
        if reason:
            self.report({"ERROR"}, reason)
            return {"CANCELLED"}
        from ..addon.scene.owned import hand_over  # not at the top: enabling the extension must be quick

        old, uuid = snapshot.folder_of(settings), settings.project_uuid
        hand_over(Owner(old.name, uuid), snapshot.owner(folder))
        edits.move(old, folder)
        move_files((bpy.data.images, bpy.data.volumes), old, folder)
        fields.move(old, folder)
        for scene in bpy.data.scenes:
            if scene.fieldwork.project_uuid == uuid and snapshot.folder_of(scene.fieldwork) == old:
                scene.fieldwork.project = str(folder)
        return {"FINISHED"}


def move_files(collections: Iterable[Any], old: Path, new: Path) -> None:
    """Let what the file reads from a folder, such as its images, be read from another."""
    for item in itertools.chain.from_iterable(collections):
        path = paths.absolute(item.filepath) if item.filepath and item.library is None else None
        if path is not None and path.is_relative_to(old):
            item.filepath = str(new / path.relative_to(old))


def refusal(settings: bpy.types.PropertyGroup, folder: Path) -> str | None:
    """Why a folder does not hold the project that the scene knows, as a sentence; None when it does."""
    if snapshot.project(folder) is None:
        return t("There is no project in {}: choose the folder that holds its project.json.", folder)
    if snapshot.owner(folder).uuid == settings.project_uuid:
        return None
    return t(
        "{} holds another project. To go on with that one, choose its folder in the field Project.",
        folder,
    )


class FIELDWORK_OT_open_recent(Operator):
    """Open a project that was open before"""

    bl_idname = "fieldwork.open_recent"
    bl_label = "Open Recent Project"
    bl_options = {"UNDO"}

    folder: StringProperty(name="Folder", description="Folder of the project", subtype="DIR_PATH")

    @classmethod
    def description(cls, context: Context, properties: bpy.types.OperatorProperties) -> str:
        return properties.folder or t(cls.__doc__ or "")

    def execute(self, context: Context) -> set[str]:
        if not snapshot.has_project(Path(self.folder)):
            self.report({"ERROR"}, t("There is no project in {}.", self.folder))
            return {"CANCELLED"}
        context.scene.fieldwork.project = self.folder
        return {"FINISHED"}


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
        for edit in edits.failed():
            self.report({"ERROR"}, str(edit.error))
        return {"CANCELLED"} if edits.failed() else {"FINISHED"}


class FIELDWORK_OT_classes_apply(WithProject, Operator):
    """Replace the classes of the project by those of a file"""

    bl_idname = "fieldwork.classes_apply"
    bl_label = "Classes from File"

    file: StringProperty(
        name="File", description="classes.json with all classes the project shall have", subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    def execute(self, context: Context) -> set[str]:
        try:
            folder = self.project_path(context)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not self.file:
            self.report({"ERROR"}, t("Choose a file of classes."))
            return {"CANCELLED"}
        job = queue.make("classes", {"project": folder, "file": absolute(self.file)}, refresh_scenes)
        deliver_edits()  # those of before come first
        try:
            ask = queue.ask_and_wait if bpy.app.background else queue.ask
            ask(job.verb, job.params, lambda result, error: queue.finish(job, result, error))
        except EngineError as error:
            queue.finish(job, None, error)
        if bpy.app.background:
            queue.landing.settle()
        if job.error is not None:
            self.report({"ERROR"}, str(job.error))
            return {"CANCELLED"}
        return {"FINISHED"}


class FIELDWORK_OT_discard_edits(Operator):
    """Show the classes and the training region as the project has them, without the edits that could not be saved"""

    bl_idname = "fieldwork.discard_edits"
    bl_label = "Discard Edits"

    @classmethod
    def poll(cls, context: Context) -> bool:
        if not edits.failed():
            cls.poll_message_set(t("All edits are saved"))
            return False
        return True

    def execute(self, context: Context) -> set[str]:
        edits.discard()
        for scene in bpy.data.scenes:
            lists.refresh(scene.fieldwork)
        queue.redraw()
        return {"FINISHED"}


CLASSES = [
    FIELDWORK_OT_open_recent,
    FIELDWORK_OT_locate_project,
    FIELDWORK_OT_save_edits,
    FIELDWORK_OT_discard_edits,
    FIELDWORK_OT_classes_apply,
]
