"""Dataset from Scene: photographs of what is open in Blender, with labels, depth and poses."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Event

from ..addon import paths
from ..addon.jobs.job import Job
from ..addon.jobs.queue import queue
from ..addon.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, IntVectorProperty, StringProperty
from ..addon.text import t
from .base import VerbOperator, refresh_scenes, set_if_empty
from .capture import project_for

PATHS = [
    ("hemisphere", "Hemisphere", "From all sides and above"),
    ("sphere", "Sphere", "From all sides, also from below"),
    ("camera", "Animated Camera", "From the places of the active camera over the frame range"),
    ("curve", "Along Curve", "From places evenly spread along a curve object"),
]
LABELS = [
    ("material", "Materials", "One class per pass index of the materials, or per material where none has an index"),
    ("object", "Objects", "One class per pass index of the objects, or per object where none has an index"),
    ("collection", "Collections", "One class per collection directly below the scene collection"),
    ("none", "None", "No label maps"),
]


class FIELDWORK_OT_dataset(VerbOperator):
    """Photograph the scene from many sides into a data set with poses, labels and depth"""

    bl_idname = "fieldwork.dataset"
    bl_label = "Dataset from Scene"
    verb = "dataset"

    out: StringProperty(name="Folder", description="New or empty folder for the data set", subtype="DIR_PATH")
    path_kind: EnumProperty(name="Path", description="Where the photos are taken from", items=PATHS)
    views: IntProperty(name="Photos", description="Number of photos", default=100, min=1, soft_max=400)
    around: EnumProperty(
        name="Around",
        description="What the camera looks at",
        items=[
            ("scene", "Scene", "The middle of everything that renders"),
            ("cursor", "3D Cursor", "The 3D cursor"),
        ],
    )
    radius: FloatProperty(
        name="Distance",
        description="Distance of the camera from what it looks at; 0: so that everything is in the picture",
        subtype="DISTANCE",
        min=0.0,
    )
    curve: StringProperty(name="Curve", description="Curve object to walk along")
    labels: EnumProperty(name="Labels", description="What tells classes apart", items=LABELS)
    size: IntVectorProperty(
        name="Size",
        description="Width and height of the photos in pixels; 0: as set in Output Properties",
        size=2,
        default=(0, 0),
        min=0,
    )
    samples: IntProperty(name="Samples", description="Cycles samples per pixel", default=32, min=1, soft_max=512)
    depth: BoolProperty(name="Depth", description="Write depth maps", default=True)
    transparent: BoolProperty(name="Transparent", description="Alpha 0 where there is nothing, instead of the world")
    make_project: BoolProperty(
        name="Make Project", description="Read the data set into a capture project beside its folder", default=True
    )

    def invoke(self, context: Context, event: Event) -> set[str]:
        if not self.out and bpy.data.filepath:
            self.out = str(Path(bpy.data.filepath).with_suffix("")) + "_dataset"
        active = context.active_object
        if not self.curve and active is not None and active.type == "CURVE":
            self.curve = active.name
        return context.window_manager.invoke_props_dialog(self, width=380)

    def draw(self, context: Context) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(self, "out")
        column.prop(self, "path_kind")
        if self.path_kind == "curve":
            column.prop_search(self, "curve", context.scene, "objects", icon="OUTLINER_OB_CURVE")
        column.prop(self, "views")
        if self.path_kind != "camera":
            column.prop(self, "around")
        if self.path_kind in {"sphere", "hemisphere"}:
            column.prop(self, "radius")
        column.separator()
        for name in ("labels", "size", "samples", "depth", "transparent", "make_project"):
            column.prop(self, name)
        if not all(self.size):
            from ..addon.scene.lens import picture_size  # not at the top: enabling the extension must be quick

            size = picture_size(context.scene.render)
            column.label(text=t("{} × {} pixels, as set in Output Properties", *size), icon="INFO")

    def parameters(self, context: Context) -> dict[str, Any]:
        if not self.out:
            raise ValueError(t("Choose a folder for the data set."))
        out = paths.absolute(self.out)
        if out.is_dir() and any(out.iterdir()):
            raise ValueError(t("{} is not empty: choose another folder.", out))
        # What is photographed is the scene as it is now, saved or not, in a Blender of its own: this one stays free.
        self._copy = str(Path(bpy.app.tempdir) / f"fieldwork-dataset-{time.time_ns()}.blend")
        bpy.ops.wm.save_as_mainfile(filepath=self._copy, copy=True, check_existing=False)
        return {
            "blend": self._copy,
            "out": str(out),
            "path": self.path_kind,
            "views": self.views,
            "center": list(context.scene.cursor.location) if self.around == "cursor" else None,
            "radius": self.radius or None,
            "curve": self.curve or None,
            "size": list(self.size) if all(self.size) else None,
            "samples": self.samples,
            "labels": self.labels,
            "depth": self.depth,
            "transparent": self.transparent,
        }

    def after(self) -> Callable[[Job], None]:
        copy, make_project, name = Path(self._copy), self.make_project, bpy.context.scene.name

        def show(job: Job) -> None:
            scene = bpy.data.scenes.get(name)  # another file may have been loaded meanwhile
            if scene is not None and job.state == "done":
                set_if_empty(scene, job.params["project"])
            refresh_scenes(job)

        def done(job: Job) -> None:
            copy.unlink(missing_ok=True)
            if job.state == "done" and make_project:
                folder = Path(job.params["out"])
                params = {"dataset": str(folder), "project": str(project_for(folder)), "format": "transforms"}
                queue.follow_up(queue.make("import", params, show))

        return done


CLASSES = [FIELDWORK_OT_dataset]
