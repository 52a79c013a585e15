"""Train: the field of the capture, in one or several runs."""

from typing import Any

from bl_operators.presets import AddPresetBase
from bpy.types import Context, Event, Operator

from ..addon.jobs.job import Done, Job
from ..addon.project import runs, snapshot
from ..addon.props import BoolProperty, EnumProperty, FloatProperty, StringProperty
from ..addon.text import t
from .base import (
    HoldoutProperty,
    ProjectOperator,
    absolute,
    hold_out,
    need_held_out,
    need_poses,
    need_run,
    refresh_scenes,
    scene_settings,
)


def parse_settings(text: str) -> dict[str, str]:
    """`name=value` pairs separated by blanks. Raises ValueError for a word without “=”."""
    pairs = {}
    for word in text.split():
        name, equals, value = word.partition("=")
        if not (name and equals and value):
            raise ValueError(t("“{}” is not a setting: write name=value, e.g. loss.semantic_weight=0.1.", word))
        pairs[name] = value
    return pairs


@scene_settings(preset="preset", run="run", time_limit="time_limit", steps="steps", settings="settings")
class FIELDWORK_OT_train(ProjectOperator):
    """Train the field on the posed photos"""

    bl_idname = "fieldwork.train"
    bl_label = "Train"
    verb = "train"
    needs = (need_poses,)

    holdout: HoldoutProperty()
    resume: BoolProperty(name="Resume", description="Go on from the last checkpoint of the run", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: Context, properties: Any) -> str:
        return t("Go on from the last checkpoint of the run") if properties.resume else t(cls.__doc__ or "")

    def invoke(self, context: Context, event: Event) -> set[str]:
        settings = context.scene.fieldwork
        if not self.resume and runs.has_run(snapshot.folder_of(settings), settings.run):
            # Hours of training may be in it.
            return context.window_manager.invoke_confirm(
                self,
                event,
                title=t("Train the run “{}” anew?", settings.run),
                message=t("The new training takes its place once it has a checkpoint. Another name keeps both."),
                confirm_text=t("Train"),
            )
        return self.execute(context)

    def parameters(self, context: Context) -> dict[str, Any]:
        run = self.value(context, "run")
        if not run:
            raise ValueError(t("Give the run a name."))
        seconds, steps = self.value(context, "time_limit"), self.value(context, "steps")
        return {
            "project": self.project_path(context),
            "preset": self.value(context, "preset"),
            "run": run,
            "holdout": hold_out(self, context),
            "time_limit": seconds if seconds > 0 else None,
            "steps": steps if steps > 0 else None,
            "set": parse_settings(self.value(context, "settings")),
            "resume": self.resume,
        }

    def after(self) -> Done:
        return trained


def trained(job: Job) -> None:
    refresh_scenes(job)
    whole = not ({"time_limit", "steps"} & job.params.keys()) and not job.params["resume"] and not job.params["set"]
    if job.state == "done" and job.result and whole:
        runs.remember_time(job.params["preset"], job.result["seconds"])


@scene_settings(run="run")
class FIELDWORK_OT_evaluate(ProjectOperator):
    """Compare renders of the run with photos that training did not see"""

    bl_idname = "fieldwork.evaluate"
    bl_label = "Measure Quality"
    verb = "evaluate"
    needs = (need_run, need_held_out)

    split: EnumProperty(
        name="Photos",
        description="Photos to compare with",
        items=[("test", "Held Out", "Photos that training did not see"), ("train", "Training", "Training photos")],
        options={"SKIP_SAVE"},
    )
    speed: BoolProperty(
        name="Speed",
        description="Measure frames of 800×800 too; without a GPU this can take minutes",
        default=False,
        options={"SKIP_SAVE"},
    )

    baked: BoolProperty(
        name="Baked",
        description="Compare renders of the baked field, and say what baking lost",
        default=False,
        options={"SKIP_SAVE"},
    )
    time_limit: FloatProperty(
        name="Time Limit",
        description="Compare as many photos, evenly spread, as fit into so many seconds; 0: all of them",
        default=0.0,
        min=0.0,
        options={"SKIP_SAVE"},
    )
    report_file: StringProperty(
        name="Report",
        description=".html or .pdf to write: whether the capture is good, and what to photograph next; empty: none",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "split": self.split,
            "speed": self.speed,
            "baked": self.baked,
            "time_limit": self.time_limit or None,
            "report": absolute(self.report_file),
        }


@scene_settings(run="run")
class FIELDWORK_OT_bake(ProjectOperator):
    """Bake the run into voxels that render several times as fast"""

    bl_idname = "fieldwork.bake"
    bl_label = "Bake Field"
    verb = "bake"
    needs = (need_run,)

    memory: FloatProperty(
        name="Memory",
        description="Graphics memory that the baked field may take, in megabytes",
        default=100.0,
        min=2.0,
        max=1500.0,
        options={"SKIP_SAVE"},
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        return {"project": self.project_path(context), "run": self.value(context, "run"), "memory": self.memory}


class FIELDWORK_OT_use_run(Operator):
    """Make this the run that is trained, rendered and meshed"""

    bl_idname = "fieldwork.use_run"
    bl_label = "Use Run"
    bl_options = {"REGISTER", "UNDO"}

    run: StringProperty(name="Run", description="Name of the run", options={"SKIP_SAVE"})

    def execute(self, context: Context) -> set[str]:
        context.scene.fieldwork.run = self.run
        return {"FINISHED"}


class FIELDWORK_OT_train_preset_add(AddPresetBase, Operator):
    """Add or remove a preset of the training settings"""

    bl_idname = "fieldwork.train_preset_add"
    bl_label = "Add Training Preset"
    preset_menu = "FIELDWORK_PT_train_presets"
    preset_subdir = "fieldwork/train"
    preset_defines = ["fieldwork = bpy.context.scene.fieldwork"]
    preset_values = [
        "fieldwork.preset",
        "fieldwork.hold_out",
        "fieldwork.time_limit",
        "fieldwork.steps",
        "fieldwork.settings",
    ]


CLASSES = [
    FIELDWORK_OT_train,
    FIELDWORK_OT_evaluate,
    FIELDWORK_OT_bake,
    FIELDWORK_OT_use_run,
    FIELDWORK_OT_train_preset_add,
]
