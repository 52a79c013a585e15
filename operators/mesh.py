"""Mesh: the labelled surface of the field."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context

from ..addon.jobs.job import Done, Job, Steps
from ..addon.project import snapshot
from ..addon.props import BoolProperty
from ..addon.roles import ROLE
from ..addon.undo import undo_step
from .base import ProjectOperator, need_run, refresh_scenes, scene_of, scene_settings
from .scene import SPLIT_ROLES, show_colors, update_scene


@scene_settings(
    run="run",
    resolution="resolution",
    detail="detail",
    region="mesh_region",
    turntable="turntable",
    faces="faces",
    lods="lods",
    texture="texture",
    texture_kind="texture_kind",
    watertight="watertight",
    close_gaps="close_gaps",
    out="mesh_file",
    split="split",
)
class FIELDWORK_OT_mesh(ProjectOperator):
    """Extract the surface with its colors and labels"""

    bl_idname = "fieldwork.mesh"
    bl_label = "Extract Mesh"
    verb = "mesh"
    needs = (need_run,)

    preview: BoolProperty(
        name="Preview",
        description="Only a first look, in seconds; in a window it comes by itself where the scene has no mesh yet",
        options={"SKIP_SAVE"},
    )

    def execute(self, context: Context) -> set[str]:
        settings = context.scene.fieldwork
        folder = snapshot.folder_of(settings)
        if not bpy.app.background and not self.preview and folder is not None and not shows_mesh(context.scene, folder):
            bpy.ops.fieldwork.mesh(preview=True)
        return super().execute(context)

    def after(self) -> Done:
        preview, name = self.preview, bpy.context.scene.name
        return lambda job: show_preview(job, name) if preview else show_mesh(job, name)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "resolution": self.value(context, "resolution") or None,
            "detail": self.value(context, "detail") or None,
            "region": self.value(context, "region"),
            "turntable": self.also(context, "turntable"),
            "faces": self.value(context, "faces") or None,
            "lods": self.value(context, "lods"),
            "texture": None if (size := self.value(context, "texture")) == "0" else size,
            "watertight": self.value(context, "watertight"),
            "close_gaps": self.value(context, "close_gaps"),
            "texture_kind": self.value(context, "texture_kind"),
            "out": self.also(context, "out"),
            "split": self.value(context, "split"),
            "preview": self.preview,
        }

    def also(self, context: Context, name: str) -> str | None:
        """A path that the mesh is written to as well; the scene's are not for its preview."""
        if self.preview and not self.properties.is_property_set(name):
            return None
        return self.path(context, name)


def shows_mesh(scene: bpy.types.Scene, folder: Path) -> bool:
    """Whether a surface of the project is in the scene."""
    owner = snapshot.owner(folder)
    starts = ("mesh", *SPLIT_ROLES)
    return any(str(item.get(ROLE, "")).startswith(starts) and owner.owns(item) for item in scene.objects)


def show_preview(job: Job, scene_name: str) -> Steps | None:
    """Bring the first look into the scene, unless the mesh itself is there by now."""
    scene = scene_of(job.project, scene_name)
    if job.state != "done" or not job.result or scene is None or bpy.app.background or shows_mesh(scene, job.project):
        return None
    return preview_steps(job, scene)


def preview_steps(job: Job, scene: bpy.types.Scene) -> Steps:
    from ..addon.scene import build  # not at the top: enabling the extension must be quick

    known = snapshot.project(job.project) or {}
    yield from build.preview_steps(scene, snapshot.owner(job.project), known, job.result["preview"])
    show_colors()
    undo_step("First Look at the Mesh")


def show_mesh(job: Job, scene_name: str) -> None:
    """Bring the mesh into the scene, in a window: it takes the place of the one before, or of the first look."""
    refresh_scenes(job)
    scene = scene_of(job.project, scene_name)
    if job.state == "done" and scene is not None and not bpy.app.background:
        update_scene(job, scene, always=True)


CLASSES = [FIELDWORK_OT_mesh]
