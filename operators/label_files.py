"""Labels from and for other labelling tools."""

from typing import Any

from bpy.types import Context, Event

from ..addon.jobs.job import Done, Job
from ..addon.props import BoolProperty, CheckExisting, EnumProperty, IntProperty, StringProperty
from ..addon.text import t
from .base import ProjectOperator, absolute, need_project, refresh_scenes, scene_settings, with_suffix

TOOLS = [
    ("coco", "COCO", "Instances as polygons or run lengths, one .json file"),
    ("cvat", "CVAT", "CVAT for images 1.1, one .xml file"),
    ("label-studio", "Label Studio", "Its export as JSON, one .json file"),
    ("labelme", "LabelMe", "A folder with a .json file for each photo"),
    ("segments", "Segments.ai", "A release file with its label pictures beside it"),
    ("supervisely", "Supervisely", "A project folder with meta.json"),
    ("png", "Label Maps", "A folder of PNG files of class ids or colors"),
]
MASKS = ("masks", "Masks", "A folder of black and white pictures, as Metashape has them")
READ = [("auto", "By Its Contents", "Look at the file"), *TOOLS, MASKS]
WRITE = [
    *TOOLS[:1],
    ("coco-panoptic", "COCO Panoptic", "A folder with panoptic.json and pictures of segment ids"),
    *TOOLS[1:],
    ("png-colors", "Colored Label Maps", "A folder of PNG files in the colors of the classes"),
    ("history", "History", "A table of who marked what when (.csv)"),
    MASKS,
]
SUFFIXES = {"history": ".csv", "coco": ".json", "cvat": ".xml", "label-studio": ".json"}  # formats of one file


class FIELDWORK_OT_label_import(ProjectOperator):
    """Give the photos labels that another labeling tool wrote; what nobody assigned stays unlabeled"""

    bl_idname = "fieldwork.label_import"
    bl_label = "Import Labels"
    verb = "label import"
    needs = (need_project,)

    filepath: StringProperty(
        name="File", description="File or folder with labels", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    format: EnumProperty(name="Format", description="Which tool wrote the labels", items=READ)
    class_name: StringProperty(
        name="Class of Masks", description="Class of what is white in black and white masks", default="object"
    )
    replace: BoolProperty(
        name="Replace", description="Also for photos that have labels of their own", options={"SKIP_SAVE"}
    )

    def invoke(self, context: Context, event: Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def parameters(self, context: Context) -> dict[str, Any]:
        path = absolute(self.filepath)
        if path is None:
            raise ValueError(t("Choose a file or folder with labels."))
        return {
            "project": self.project_path(context),
            "file": path,
            "format": self.format,
            "class_name": self.class_name,
            "replace": self.replace,
        }


@scene_settings(run="run")
class FIELDWORK_OT_label_export(ProjectOperator):
    """Write the labels of the photos for another labeling tool"""

    bl_idname = "fieldwork.label_export"
    bl_label = "Export Labels"
    verb = "label export"
    needs = (need_project,)

    filepath: StringProperty(
        name="File", description="File or new folder to write", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    format: EnumProperty(name="Format", description="What is written", items=WRITE)
    source: EnumProperty(
        name="Labels",
        description="Which labels are written",
        items=[
            ("maps", "Label Maps", "Those that photos have: given, imported or accepted"),
            ("marks", "Propagated", "What was propagated from the marks, for all photos"),
        ],
    )
    class_name: StringProperty(
        name="Class of Masks", description="Class that is white in masks; empty: the chosen one", options={"SKIP_SAVE"}
    )
    revision: IntProperty(
        name="Revision", description="Revision of the marks; -1: the one that is shown", default=-1, min=-1,
        options={"SKIP_SAVE"},
    )  # fmt: skip

    check_existing: CheckExisting()

    def check(self, context: Context) -> bool:
        before, self.filepath = self.filepath, self._named(self.filepath)
        return self.filepath != before  # the file browser then knows which file it is

    def _named(self, path: str) -> str:
        return with_suffix(path, SUFFIXES.get(self.format, ""), SUFFIXES.values())

    def invoke(self, context: Context, event: Event) -> set[str]:
        self.filepath = "labels"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def parameters(self, context: Context) -> dict[str, Any]:
        path = absolute(self.filepath)
        if path is None:
            raise ValueError(t("Choose a file or folder to write."))
        settings = context.scene.fieldwork
        chosen = settings.classes[settings.class_index].name if settings.class_index < len(settings.classes) else ""
        return {
            "project": self.project_path(context),
            "out": self._named(path),
            "format": self.format,
            "source": self.source,
            "run": self.value(context, "run"),
            "revision": None if self.revision < 0 else self.revision,
            "class_name": self.class_name or chosen,
        }

    def after(self) -> Done:
        return written


def written(job: Job) -> None:
    """Tell where the labels are."""
    refresh_scenes(job)
    if job.state == "done" and job.result:
        job.warnings.append(t("The labels of {} photos are at {}.", job.result["photos"], job.params["out"]))


CLASSES = [FIELDWORK_OT_label_import, FIELDWORK_OT_label_export]
