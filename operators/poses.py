"""Poses: where each photo was taken, which way is up, how large things are."""

from __future__ import annotations

from typing import Any

from bpy.types import Context, Operator

from ..addon.props import BoolProperty, EnumProperty
from ..addon.text import t
from .base import ProjectOperator, need_poses, need_project, scene_settings


@scene_settings(preset="pose_preset")
class FIELDWORK_OT_poses(ProjectOperator):
    """Estimate where each photo was taken"""

    bl_idname = "fieldwork.poses"
    bl_label = "Estimate Poses"
    verb = "poses"
    needs = (need_project,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {"project": self.project_path(context), "preset": self.value(context, "preset")}


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

    def parameters(self, context: Context) -> dict[str, Any]:
        params: dict[str, Any] = {"project": self.project_path(context)}
        up = self.value(context, "up")
        if up != "auto":
            params["up"] = up
        a, b = (tuple(self.value(context, name)) for name in ("point_a", "point_b"))
        if self.use_scale and a != b:
            unit = context.scene.unit_settings.scale_length or 1.0
            distance = self.value(context, "distance") * unit
            params["scale"] = [",".join(f"{v:.9g}" for v in a), ",".join(f"{v:.9g}" for v in b), distance]
        if len(params) == 1:
            raise ValueError(t("Choose an up direction, or pick two points first."))
        return params


class FIELDWORK_OT_pick_point(Operator):
    """Take the place of the 3D cursor as one end of a known distance"""

    bl_idname = "fieldwork.pick_point"
    bl_label = "Use 3D Cursor"
    bl_options = {"REGISTER", "UNDO"}

    end: EnumProperty(items=[("A", "A", "First point"), ("B", "B", "Second point")], options={"SKIP_SAVE"})

    def execute(self, context: Context) -> set[str]:
        setattr(context.scene.fieldwork, f"point_{self.end.lower()}", context.scene.cursor.location)
        return {"FINISHED"}


CLASSES = [FIELDWORK_OT_poses, FIELDWORK_OT_align, FIELDWORK_OT_pick_point]
