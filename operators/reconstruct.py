"""Whole jobs in one step, made for scripts: photos to a .blend, and simulated photos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context

from ..addon.props import IntProperty, IntVectorProperty, StringProperty
from ..addon.text import t
from .base import VerbOperator, scene_settings


@scene_settings(
    photos="photos", labels="labels", masks="masks", classes="class_file", preset="preset",
    time_limit="time_limit",
)  # fmt: skip
class FIELDWORK_OT_reconstruct(VerbOperator):
    """Take photos all the way to a labelled mesh: read, estimate poses, train, extract the mesh, write a .blend"""

    bl_idname = "fieldwork.reconstruct"
    bl_label = "Reconstruct"
    verb = "reconstruct"

    out: StringProperty(
        name="Project", description="Project folder; empty: that of the scene", subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    blend: StringProperty(
        name="Blender File", description=".blend to write; empty: none", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        photos, out = self.path(context, "photos"), self.out or context.scene.fieldwork.project
        if photos is None:
            raise ValueError(t("Choose a folder of photos, or a video, first."))
        if not out:
            raise ValueError(t("Choose a project folder first."))
        return {
            "photos": photos,
            "out": str(Path(bpy.path.abspath(out)).absolute()),
            **{name: self.path(context, name) for name in ("labels", "masks", "classes")},
            "preset": self.value(context, "preset"),
            "time_limit": self.value(context, "time_limit") or None,
            "blend": str(Path(bpy.path.abspath(self.blend)).absolute()) if self.blend else None,
        }


class FIELDWORK_OT_simulate(VerbOperator):
    """Build a museum scene and photograph it: a capture to try everything on, with the truth beside it"""

    bl_idname = "fieldwork.simulate"
    bl_label = "Simulate Capture"
    verb = "simulate"

    out: StringProperty(name="Folder", description="New or empty folder for the capture", subtype="DIR_PATH")
    views: IntProperty(name="Photos", description="Number of photos", default=48, min=4, soft_max=200)
    size: IntVectorProperty(
        name="Size", description="Width and height of the photos", size=2, default=(480, 320), min=16
    )
    seed: IntProperty(name="Seed", description="Another seed, another scene", min=0)
    samples: IntProperty(name="Samples", description="Cycles samples per pixel", default=4, min=1)

    def parameters(self, context: Context) -> dict[str, Any]:
        if not self.out:
            raise ValueError(t("Choose a folder for the capture."))
        return {
            "out": str(Path(bpy.path.abspath(self.out)).absolute()),
            "views": self.views,
            "size": list(self.size),
            "seed": self.seed,
            "samples": self.samples,
        }


CLASSES = [FIELDWORK_OT_reconstruct, FIELDWORK_OT_simulate]
