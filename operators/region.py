"""The training region as a box in the viewport."""

from __future__ import annotations

import bpy
from bpy.types import Context, Operator
from mathutils import Vector

from ..addon.project import region as crop
from ..addon.project import snapshot as state
from ..addon.roles import ROLE
from ..addon.scene.frame import scene_from_capture
from ..addon.text import t
from .base import need_poses


class FIELDWORK_OT_crop_add(Operator):
    """Add a box that shows which part of the capture is trained"""

    bl_idname = "fieldwork.crop_add"
    bl_label = "Add Region Box"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = need_poses(context) or (t("There is a box already") if crop.find(context.scene) else None)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        folder = state.folder_of(context.scene.fieldwork)
        box = crop.add(context.scene, crop.read_bounds(folder) or default_bounds(context.scene))
        for obj in context.selected_objects:
            obj.select_set(False)
        box.select_set(True)
        context.view_layer.objects.active = box
        return {"FINISHED"}


class FIELDWORK_OT_crop_apply(Operator):
    """Train only what lies inside the box, from the next training on; in a window that goes without saying"""

    bl_idname = "fieldwork.crop_apply"
    bl_label = "Use Box"

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = need_poses(context) or (None if crop.find(context.scene) else t("Add a region box first"))
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        context.view_layer.update()
        try:
            crop.write_bounds(
                state.folder_of(context.scene.fieldwork), crop.bounds_of(context.scene, crop.find(context.scene))
            )
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, t("The next training covers the box"))
        return {"FINISHED"}


class FIELDWORK_OT_crop_remove(Operator):
    """Remove the box, and train everything the photos show again"""

    bl_idname = "fieldwork.crop_remove"
    bl_label = "Clear"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = need_poses(context)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        crop.write_bounds(state.folder_of(context.scene.fieldwork), None)
        box = crop.find(context.scene)
        if box is not None:
            bpy.data.objects.remove(box)
        return {"FINISHED"}


def default_bounds(scene: bpy.types.Scene) -> list[list[float]]:
    """Bounds, in the capture's frame, of what it put into the scene, else a cube of two metres around the cursor."""
    capture_from_scene = scene_from_capture(scene, state.folder_of(scene.fieldwork)).inverted_safe()
    corners = [
        capture_from_scene @ obj.matrix_world @ Vector(corner)
        for obj in scene.objects
        if obj.type == "MESH" and ROLE in obj
        for corner in obj.bound_box
    ]
    if corners:
        return [[pick(c[i] for c in corners) for i in range(3)] for pick in (min, max)]
    center = capture_from_scene @ scene.cursor.location
    return [[v - 1.0 for v in center], [v + 1.0 for v in center]]


CLASSES = [FIELDWORK_OT_crop_add, FIELDWORK_OT_crop_apply, FIELDWORK_OT_crop_remove]
