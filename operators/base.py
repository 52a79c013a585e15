"""What the operators of the verbs have in common: settings in, a job out.

Modules with properties of operators do without `from __future__ import annotations`: enabling the extension must be quick,
and Blender would compile the text of each annotation, of base classes for each operator anew.
"""

import os
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon import machine, paths
from ..addon.errors import EngineError
from ..addon.jobs.job import Done, Steps
from ..addon.jobs.queue import queue
from ..addon.jobs.refresh import refresh_scenes
from ..addon.project import edits, runs, snapshot
from ..addon.properties import SETTINGS
from ..addon.props import IntProperty, StringProperty
from ..addon.text import t

EDIT_SECONDS = 15.0  # how long a job waits for edits: the engine may have to start first


def scene_settings(**names: str) -> Callable[[type], type]:
    """Give an operator the scene's settings as properties of its own: operator name = scene name.

    What the caller does not set is taken from the scene.
    """

    def decorate(cls: type) -> type:
        # Not of the class's __dict__: Python 3.14 keeps there only what makes them.
        cls.__annotations__ = cls.__annotations__ | {name: SETTINGS[scene] for name, scene in names.items()}
        cls.scene_names = names
        return cls

    return decorate


HoldoutProperty = partial(
    IntProperty,
    name="Hold Out",
    description="Every so many photos one is left out of the training to measure it with; 0: none. Default: as the scene says",
    default=8,
    min=0,
    options={"SKIP_SAVE"},
)


def hold_out(operator: Operator, context: Context) -> int:
    """Every how many photos one is held out: as the caller says, else by the switch of the scene."""
    if operator.properties.is_property_set("holdout"):
        return operator.holdout
    return runs.HOLDOUT if context.scene.fieldwork.hold_out else 0


def mask_mode(chosen: str) -> str | None:
    """What black in masks means, as the verbs take it; None: the engine looks at the masks."""
    return None if chosen == "automatic" else chosen


def engine_reason() -> str | None:
    """Why no engine can be started, None when one can."""
    if machine.engine_python() is None:
        return t("Install the engine in the preferences of Fieldwork first")
    if queue.replacing:
        return t("The engine is being installed")
    return None


def need_photos(context: Context) -> str | None:
    return None if context.scene.fieldwork.photos else t("Choose a folder of photos, or a video, first")


def need_project_folder(context: Context) -> str | None:
    return None if context.scene.fieldwork.project else t("Choose a project folder first")


def need_project(context: Context) -> str | None:
    settings = context.scene.fieldwork
    missing = None if snapshot.has_project(snapshot.folder_of(settings)) else t("Read photos into a project first")
    return snapshot.absence(settings) or missing


def need_poses(context: Context) -> str | None:
    folder = snapshot.folder_of(context.scene.fieldwork)
    return need_project(context) or (None if snapshot.has_poses(folder) else t("Estimate the camera poses first"))


def need_run(context: Context) -> str | None:
    settings = context.scene.fieldwork
    missing = (
        None
        if runs.has_run(snapshot.folder_of(settings), settings.run)
        else t("Train the run “{}” first", settings.run)
    )
    return need_poses(context) or missing


def need_held_out(context: Context) -> str | None:
    settings = context.scene.fieldwork
    if need_run(context) or runs.held_out(snapshot.folder_of(settings), settings.run):
        return None
    return t("The run “{}” was trained on all photos: none is left to measure it with", settings.run)


def same_verb_active(verb: str, context: Context) -> str | None:
    folder = snapshot.folder_of(context.scene.fieldwork)
    for job in (queue.running, queue.followed, *queue.waiting):
        if job is not None and job.verb == verb and (job.project is None or job.project == folder):
            return t("{} is under way", job.title)
    return None


def absolute(path: str) -> str | None:
    """A path as the user gave it, absolute; None when it is empty."""
    return str(paths.absolute(path)) if path else None


def with_suffix(path: str, suffix: str, others: Collection[str] = ()) -> str:
    """A path that ends in a suffix, in place of one of the others if it has that."""
    head, end = os.path.splitext(path)
    if not os.path.basename(path) or end.lower() == suffix:
        return path
    return (head if end.lower() in others else path) + suffix


