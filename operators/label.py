"""Label: the verbs that prepare, propagate, carry and accept; photos that are marked."""

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon.errors import EngineError
from ..addon.jobs.job import Done, Job
from ..addon.jobs.queue import queue
from ..addon.labels import editor, pending, session
from ..addon.project import snapshot
from ..addon.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from ..addon.text import t
from ..addon.undo import undo_step
from .base import (
    ProjectOperator,
    absolute,
    need_run,
    refresh_scenes,
    scene_of,
    scene_settings,
)

Revision = partial(
    IntProperty,
    name="Revision",
    description="Revision of the marks; -1: the one that is shown",
    default=-1,
    min=-1,
    options={"SKIP_SAVE"},
)


def chosen(revision: int) -> int | None:
    return None if revision < 0 else revision


def need_marks(context: Context) -> str | None:
    folder = snapshot.folder_of(context.scene.fieldwork)
    if need_run(context) is None and folder is not None and pending.shown(folder) == 0:
        return t("Mark something on a photo first")
    return need_run(context)


def shown_photo(given: str, context: Context) -> str:
    """The photo that was named, else the one in the image editor. Raises ValueError where there is none."""
    photo = given or editor.shown_photo(snapshot.folder_of(context.scene.fieldwork))
    if not photo:
        raise ValueError(t("Show a photo in an image editor first."))
    return photo


def pairs(text: str) -> list[list[float]]:
    """Places as numbers. Raises ValueError with a sentence for the user."""
    try:
        return [[float(x), float(y)] for x, y in (pair.split(",") for pair in text.split())]
    except ValueError as error:
        raise ValueError(t("“{}” are no places: write them as x,y x,y …", text)) from error


class RunOperator(ProjectOperator):
    """A verb of labelling that works on a run, at a revision of the marks where it has one."""

    def of_run(self, context: Context, **more: Any) -> dict[str, Any]:
        """Project, run, and revision where the verb takes one, with more parameters."""
        own = {"revision": chosen(self.revision)} if "revision" in self.properties.bl_rna.properties else {}
        return {"project": self.project_path(context), "run": self.value(context, "run"), **own, **more}


@scene_settings(run="run", features="label_features")
class FIELDWORK_OT_label_prepare(RunOperator):
    """Prepare the run for labeling: the first marks do so too"""

    bl_idname = "fieldwork.label_prepare"
    bl_label = "Prepare"
    verb = "label prepare"
    needs = (need_run,)

    surfels: IntProperty(
        name="Surfels", description="Most places of the surface that get a label each", default=200_000, min=1000,
        max=5_000_000, options={"SKIP_SAVE"},
    )  # fmt: skip

    def parameters(self, context: Context) -> dict[str, Any]:
        surfels = self.surfels if self.properties.is_property_set("surfels") else None
        return self.of_run(context, surfels=surfels, features=self.path(context, "features"))


@scene_settings(run="run")
class FIELDWORK_OT_label_propagate(RunOperator):
    """Carry the marks over the whole surface; in a window that goes without saying"""

    bl_idname = "fieldwork.label_propagate"
    bl_label = "Propagate"
    verb = "label propagate"
    needs = (need_run,)

    revision: Revision()

    def parameters(self, context: Context) -> dict[str, Any]:
        return self.of_run(context)


