"""Models that the user brings help with marking: clicks and boxes cut things out, a first guess of classes."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, Event

from ..addon.jobs.job import Done, Job
from ..addon.labels import pending, session
from ..addon.props import BoolProperty, FloatProperty, FloatVectorProperty, IntProperty, StringProperty
from ..addon.text import t
from .base import ProjectOperator, absolute, need_poses, refresh_scenes, scene_settings
from .label import pairs, shown_photo


def need_models(context: Context) -> str | None:
    settings = context.scene.fieldwork
    missing = not (settings.label_encoder and settings.label_decoder)
    return need_poses(context) or (t("Choose the encoder and the decoder of a model first") if missing else None)


@scene_settings(encoder="label_encoder", decoder="label_decoder")
class FIELDWORK_OT_assist_embed(ProjectOperator):
    """Encode all photos with the model for clicks ahead, so that each click is answered at once"""

    bl_idname = "fieldwork.assist_embed"
    bl_label = "Encode Photos"
    verb = "assist embed"
    needs = (need_models,)

    photos: StringProperty(
        name="Photos", description="Names of the photos, separated by commas; empty: all", options={"SKIP_SAVE"}
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "encoder": self.path(context, "encoder"),
            "decoder": self.path(context, "decoder"),
            "photos": [name.strip() for name in self.photos.split(",") if name.strip()],
        }


@scene_settings(encoder="label_encoder", decoder="label_decoder", author="label_author")
class FIELDWORK_OT_assist_segment(ProjectOperator):
    """Cut out what lies at a place or in a box of the photo, and mark it"""

    bl_idname = "fieldwork.assist_segment"
    bl_label = "Cut Out"
    verb = "assist segment"
    needs = (need_models,)

    photo: StringProperty(
        name="Photo", description="Name of the photo; empty: the one in the image editor", options={"SKIP_SAVE"}
    )
    points: StringProperty(name="Inside", description="Pixels inside of the thing: x,y x,y …", options={"SKIP_SAVE"})
    outside: StringProperty(name="Outside", description="Pixels outside of the thing: x,y x,y …", options={"SKIP_SAVE"})
    box: FloatVectorProperty(
        name="Box", description="Left, top, right and bottom in pixels; all 0: none", size=4, options={"SKIP_SAVE"}
    )
    class_id: IntProperty(
        name="Class", description="Id of the class; -1: the chosen one", default=-1, options={"SKIP_SAVE"}
    )
    void: BoolProperty(name="Void", description="What is cut out is none of the classes", options={"SKIP_SAVE"})
    key: StringProperty(name="Key", description="A mark sent again with it is not made again", options={"SKIP_SAVE"})
    drawn_on: IntProperty(
        name="Drawn On",
        description="Revision of the marks that it goes on: marks drawn since stay on top of it; -1: the one that is shown",
        default=-1,
        min=-1,
        options={"SKIP_SAVE"},
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        settings = context.scene.fieldwork
        photo = shown_photo(self.photo, context)
        class_id = None if self.void else self.class_id
        if class_id == -1:
            if not 0 <= settings.class_index < len(settings.classes):
                raise ValueError(t("Add a class first: the + beside the list of classes"))
            class_id = settings.classes[settings.class_index].id
        return {
            "project": self.project_path(context),
            "photo": photo,
            "encoder": self.path(context, "encoder"),
            "decoder": self.path(context, "decoder"),
            "points": pairs(self.points),
            "outside": pairs(self.outside),
            "box": list(self.box) if any(self.box) else None,
            "class_id": class_id,
            "void": self.void,
            "author": self.value(context, "author"),
            "key": self.key,
            "drawn_on": None if self.drawn_on < 0 else self.drawn_on,
        }

    def before(self, context: Context, params: dict[str, Any]) -> None:
        # Where a mark is on its way, the engine looks which revision is shown when it begins.
        if "drawn_on" not in params:
            pending.go_on_top(Path(params["project"]), params)

    def after(self) -> Done:
        return marked


def marked(job: Job) -> None:
    """What was cut out is a mark in the journal: a step of undo, and propagated."""
    if job.state == "done" and job.result and job.result.get("revision") is not None and job.project is not None:
        session.taken(job.project, job.result["revision"])


class FIELDWORK_OT_assist_suggest(ProjectOperator):
    """Let a model such as SegFormer guess the classes of the photos that have no labels of their own"""

    bl_idname = "fieldwork.assist_suggest"
    bl_label = "Guess Classes"
    verb = "assist suggest"
    needs = (need_poses,)

    model: StringProperty(name="Model", description="ONNX file from pictures to logits of classes", subtype="FILE_PATH")
    mapping: StringProperty(
        name="Classes",
        description='JSON file with the class here of each class of the model: {"3": "wall"}',
        subtype="FILE_PATH",
    )
    photos: StringProperty(
        name="Photos", description="Names of the photos, separated by commas; empty: all", options={"SKIP_SAVE"}
    )
    least: FloatProperty(
        name="Least Probability", description="From which a pixel gets a class", default=0.5, min=0.0, max=1.0
    )

    def invoke(self, context: Context, event: Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=400)

    def parameters(self, context: Context) -> dict[str, Any]:
        model, mapping = absolute(self.model), absolute(self.mapping)
        if model is None or mapping is None:
            raise ValueError(t("Choose the model and the file with its classes."))
        return {
            "project": self.project_path(context),
            "model": model,
            "mapping": mapping,
            "photos": [name.strip() for name in self.photos.split(",") if name.strip()],
            "least": self.least,
        }

    def after(self) -> Done:
        return refresh_scenes


def cut_out(settings: Any, folder: Path, photo: str, places: list[tuple[float, float]]) -> None:
    """Ask the model for what lies at a click, or in the box that was dragged. Raises RuntimeError: the reason is reported."""
    (x0, y0), (x1, y1) = places[0], places[-1]
    dragged = max(abs(x1 - x0), abs(y1 - y0)) >= 3
    box = (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)) if dragged else (0.0,) * 4
    points = "" if dragged else f"{x0},{y0}"
    bpy.ops.fieldwork.assist_segment(project=str(folder), photo=photo, points=points, box=box)


CLASSES = [FIELDWORK_OT_assist_embed, FIELDWORK_OT_assist_segment, FIELDWORK_OT_assist_suggest]
