"""Into the scene: cameras, points, mesh and materials of the capture under one parent, updated in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
from bpy.props import EnumProperty
from bpy.types import Context

from ..addon import jobs, state
from .base import ProjectOperator, need_poses, refresh_scenes, scene_settings


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

    def parameters(self, context: Context) -> dict[str, Any]:
        return {"project": self.project_path(context), "run": self.value(context, "run")}

    def after(self) -> Callable[[jobs.Job], None]:
        cameras, name = self.cameras, bpy.context.scene.name
        return lambda job: import_result(job, cameras, name)


def import_result(job: jobs.Job, cameras: str, scene_name: str) -> None:
    """Import what the engine prepared, as one step of undo."""
    refresh_scenes(job)
    if job.state != "done" or not job.result:
        return
    from ..addon.package import read_package
    from ..addon.scene_import import import_package

    # Another file may have been loaded meanwhile.
    scene = bpy.data.scenes.get(scene_name) or bpy.context.scene
    if state.folder_of(scene.fieldwork) != job.project:
        job.warnings.append("The scene shows another project by now: press Update Scene there.")
        return
    imported = import_package(scene, read_package(job.result["folder"]), cameras)
    job.warnings += imported.warnings
    state.show_classes(scene.fieldwork)
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message="Update Scene from Fieldwork")


CLASSES = [FIELDWORK_OT_import_scene]