@scene_settings(run="run")
class FIELDWORK_OT_label_overlay(RunOperator):
    """Write a picture of the labels of the photo that is shown"""

    bl_idname = "fieldwork.label_overlay"
    bl_label = "Write Label Picture"
    verb = "label overlay"
    needs = (need_marks,)

    photo: StringProperty(
        name="Photo", description="Name of the photo; empty: the one in the image editor", options={"SKIP_SAVE"}
    )
    kind: EnumProperty(
        name="Kind",
        description="What the picture shows",
        items=[
            ("colors", "Colors", "The colors of the classes over the photo"),
            ("ids", "Label Map", "The id of the class in each pixel"),
            ("confidence", "Confidence", "How sure the class is"),
        ],
        options={"SKIP_SAVE"},
    )
    revision: Revision()
    out: StringProperty(
        name="File", description="PNG to write; empty: in the run", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        return self.of_run(context, photo=shown_photo(self.photo, context), kind=self.kind, out=absolute(self.out))

    def after(self) -> Done:
        return show_overlay


def show_overlay(job: Job) -> None:
    """Tell where the picture is; the editor in which photos are marked stays as it is."""
    if job.state == "done" and job.result:
        job.warnings.append(t("The picture is at {}.", job.result["file"]))


@scene_settings(run="run", level="label_level")
class FIELDWORK_OT_label_parts(RunOperator):
    """Write a picture of the parts of the surface in the photo that is shown"""

    bl_idname = "fieldwork.label_parts"
    bl_label = "Write Picture of Parts"
    verb = "label parts"
    needs = (need_run,)

    photo: StringProperty(
        name="Photo", description="Name of the photo; empty: the one in the image editor", options={"SKIP_SAVE"}
    )
    points: StringProperty(name="Places", description="Pixels whose parts are told: x,y x,y …", options={"SKIP_SAVE"})
    out: StringProperty(
        name="File", description="PNG to write; empty: in the run", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        photo = shown_photo(self.photo, context)
        folder, run = self.project_path(context), self.value(context, "run")
        out = absolute(self.out) or str(Path(folder) / "runs" / run / "overlays" / f"{photo}_parts.png")
        more = {"points": pairs(self.points), "level": self.value(context, "level")}
        return self.of_run(context, photo=photo, out=out, **more)

    def after(self) -> Done:
        return show_overlay


@scene_settings(run="run")
class FIELDWORK_OT_label_next(RunOperator):
    """Show the photo on which a mark helps most"""

    bl_idname = "fieldwork.label_next"
    bl_label = "Next Photo"
    verb = "label next"
    needs = (need_run,)

    revision: Revision()
    count: IntProperty(
        name="Count", description="Number of photos to compare", default=5, min=1, max=1000, options={"SKIP_SAVE"}
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        return self.of_run(context, count=self.count)

    def after(self) -> Done:
        return show_next


def show_next(job: Job) -> None:
    """Show the best photo that is not shown already."""
    if job.state != "done" or not job.result or job.project is None:
        return
    names = [photo["name"] for photo in job.result["photos"]]
    now = editor.shown_photo(job.project)
    name = next((name for name in names if name != now), None)
    scene = scene_of(job.project)
    if name is not None and scene is not None:
        show_photo(scene, job.project, name)
        undo_step("Next Photo")


@scene_settings(run="run", seconds="label_seconds")
class FIELDWORK_OT_label_accept(RunOperator):
    """Train the classes that are shown into the field, and write label maps for the photos that have none of their own"""

    bl_idname = "fieldwork.label_accept"
    bl_label = "Accept"
    verb = "label accept"
    needs = (need_marks,)

    revision: Revision()

    def parameters(self, context: Context) -> dict[str, Any]:
        return self.of_run(context, seconds=self.value(context, "seconds"))

    def after(self) -> Done:
        return refresh_scenes


@scene_settings(run="run", other="other_project", other_run="other_run", points="common_points", author="label_author")
class FIELDWORK_OT_label_carry(RunOperator):
    """Take over the labels of an earlier epoch of the same object, or say that those taken over are right"""

    bl_idname = "fieldwork.label_carry"
    bl_label = "Carry Labels"
    verb = "label carry"
    needs = (need_run,)

    confirm: BoolProperty(
        name="Confirm", description="What was carried before is right, instead of carrying", options={"SKIP_SAVE"}
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        params = self.of_run(context, author=self.value(context, "author"))
        if self.confirm:
            return {**params, "confirm": True}
        other = self.path(context, "other")
        if other is None:
            raise ValueError(t("Choose the project of the earlier epoch."))
        more = {"other_run": self.value(context, "other_run"), "points": self.path(context, "points")}
        return {**params, "other": other, **more}

    def after(self) -> Done:
        return carried


def carried(job: Job) -> None:
    """What was carried or confirmed is a step of undo like a mark, and is propagated."""
    refresh_scenes(job)
    if job.state != "done" or not job.result or job.project is None:
        return
    if job.result["rms"] is not None:
        share, none, other = job.result["carried"], job.result["unmatched"], job.result["changed"]
        job.warnings.append(
            t(
                "{:.0%} of the surface got labels; {:.0%} has no counterpart, {:.0%} looks different.",
                share,
                none,
                other,
            )
        )
    session.taken(job.project, job.result["revision"])


class FIELDWORK_OT_label_photo(Operator):
    """Show a photo of the project in an image editor to mark it"""

    bl_idname = "fieldwork.label_photo"
    bl_label = "Label Photos"
    bl_options = {"REGISTER", "UNDO"}

    photo: StringProperty(
        name="Photo", description="Name of the photo; empty: the one that is shown", options={"SKIP_SAVE"}
    )
    step: IntProperty(
        name="Step", description="How many photos further, in the order of the project", options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = need_run(context)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        folder = snapshot.folder_of(context.scene.fieldwork)
        names = list(editor.photos(folder))
        now = self.photo or editor.shown_photo(folder) or (names[0] if names else "")
        if now not in names:
            self.report({"ERROR"}, t("{} has no photo “{}”.", folder, now))
            return {"CANCELLED"}
        try:
            show_photo(context.scene, folder, names[(names.index(now) + self.step) % len(names)])
        except (OSError, RuntimeError) as error:
            self.report({"ERROR"}, t("The photo “{}” cannot be read: {}", now, str(error)))
            return {"CANCELLED"}
        return {"FINISHED"}


def show_photo(scene: bpy.types.Scene, folder: Path, name: str) -> None:
    """Show a photo to be marked, and let the engine load meanwhile."""
    editor.show(folder, editor.photos(folder)[name])
    session.begin(scene.fieldwork)
    if not bpy.app.background and not queue.busy:
        with suppress(EngineError):  # photos are looked at without an engine, too
            queue.ask("label checkout", {"project": str(folder)})


class FIELDWORK_OT_label_class(Operator):
    """Choose the class that is marked"""

    bl_idname = "fieldwork.label_class"
    bl_label = "Choose Class"
    bl_options = {"INTERNAL"}

    number: IntProperty(name="Number", description="Place of the class in the list", default=1, min=1)

    def execute(self, context: Context) -> set[str]:
        settings = context.scene.fieldwork
        if self.number > len(settings.classes):
            self.report({"WARNING"}, t("There are only {} classes", len(settings.classes)))
            return {"CANCELLED"}
        settings.class_index = self.number - 1
        if settings.label_tool in ("erase", "void"):
            settings.label_tool = "brush"
        return {"FINISHED"}


class FIELDWORK_OT_label_size(Operator):
    """Make the brush larger or smaller"""

    bl_idname = "fieldwork.label_size"
    bl_label = "Brush Size"
    bl_options = {"INTERNAL"}

    factor: FloatProperty(name="Factor", description="By how much", default=1.25, min=0.1, max=10.0)

    def execute(self, context: Context) -> set[str]:
        settings = context.scene.fieldwork
        settings.label_width = min(max(settings.label_width * self.factor, 1.0), 2000.0)
        return {"FINISHED"}


def cutting_out(folder: Path) -> Job | None:
    """The job that cuts something out of a photo, where nothing was drawn since it was asked for: that is what undo means."""
    jobs = [job for job in (queue.running, *queue.waiting) if job is not None and job.state != "cancelling"]
    job = next((job for job in jobs if job.verb == "assist segment" and job.project == folder), None)
    return job if job is not None and pending.is_top(folder, job.params) else None


class FIELDWORK_OT_label_undo(Operator):
    """Take back a mark that the engine is about to take or to make"""

    bl_idname = "fieldwork.label_undo"
    bl_label = "Undo Mark"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        folder = snapshot.folder_of(context.scene.fieldwork)
        # Else the key is Blender's.
        return folder is not None and (pending.unfinished(folder) or cutting_out(folder) is not None)

    def execute(self, context: Context) -> set[str]:
        folder = snapshot.folder_of(context.scene.fieldwork)
        if folder is None:
            return {"CANCELLED"}
        job = cutting_out(folder)
        if job is not None:
            queue.cancel(job)
        else:
            session.undo_later(folder)
        return {"FINISHED"}


class FIELDWORK_OT_label_retry(Operator):
    """Send the marks that the engine did not take, and propagate again"""

    bl_idname = "fieldwork.label_retry"
    bl_label = "Try Again"

    def execute(self, context: Context) -> set[str]:
        session.retry()
        return {"FINISHED"}


CLASSES = [
    FIELDWORK_OT_label_prepare,
    FIELDWORK_OT_label_propagate,
    FIELDWORK_OT_label_overlay,
    FIELDWORK_OT_label_parts,
    FIELDWORK_OT_label_next,
    FIELDWORK_OT_label_accept,
    FIELDWORK_OT_label_carry,
    FIELDWORK_OT_label_photo,
    FIELDWORK_OT_label_class,
    FIELDWORK_OT_label_size,
    FIELDWORK_OT_label_undo,
    FIELDWORK_OT_label_retry,
]
