"""Poses: where each photo was taken, which way is up, how large things are."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context
from mathutils import Matrix, Vector

from ..addon.jobs.job import Done, Job
from ..addon.live.shared_scene import OWNER
from ..addon.project import snapshot
from ..addon.props import BoolProperty, StringProperty
from ..addon.scene.frame import scene_from_capture
from ..addon.text import t
from ..addon.undo import undo_step
from .base import ProjectOperator, need_poses, need_project, refresh_scenes, scene_settings
from .scene import update_scene


@scene_settings(preset="pose_preset", group="pose_group", keep_exposure="keep_exposure")
class FIELDWORK_OT_poses(ProjectOperator):
    """Estimate where each photo was taken"""

    bl_idname = "fieldwork.poses"
    bl_label = "Estimate Poses"
    verb = "poses"
    needs = (need_project,)

    restart: BoolProperty(
        name="Start Over", description="Place all photos anew, also those that have a pose", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, context: Context, properties: Any) -> str:
        anew = t("Place all photos anew, also those that have a pose")
        return anew if properties.restart else t(cls.__doc__ or "")

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "preset": self.value(context, "preset"),
            "group": self.value(context, "group"),
            "keep_exposure": self.value(context, "keep_exposure"),
            "restart": self.restart,
        }


@scene_settings(up="up", point_a="point_a", point_b="point_b", distance="distance")
class FIELDWORK_OT_align(ProjectOperator):
    """Set which way is up, and the true size from the distance of two points"""

    bl_idname = "fieldwork.align"
    bl_label = "Apply Up and Scale"
    verb = "align"
    needs = (need_poses,)

    use_scale: BoolProperty(
        name="Scale", description="Set the scale from the two points", default=True, options={"SKIP_SAVE"}
    )
    ground: BoolProperty(
        name="Level Ground",
        description="Level the ground the photos show and put it at height 0",
        options={"SKIP_SAVE"},
    )
    gps: BoolProperty(
        name="GPS", description="Take the true size and north from the photos' GPS positions", options={"SKIP_SAVE"}
    )
    crop: StringProperty(
        name="Region",
        description="Training region in meters: auto, none, or x0,y0,z0,x1,y1,z1; empty: as it is",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, context: Context, properties: Any) -> str:
        if properties.ground:
            return t("Level the ground the photos show and put it at height 0")
        if properties.gps:
            return t("Take the true size and north from the photos' GPS positions")
        return t(cls.__doc__ or "")

    def parameters(self, context: Context) -> dict[str, Any]:
        params: dict[str, Any] = {"project": self.project_path(context)}
        up = self.value(context, "up")
        capture_from_scene = scene_from_capture(context.scene, snapshot.owner(Path(params["project"]))).inverted_safe()
        if up != "auto":
            params["up"] = up_in_capture(up, capture_from_scene)
        a, b = (capture_from_scene @ Vector(self.value(context, name)) for name in ("point_a", "point_b"))
        if self.use_scale and a != b:
            unit = context.scene.unit_settings.scale_length or 1.0
            distance = self.value(context, "distance") * unit
            params["scale"] = [",".join(f"{v:.9g}" for v in a), ",".join(f"{v:.9g}" for v in b), distance]
        params |= {name: True for name in ("ground", "gps") if getattr(self, name)}
        params |= {"crop": self.crop} if self.crop else {}
        if len(params) == 1:
            raise ValueError(t("Choose an up direction, or pick two points first."))
        return params

    def after(self) -> Done:
        return aligned


def up_in_capture(up: str, capture_from_scene: Matrix) -> str:
    """An axis of the scene as `align` takes it: its letter where the capture is not turned, else "x,y,z" in the capture."""
    axis = Vector([float(name == up[-1]) for name in "xyz"]) * (-1 if up.startswith("-") else 1)
    turned = (capture_from_scene.to_3x3() @ axis).normalized()
    return up if (turned - axis).length < 1e-6 else ",".join(f"{value:.9g}" for value in turned)


def aligned(job: Job) -> None:
    """Directions and points were those of the frame before: forget them, and bring the scene into the new frame."""
    refresh_scenes(job)
    if job.state != "done":
        return
    for scene in bpy.data.scenes:
        settings = scene.fieldwork
        if snapshot.folder_of(settings) == job.project:
            settings.up = "auto"
            settings.point_a = settings.point_b = (0.0, 0.0, 0.0)
            if OWNER not in scene:  # one that renders fields or shadows shows what stands in another one
                update_scene(job, scene)
    undo_step("Apply Up and Scale")


CLASSES = [FIELDWORK_OT_poses, FIELDWORK_OT_align]
