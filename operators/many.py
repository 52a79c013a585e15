"""More than one machine does at once: many captures, and one large capture in blocks."""

from typing import Any

import bpy
from bpy.types import Context

from ..addon.choices import TEXTURE_SIZES
from ..addon.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from ..addon.text import t
from .base import HoldoutProperty, ProjectOperator, VerbOperator, absolute, hold_out, need_poses, scene_settings
from .train import parse_settings


class FIELDWORK_OT_batch(VerbOperator):
    """Reconstruct many captures, one after the other or on a cluster; one that fails does not stop the others"""

    bl_idname = "fieldwork.batch"
    bl_label = "Reconstruct Many"
    verb = "batch"

    list: StringProperty(
        name="List", description=".csv or .json file with one capture a row", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    retries: IntProperty(
        name="Retries", description="How often a capture that failed is tried again", default=1, min=0, soft_max=5
    )
    report_file: StringProperty(
        name="Report", description="JSON report to write; empty: beside the list", subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    cluster: StringProperty(
        name="Cluster",
        description="Address HOST:PORT of a Ray cluster, or auto for one on this machine; empty: one capture after the other",
        options={"SKIP_SAVE"},
    )
    storage: StringProperty(
        name="Storage",
        description="Where workers of the cluster take files from and leave them, s3://bucket/folder for instance; "
        "empty: the folder of the list, which all of them see",
        options={"SKIP_SAVE"},
    )
    wheel: StringProperty(
        name="Wheel", description="Wheel of Fieldwork that workers of the cluster use; empty: what they have",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    keep_free: FloatProperty(
        name="Keep Free", description="GB: a worker of the cluster with less free on its disk gets nothing to do",
        default=2.0, min=0.0,
    )  # fmt: skip
    dry_run: BoolProperty(
        name="Dry Run", description="Do nothing: say what there is to do, what is missing, and how long it may take",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=380)

    def parameters(self, context: Context) -> dict[str, Any]:
        if not self.list:
            raise ValueError(t("Choose a list of captures."))
        if self.cluster and not self.dry_run:
            context.scene.fieldwork.campaign = self.list  # which the panel follows
        return {
            "list": absolute(self.list),
            "retries": self.retries,
            "report": absolute(self.report_file),
            "cluster": self.cluster or None,
            "storage": self.storage or None,
            "wheel": absolute(self.wheel),
            "keep_free": self.keep_free,
            "dry_run": self.dry_run,
        }


@scene_settings(preset="preset", time_limit="time_limit", settings="settings", faces="faces")
class FIELDWORK_OT_blocks(ProjectOperator):
    """Train and mesh a large capture in parts that overlap, one after the other or on a cluster, and join their meshes"""

    bl_idname = "fieldwork.blocks"
    bl_label = "Reconstruct in Blocks"
    verb = "blocks"
    needs = (need_poses,)

    count: IntProperty(name="Blocks", description="Number of blocks", default=2, min=2, soft_max=64)
    steps: IntProperty(name="Steps", description="Steps of training of each block; 0: as the preset says", min=0)
    resolution: IntProperty(
        name="Resolution", description="Cells along the longest side of a block", default=512, min=16, max=2048
    )
    out: StringProperty(
        name="File", description="File for the whole mesh: .ply, .obj, .glb, .stl, .usdc; empty: in the project alone",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    texture: EnumProperty(
        name="Texture", description="Size of the whole mesh's texture in pixels", items=TEXTURE_SIZES, default="0"
    )
    lods: IntProperty(
        name="Levels of Detail", description="Levels of detail to write as well, each with a quarter of the triangles",
        min=0, max=6,
    )  # fmt: skip
    turntable: StringProperty(
        name="Turntable", description="Folder for pictures of the whole mesh from eight sides; empty: none",
        subtype="DIR_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    cluster: StringProperty(
        name="Cluster",
        description="Address HOST:PORT of a Ray cluster, or auto for one on this machine; empty: one block after the other",
        options={"SKIP_SAVE"},
    )
    retries: IntProperty(
        name="Retries", description="How often a task of the cluster is tried again", default=1, min=0, soft_max=5
    )
    wheel: StringProperty(
        name="Wheel", description="Wheel of Fieldwork that workers of the cluster use; empty: what they have",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    keep_free: FloatProperty(
        name="Keep Free", description="GB: a worker of the cluster with less free on its disk gets nothing to do",
        default=2.0, min=0.0,
    )  # fmt: skip
    holdout: HoldoutProperty()

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=380)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "count": self.count,
            "preset": self.value(context, "preset"),
            "steps": self.steps or None,
            "time_limit": self.value(context, "time_limit") or None,
            "set": parse_settings(self.value(context, "settings")),
            "holdout": hold_out(self, context),
            "faces": self.value(context, "faces"),
            "resolution": self.resolution,
            "out": absolute(self.out),
            "texture": None if self.texture == "0" else self.texture,
            "lods": self.lods,
            "turntable": absolute(self.turntable),
            "cluster": self.cluster or None,
            "retries": self.retries,
            "wheel": absolute(self.wheel),
            "keep_free": self.keep_free,
        }


CLASSES = [FIELDWORK_OT_batch, FIELDWORK_OT_blocks]
