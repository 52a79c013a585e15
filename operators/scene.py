"""Into the scene: cameras, points, mesh and materials of the capture under one parent, updated in place."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon import paths
from ..addon.jobs.job import Done, Job, Steps
from ..addon.jobs.queue import queue
from ..addon.project import classes, snapshot
from ..addon.props import StringProperty
from ..addon.roles import by_role
from ..addon.scene import viewing
from ..addon.text import t
from ..addon.undo import undo_step
from .base import ProjectOperator, absolute, need_poses, refresh_scenes, scene_of, scene_settings, set_if_empty

SPLIT_ROLES = {"instance:": "instances", "class:": "classes"}  # how roles of the surface's objects begin


@scene_settings(run="run", cameras="scene_cameras", split="scene_split")
class FIELDWORK_OT_import_scene(ProjectOperator):
    """Bring the cameras, the sparse points and the mesh into the scene, or update those that are there"""

    bl_idname = "fieldwork.import_scene"
    bl_label = "Update Scene"
    verb = "package"
    needs = (need_poses,)

    renders: StringProperty(
        name="Renders",
        description="Folder of rendered photos to show behind their cameras; empty: those of the panel",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        project = self.project_path(context)
        set_if_empty(context.scene, project)
        settings = context.scene.fieldwork  # later updates keep to what was chosen
        settings.scene_cameras, settings.scene_split = self.value(context, "cameras"), self.value(context, "split")
        return {"project": project, "run": self.value(context, "run"), "renders": absolute(self.renders)}

    def after(self) -> Done:
        settings, name = bpy.context.scene.fieldwork, bpy.context.scene.name
        cameras, split = settings.scene_cameras, settings.scene_split
        return lambda job: import_result(job, cameras, name, split)


def update_scene(job: Job, scene: bpy.types.Scene, always: bool = False) -> None:
    """After a job that changed what stands in the scene: update what an earlier import put there; nothing where none did,
    unless `always`."""
    owner = snapshot.owner(job.project)
    roles = set(by_role(scene.objects, owner))
    if not roles and not always:
        return
    settings, name = scene.fieldwork, scene.name
    cameras, split = settings.scene_cameras, settings.scene_split
    if not settings.is_property_set("scene_cameras"):  # the file is one of `fieldwork blend`, or of Fieldwork 0.1
        many, animated = any(role.startswith("camera:") for role in roles), "camera path" in roles
        cameras = "both" if many == animated else "many" if many else "animated"
    if not settings.is_property_set("scene_split"):
        split = next((kind for start, kind in SPLIT_ROLES.items() if any(r.startswith(start) for r in roles)), "none")
    params = {"project": str(job.project), "run": settings.run}
    queue.follow_up(queue.make("package", params, lambda done: import_result(done, cameras, name, split)))


def import_result(job: Job, cameras: str, scene_name: str, split: str = "none") -> Steps | None:
    """Import what the engine prepared, as one step of undo."""
    refresh_scenes(job)
    if job.state != "done" or not job.result:
        return None
    scene = scene_of(job.project, scene_name)
    if scene is None:
        job.warnings.append(t("No scene shows the project by now: press Update Scene in one that does."))
        return None
    return import_steps(job, cameras, scene, split)


def import_steps(job: Job, cameras: str, scene: bpy.types.Scene, split: str) -> Steps:
    # Not at the top: enabling the extension must be quick.
    from ..addon.scene import build
    from ..addon.scene.frame import root_of
    from ..addon.scene.slices import Held

    place, first = Held(bpy.data.scenes, scene), root_of(scene, snapshot.owner(job.project)) is None
    imported = yield from build.import_steps(scene, build.load(job.result["folder"], split), cameras)
    job.warnings += imported.warnings
    classes.show(place().fieldwork)
    if first:
        show_colors()
    yield 1.0, ""
    undo_step("Update Scene from Fieldwork")


def show_colors() -> None:
    """Let solid viewports show the photographed colors of points and mesh, where they show plain material colors."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and area.spaces.active.shading.color_type == "MATERIAL":
                area.spaces.active.shading.color_type = "VERTEX"


class FIELDWORK_OT_show_image(Operator):
    """Show a picture in an image editor; where none is open, one opens as the preferences say for renders"""

    bl_idname = "fieldwork.show_image"
    bl_label = "Show Picture"

    filepath: StringProperty(name="File", description="The picture", subtype="FILE_PATH", options={"SKIP_SAVE"})

    def execute(self, context: Context) -> set[str]:
        path = paths.absolute(self.filepath)
        if not path.is_file():
            self.report({"ERROR"}, t("There is nothing at {}.", path))
            return {"CANCELLED"}
        if not show_image(path):
            self.report({"INFO"}, t("See “{}” in an image editor", path.name))
        return {"FINISHED"}


def show_image(path: Path) -> bool:
    """Show a picture in an image editor; whether there is one."""
    from ..addon.render.slot import load_image  # not at the top: enabling the extension must be quick

    return viewing.show_image(load_image(path))


CLASSES = [FIELDWORK_OT_import_scene, FIELDWORK_OT_show_image]
