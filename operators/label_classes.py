"""Label: adding and removing classes, at once and by the engine."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon.errors import EngineError
from ..addon.jobs.queue import queue
from ..addon.labels import journal, pending, session
from ..addon.project import classes, lists, snapshot
from ..addon.props import StringProperty
from ..addon.text import t
from .base import deliver_edits, need_project


class ClassEdit(Operator):
    """What the operators have in common that add and remove classes: at once, by the engine."""

    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = need_project(context)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def changed(self, settings: Any, known: list[dict[str, Any]]) -> list[dict[str, Any]] | None:
        """The classes as they shall be; None where there is nothing to do."""
        raise NotImplementedError

    def execute(self, context: Context) -> set[str]:
        settings = context.scene.fieldwork
        folder = snapshot.folder_of(settings)
        deliver_edits()
        known = classes.wanted(folder)
        wanted = self.changed(settings, known)
        if wanted is None:
            return {"CANCELLED"}
        chosen_id = next((value["id"] for value in wanted if value not in known), None)
        refused: list[EngineError] = []

        def answered(result: dict[str, Any] | None, error: EngineError | None) -> None:
            if error is not None:
                refused.append(error)
                pending.tell(folder, error)
            classes.answered(folder, wanted)
            refresh(folder, chosen_id)

        classes.on_its_way(folder, wanted)
        try:
            ask = queue.ask_and_wait if bpy.app.background else queue.ask
            ask("classes", {"project": str(folder), "classes": wanted}, answered)
            session.hurry()
        except EngineError as error:
            classes.answered(folder, wanted)
            refused.append(error)
        if refused:
            self.report({"ERROR"}, str(refused[0]))
            return {"CANCELLED"}
        return {"FINISHED"}


def refresh(folder: Path, class_id: int | None) -> None:
    """Bring changed classes into the lists of the scenes that show the project, and choose one of them."""
    for scene in bpy.data.scenes:
        settings = scene.fieldwork
        if snapshot.folder_of(settings) == folder:
            lists.refresh(settings)
            index = next((i for i, entry in enumerate(settings.classes) if entry.id == class_id), None)
            if index is not None:
                settings.class_index = index


class FIELDWORK_OT_class_add(ClassEdit):
    """Add a class"""

    bl_idname = "fieldwork.class_add"
    bl_label = "Add Class"

    name: StringProperty(name="Name", description="Name of the class; empty: a number", options={"SKIP_SAVE"})

    def changed(self, settings: Any, known: list[dict[str, Any]]) -> list[dict[str, Any]]:
        folder = snapshot.folder_of(settings)
        project = snapshot.project(folder) or {}
        # What marks and label maps say of a class that was removed must not become that of the new one.
        gone = {value["id"] for value in project.get("classes", [])} | set(project.get("former_class_ids", []))
        taken = {value["id"] for value in known} | {int(project.get("ignore_id", 0))} | gone | journal.class_ids(folder)
        number = next(i for i in range(1, len(taken) + 2) if i not in taken)
        names = {value["name"] for value in known}
        name = self.name.strip() or t("Class {}", number)
        while name in names:
            name += "'"
        return [*known, {"id": number, "name": name}]


class FIELDWORK_OT_class_remove(ClassEdit):
    """Remove the chosen class; its marks stay in the journal and say nothing"""

    bl_idname = "fieldwork.class_remove"
    bl_label = "Remove Class"

    def changed(self, settings: Any, known: list[dict[str, Any]]) -> list[dict[str, Any]] | None:
        if not 0 <= settings.class_index < len(settings.classes):
            return None
        gone = settings.classes[settings.class_index].id
        return [value for value in known if value["id"] != gone]


CLASSES = [FIELDWORK_OT_class_add, FIELDWORK_OT_class_remove]
