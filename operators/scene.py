"""Into the scene: cameras, points, mesh and materials of the capture under one parent, updated in place."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon import paths
from ..addon.choices import SPLITS
from ..addon.jobs.job import Done, Job, Steps
from ..addon.jobs.queue import queue
from ..addon.project import classes, snapshot
from ..addon.props import EnumProperty, StringProperty
from ..addon.roles import by_role
from ..addon.scene import viewing
from ..addon.text import t
from .base import ProjectOperator, absolute, need_poses, refresh_scenes, scene_of, scene_settings, set_if_empty

SPLIT_ROLES = {"instance:": "instances", "class:": "classes"}  # how roles of the surface's objects begin


@scene_settings(run="run")
class FIELDWORK_OT_import_scene(ProjectOperator):
    """Bring the cameras, the sparse points and the mesh into the scene, or update those that are there"""

    bl_idname = "fieldwork.import_scene"
    bl_label = "Update Scene"
    verb = "package"
    needs = (need_poses,)

    cameras: EnumProperty(
        name="Cameras",
        description="How the photos' cameras appear in the scene",
        items=[
            ("both", "Both", "One camera for each photo, and an animated one"),
            ("many", "One per Photo", "One camera for each photo, with the photo behind it"),
            ("animated", "Animated", "One camera that stands at each photo's place in turn"),
        ],
        options={"SKIP_SAVE"},
    )
    split: EnumProperty(name="Objects", description="How the surface appears", items=SPLITS, options={"SKIP_SAVE"})
    renders: StringProperty(
        name="Renders",
        description="Folder of rendered photos to show behind their cameras; empty: those of the panel",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        project = self.project_path(context)
        set_if_empty(context.scene, project)
        return {"project": project, "run": self.value(context, "run"), "renders": absolute(self.renders)}

    def after(self) -> Done:
        cameras, split, name = self.cameras, self.split, bpy.context.scene.name
        return lambda job: import_result(job, cameras, name, split)


def update_scene(job: Job, scene: bpy.types.Scene, always: bool = False) -> None:
    """After a job that changed what stands in the scene: update what an earlier import put there; nothing where none did,
    unless `always`."""
    owner = snapshot.owner(job.project)
    roles = set(by_role(scene.objects, owner))
    if not roles and not always:
        return
    many, animated = any(role.startswith("camera:") for role in roles), "camera path" in roles
    cameras, name = "both" if many == animated else "many" if many else "animated", scene.name
    params = {"project": str(job.project), "run": scene.fieldwork.run}
    split = next((kind for start, kind in SPLIT_ROLES.items() if any(r.startswith(start) for r in roles)), "none")
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
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message="Update Scene from Fieldwork")


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