class VerbOperator(Operator):
    """An operator that runs a verb in the engine: queued in a window, blocking without one."""

    # Annotations of these would be evaluated for each operator.
    verb = ""
    needs = ()  # functions that take the context and say what is missing, None where nothing is
    scene_names = {}

    @classmethod
    def poll(cls, context: Context) -> bool:
        # Without a window the caller may give the project as an argument, which poll cannot see.
        if bpy.app.background:
            return True
        reason = cls.reason(context)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    @classmethod
    def reason(cls, context: Context) -> str | None:
        """Why the operator cannot run now, None when it can."""
        for need in cls.needs:
            if reason := need(context):
                return reason
        return engine_reason() or same_verb_active(cls.verb, context)

    def value(self, context: Context, name: str) -> Any:
        """A setting: the operator's own where the caller set it, else the scene's."""
        if self.properties.is_property_set(name):
            return getattr(self, name)
        return getattr(context.scene.fieldwork, self.scene_names[name])

    def path(self, context: Context, name: str) -> str | None:
        """A setting that is a path, absolute; None when it is empty."""
        return absolute(self.value(context, name))

    def parameters(self, context: Context) -> dict[str, Any]:
        """Parameters of the verb. Raises ValueError with a sentence for the user."""
        raise NotImplementedError

    def execute(self, context: Context) -> set[str]:
        try:
            params = self.parameters(context)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        params = {name: value for name, value in params.items() if value is not None}
        if not self.edits_delivered(params):
            return {"CANCELLED"}
        job = queue.make(self.verb, params, self.after(), after_edits(self.before(context, params)))
        if not bpy.app.background:
            queue.submit(job)
            return {"FINISHED"}
        try:
            queue.run(job)
        except EngineError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if job.error is not None:
            self.report({"ERROR"}, str(job.error))
            return {"CANCELLED"}
        for warning in job.warnings:
            self.report({"WARNING"}, warning)
        return {"FINISHED"}

    def edits_delivered(self, params: dict[str, Any]) -> bool:
        """Let the engine know of edits before the verb works with them; whether it may go on."""
        deliver_edits()
        if not bpy.app.background:
            return True
        for edit in edits.failed():
            own = str(edit.folder) in (params.get("project"), params.get("out"))
            text = t("An edit of {} is not saved. {}", edit.folder, str(edit.error))
            self.report({"ERROR" if own else "WARNING"}, text)
            if own:
                return False
        return True

    def before(self, context: Context, params: dict[str, Any]) -> Steps | None:
        """Steps in Blender before the verb can start."""
        return None

    def after(self) -> Done:
        """What is called when the job has ended, and may be a generator. The operator itself is gone by then."""
        return refresh_scenes


class WithProject:
    """What operators that work on a project have: its folder."""

    project: StringProperty(
        name="Project", description="Project folder; empty: that of the scene", subtype="DIR_PATH",
        options={"SKIP_SAVE", "HIDDEN"},
    )  # fmt: skip

    def project_path(self, context: Context) -> str:
        """The folder. Raises ValueError with a sentence for the user."""
        folder = absolute(self.project) or absolute(context.scene.fieldwork.project)
        if folder is None:
            raise ValueError(t("Choose a project folder first."))
        return folder


class ProjectOperator(WithProject, VerbOperator):
    """A verb that works on a project."""


def deliver_edits() -> None:
    """Hand edited classes and regions to the engine; without a window, wait until it has taken them."""
    edits.send(queue.ask_and_wait if bpy.app.background else queue.ask, at_once=True)


def after_edits(steps: Steps | None) -> Steps | None:
    """Steps that wait a little for the engine to take the edits, before others."""
    if bpy.app.background or not edits.waiting():
        return steps

    def wait() -> Steps:
        end = time.monotonic() + EDIT_SECONDS
        while edits.waiting() and not edits.failed() and time.monotonic() < end:
            yield 0.0, t("saving edits")
            time.sleep(0.005)
        if steps is not None:
            yield from steps

    return wait()


def scene_of(project: Path, name: str = "") -> bpy.types.Scene | None:
    """A scene that shows a project, rather the one of this name; None where none does: another file was loaded. Without
    a window the scene that is open, whatever it shows."""
    if bpy.app.background:
        return bpy.data.scenes.get(name) or bpy.context.scene
    scenes = [scene for scene in bpy.data.scenes if snapshot.folder_of(scene.fieldwork) == project]
    return next((scene for scene in scenes if scene.name == name), scenes[0] if scenes else None)


def set_if_empty(scene: bpy.types.Scene, folder: str) -> None:
    """Let the scene show the project it was just given."""
    if not scene.fieldwork.project:
        scene.fieldwork.project = folder
