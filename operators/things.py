"""Things: the instances on the mesh, how they stand to each other, and selecting them."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon.jobs.job import Done, Job
from ..addon.jobs.queue import queue
from ..addon.project import snapshot, things
from ..addon.props import BoolProperty, IntProperty, StringProperty
from ..addon.text import t
from ..addon.undo import undo_step
from .base import ProjectOperator, refresh_scenes, scene_settings
from .measure import need_mesh

NOTHING = "Select a thing first, in the list or in the viewport."


@scene_settings(run="run", query="thing_query")
class FIELDWORK_OT_relations(ProjectOperator):
    """Find how the things on the mesh stand to each other, and select those that the question means"""

    bl_idname = "fieldwork.relations"
    bl_label = "Find Relations"
    verb = "relations"
    needs = (need_mesh,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "query": self.value(context, "query"),
        }

    def after(self) -> Done:
        return show_relations


def show_relations(job: Job) -> None:
    """Note the relations with the objects of the scene, and select what was asked for."""
    refresh_scenes(job)
    if job.state != "done" or not job.result or job.project is None:
        return
    from ..addon.scene import things as objects  # not at the top: enabling the extension must be quick

    known = things.graph(job.project, str(job.params.get("run", "main")))
    if known is None:
        return
    owner, asked = snapshot.owner(job.project), str(job.params.get("query", "")).strip()
    objects.describe(owner, known)
    if asked:
        ids = [thing["id"] for thing in known["things"] if thing["name"] in job.result["found"]]
        told = ", ".join(job.result["found"])
        job.warnings.append(t("{}: {}", asked, told) if ids else t("{}: nothing", asked))
        if ids and not objects.select(owner, ids):
            job.warnings.append(t("They are not in the scene: press Update Scene."))
    undo_step("Select Things")


@scene_settings(run="run")
class FIELDWORK_OT_instances(ProjectOperator):
    """Rename the chosen thing, join the chosen ones into one, or split one into its pieces"""

    bl_idname = "fieldwork.instances"
    bl_label = "Change Things…"
    verb = "instances"
    needs = (need_mesh,)

    things: StringProperty(
        name="Things", description="Names of the things, separated by commas; empty: those of the selected objects",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    rename: StringProperty(name="New Name", description="Name for the thing", options={"SKIP_SAVE"})
    merge: BoolProperty(name="Join", description="The things are one", options={"SKIP_SAVE"})
    split: BoolProperty(
        name="Split", description="The unconnected pieces are things of their own", options={"SKIP_SAVE"}
    )

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        if self.rename or self.merge or self.split:
            return self.execute(context)
        names = selected_names(context)
        if not names and not self.things:
            self.report({"ERROR"}, t(NOTHING))
            return {"CANCELLED"}
        self.rename = self.things or names[0]
        return context.window_manager.invoke_props_dialog(self)

    def parameters(self, context: Context) -> dict[str, Any]:
        project = self.project_path(context)
        params: dict[str, Any] = {"project": project, "run": self.value(context, "run")}
        names = [name.strip() for name in self.things.split(",") if name.strip()] or selected_names(context)
        if not (self.rename or self.merge or self.split):
            return params
        if not names:
            raise ValueError(t(NOTHING))
        if self.merge:
            if len(names) < 2:
                raise ValueError(t("Select two things or more to join: in the list with Ctrl."))
            return {**params, "merge": names}
        return {**params, "split": names[0]} if self.split else {**params, "rename": [names[0], self.rename]}

    def after(self) -> Done:
        return show_instances


def selected_names(context: Context) -> list[str]:
    """The names of the things that are selected, the active one first."""
    from ..addon.scene import things as objects  # not at the top: enabling the extension must be quick

    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    known = snapshot.cached_json(folder / "exports" / settings.run / "instances.json") if folder else None
    names = {entry["id"]: entry["name"] for entry in known or []}
    chosen = objects.selected(snapshot.owner(folder)) if folder else []
    return [names[number] for number in chosen if number in names]


def show_instances(job: Job) -> None:
    """Give objects the names of their things; where things were joined or split, tell how to see that."""
    refresh_scenes(job)
    if job.state != "done" or not job.result or job.project is None:
        return
    # Not at the top: enabling the extension must be quick.
    from ..addon.scene import things as objects
    from ..addon.scene.owned import call

    own = objects.objects(snapshot.owner(job.project))
    for entry in job.result["instances"]:
        if entry["id"] in own and entry["name"] in job.result["changed"]:
            call(own[entry["id"]], entry["name"])
    if job.params.get("rename"):
        rename_in_fields(job.project, str(job.params.get("run", "main")), *job.params["rename"])
    if not bpy.app.background and job.result["changed"]:  # the list is that of the relations, which name the things
        params = {"project": str(job.project), "run": str(job.params.get("run", "main"))}
        queue.follow_up(queue.make("relations", params, show_relations))
    if own and (job.params.get("merge") or job.params.get("split")):
        job.warnings.append(t("Press Update Scene to see the things as they are now."))
    undo_step("Change Things")


def rename_in_fields(project: Path, run: str, old: str, new: str) -> None:
    """Let a thing that got another name keep its look and its copies in the field objects of the run."""
    from ..addon.live import fields
    from ..addon.live import things as of_fields

    for field in fields.field_objects(bpy.data.objects):
        if fields.folder_of(field.fieldwork) == project and field.fieldwork.run == run:
            of_fields.rename(field, old, new.strip(), bpy.data.objects)


class FIELDWORK_OT_select_thing(Operator):
    """Select the object of the thing; where the surface is one object, its faces. Shift: also what it holds. Ctrl: beside what is selected"""

    bl_idname = "fieldwork.select_thing"
    bl_label = "Select Thing"
    bl_options = {"REGISTER", "UNDO"}

    number: IntProperty(name="Number", description="Number of the thing", options={"SKIP_SAVE"})
    below: BoolProperty(name="All of It", description="Also what it holds", options={"SKIP_SAVE"})
    extend: BoolProperty(name="Extend", description="What is selected stays selected", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set(t("Things are selected in Object Mode"))
            return False
        return True

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        self.below, self.extend = self.below or event.shift, self.extend or event.ctrl
        return self.execute(context)

    def execute(self, context: Context) -> set[str]:
        from ..addon.scene import things as objects  # not at the top: enabling the extension must be quick

        settings = context.scene.fieldwork
        folder = snapshot.folder_of(settings)
        known = things.graph(folder, settings.run)
        chosen = [self.number]
        if self.below and known is not None:
            chosen += things.held(things.outline(known), self.number)
        if folder is None or not objects.select(snapshot.owner(folder), chosen, self.extend):
            self.report({"WARNING"}, t("It is not in the scene: press Update Scene."))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = [FIELDWORK_OT_relations, FIELDWORK_OT_instances, FIELDWORK_OT_select_thing]
