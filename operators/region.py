"""The training region as a box in the viewport."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.types import Context, Operator
from mathutils import Vector

from ..addon.project import edits, region, snapshot
from ..addon.roles import ROLE
from ..addon.scene.frame import scene_from_capture, world_of
from ..addon.text import t
from .base import WithProject, deliver_edits, need_poses


class FIELDWORK_OT_crop_add(Operator):
    """Add a box that shows which part of the capture is trained"""

    bl_idname = "fieldwork.crop_add"
    bl_label = "Add Region Box"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = need_poses(context) or (t("There is a box already") if region.find(context.scene) else None)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        folder = snapshot.folder_of(context.scene.fieldwork)
        box = region.add(context.scene, region.bounds(folder) or default_bounds(context.scene))
        for obj in context.selected_objects:
            obj.select_set(False)
        box.select_set(True)
        context.view_layer.objects.active = box
        return {"FINISHED"}


class FIELDWORK_OT_crop_apply(WithProject, Operator):
    """Train only what lies inside the box, from the next training on; in a window that goes without saying"""

    bl_idname = "fieldwork.crop_apply"
    bl_label = "Use Box"

    @classmethod
    def poll(cls, context: Context) -> bool:
        # Without a window the caller may give the project as an argument, which poll cannot see.
        if bpy.app.background:
            return True
        reason = need_poses(context) or (None if region.find(context.scene) else t("Add a region box first"))
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        context.view_layer.update()
        box = region.find(context.scene)
        try:
            folder = Path(self.project_path(context))
            if box is None:
                raise ValueError(t("Add a region box first."))
            region.edit(folder, region.bounds_of(context.scene, box, folder))
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not delivered(self):
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
        region.edit(snapshot.folder_of(context.scene.fieldwork), None)
        if not delivered(self):
            return {"CANCELLED"}
        box = region.find(context.scene)
        if box is not None:
            bpy.data.objects.remove(box)
        return {"FINISHED"}


def delivered(operator: Operator) -> bool:
    """Hand the region to the engine; without a window, whether it has taken it. Its refusal is reported."""
    deliver_edits()
    wrong = [edit for edit in edits.failed() if edit.verb == region.VERB] if bpy.app.background else []
    for edit in wrong:
        operator.report({"ERROR"}, str(edit.error))
    return not wrong


def default_bounds(scene: bpy.types.Scene) -> list[list[float]]:
    """Bounds, in the capture's frame, of what it put into the scene, else a cube of two metres around the cursor."""
    folder = snapshot.folder_of(scene.fieldwork)
    owner = snapshot.owner(folder) if folder else None
    capture_from_scene = scene_from_capture(scene, owner).inverted_safe()
    corners = [
        matrix @ Vector(corner)
        for obj in scene.objects
        if obj.type == "MESH" and ROLE in obj and owner is not None and owner.owns(obj)
        for matrix in [capture_from_scene @ world_of(obj)]
        for corner in obj.bound_box
    ]
    if corners:
        return [[pick(c[i] for c in corners) for i in range(3)] for pick in (min, max)]
    center = capture_from_scene @ scene.cursor.location
    return [[v - 1.0 for v in center], [v + 1.0 for v in center]]


CLASSES = [FIELDWORK_OT_crop_add, FIELDWORK_OT_crop_apply, FIELDWORK_OT_crop_remove]
