"""Whole jobs in one step, made for scripts: photos to a .blend, simulated photos, benchmarks."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context

from ..addon.choices import PRESETS
from ..addon.jobs.job import Done, Job
from ..addon.jobs.queue import queue
from ..addon.project import snapshot
from ..addon.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, IntVectorProperty, StringProperty
from ..addon.text import t
from .base import (
    HoldoutProperty,
    VerbOperator,
    absolute,
    hold_out,
    mask_mode,
    need_project_folder,
    refresh_scenes,
    scene_of,
    scene_settings,
)
from .scene import import_result
from .train import parse_settings


def need_source(context: Context) -> str | None:
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    if snapshot.imported(folder):
        return t("The poses of this project were imported: train and mesh it step by step")
    known = settings.photos or snapshot.source(folder).get("photos")
    return snapshot.absence(settings) or (None if known else t("Choose a folder of photos, or a video, first"))


@scene_settings(
    photos="photos", labels="labels", masks="masks", classes="class_file", mask_mode="mask_mode",
    keep_backdrop="keep_backdrop", keep_exposure="keep_exposure", preset="preset",
    time_limit="time_limit", settings="settings", faces="faces", texture="texture",
    watertight="watertight", close_gaps="close_gaps",
)  # fmt: skip
class FIELDWORK_OT_reconstruct(VerbOperator):
    """Take photos all the way to a labeled mesh: read, estimate poses, train, extract the mesh, write a .blend"""

    bl_idname = "fieldwork.reconstruct"
    bl_label = "Reconstruct"
    verb = "reconstruct"
    needs = (need_project_folder, need_source)

    out: StringProperty(
        name="Project", description="Project folder; empty: that of the scene", subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    blend: StringProperty(
        name="Blender File", description=".blend to write; empty: none", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    report_file: StringProperty(
        name="Report",
        description="Report to write, .html or .pdf; empty: none",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    renders: StringProperty(
        name="Renders", description="Folder for renders of new views; empty: in the project", subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    render_count: IntProperty(
        name="Render Count", description="Number of renders of new views, around the subject", default=8, min=1,
        soft_max=120, options={"SKIP_SAVE"},
    )  # fmt: skip

    holdout: HoldoutProperty()

    def parameters(self, context: Context) -> dict[str, Any]:
        out = absolute(self.out or context.scene.fieldwork.project)
        given = {name: self.path(context, name) for name in ("photos", "labels", "masks", "classes")}
        given["mask_mode"] = mask_mode(self.value(context, "mask_mode"))
        given["keep_backdrop"] = self.value(context, "keep_backdrop")
        if given["photos"] is None and out:
            # A project that was opened knows its photos.
            known = snapshot.source(Path(out))
            given = {name: known.get(name) for name in given}
            given["keep_backdrop"] = bool(given["keep_backdrop"])
        if not given["photos"]:
            raise ValueError(t("Choose a folder of photos, or a video, first."))
        if not out:
            raise ValueError(t("Choose a project folder first."))
        return {
            **given,
            "keep_exposure": self.value(context, "keep_exposure"),
            "out": out,
            "preset": self.value(context, "preset"),
            "time_limit": self.value(context, "time_limit") or None,
            "holdout": hold_out(self, context),
            "set": parse_settings(self.value(context, "settings")),
            "faces": self.value(context, "faces"),
            "texture": self.value(context, "texture"),
            "watertight": self.value(context, "watertight"),
            "close_gaps": self.value(context, "close_gaps"),
            "blend": absolute(self.blend),
            "report": absolute(self.report_file),
            "renders": absolute(self.renders),
            "render_count": self.render_count,
        }

    def after(self) -> Done:
        name = bpy.context.scene.name
        return lambda job: reconstructed(job, name)


def reconstructed(job: Job, scene_name: str) -> None:
    """Bring what was made into the scene, in a window."""
    refresh_scenes(job)
    if job.state != "done" or bpy.app.background or scene_of(job.project, scene_name) is None:
        return
    params = {"project": str(job.project), "run": "main"}
    queue.follow_up(queue.make("package", params, lambda done: import_result(done, "both", scene_name)))


class FIELDWORK_OT_bench(VerbOperator):
    """Reproduce a table of figures on this machine; takes from minutes to hours"""

    bl_idname = "fieldwork.bench"
    bl_label = "Run Benchmark"
    verb = "bench"

    suite: EnumProperty(
        name="Suite",
        description="Which table",
        items=[
            ("speed", "Speed", "Quality after a short and a longer training, frame times"),
            ("figures", "Figures", "Quality on each scene with two seeds"),
            ("ablation", "Ablation", "The parts of the method, one left out at a time"),
            ("robustness", "Robustness", "Noise, missing views, missing and wrong labels"),
            ("evidence", "Evidence", "The published tables beside other methods, by a protocol"),
            ("gpu", "GPU", "What is asked of a graphics card"),
            ("surface", "Surfaces", "Textured meshes of simulated scenes beside their true surfaces"),
            ("labels", "Labels", "Scenes labeled by a few strokes of a simulated annotator"),
            ("measures", "Measures", "How often the true area lies in the interval that is given"),
            ("live", "Live View", "Baked fields: time, size, and what is lost"),
        ],
    )
    out: StringProperty(name="Folder", description="Folder for results and scenes", subtype="DIR_PATH")
    data: StringProperty(name="Data", description="Folder of data sets; empty: only simulated ones", subtype="DIR_PATH")
    scenes: StringProperty(
        name="Scenes", description="Data sets, simulated scenes, or capture projects, separated by commas"
    )
    variants: StringProperty(name="Variants", description="Only these variants of the suite, separated by commas")
    seconds: FloatProperty(name="Time", description="Seconds of training a run; 0: as the suite says", min=0.0)
    steps: IntProperty(name="Steps", description="Steps of training a run; 0: as the suite says", min=0)
    seeds: StringProperty(
        name="Seeds", description="A run for each of these seeds, separated by commas; empty: as the suite says"
    )
    preset: EnumProperty(name="Preset", description="Preset of every run", items=PRESETS, default="standard")
    settings: StringProperty(name="Settings", description="Settings of every run: name=value, separated by spaces")
    keep: BoolProperty(name="Keep", description="Keep the trained fields")
    yardstick: StringProperty(
        name="Yardstick", description="Speed: script of another trainer to run beside ours", subtype="FILE_PATH"
    )
    page: StringProperty(
        name="Page",
        description="Markdown page written anew from the folder “figures” beside it, which gets this table",
        subtype="FILE_PATH",
    )
    tests: StringProperty(name="Tests", description="GPU: JUnit file of the kernels' tests", subtype="FILE_PATH")
    profile: EnumProperty(
        name="Profile",
        description="Evidence: which budget",
        items=[
            ("quick", "Quick", "A quarter of an hour: shows that everything works"),
            ("evening", "Evening", "Five minutes of a processor for each method"),
            ("cpu", "CPU", "A day on a quiet CPU"),
            ("gpu", "Graphics Card", "Hours on a graphics card"),
        ],
    )
    tables: StringProperty(name="Tables", description="Evidence: only these tables, separated by commas; empty: all")
    add_to_page: BoolProperty(
        name="Add to Page", description="Evidence: what stands on the page counts as measured; what it lacks is added"
    )
    lpips: StringProperty(
        name="LPIPS", description="Evidence: torchvision's weights of VGG-16; empty: not measured", subtype="FILE_PATH"
    )

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=380)

    def parameters(self, context: Context) -> dict[str, Any]:
        if not self.out:
            raise ValueError(t("Choose a folder for the results."))
        return {
            "suite": self.suite,
            "scenes": _words(self.scenes),
            "variants": _words(self.variants),
            "seconds": self.seconds or None,
            "steps": self.steps or None,
            "seeds": _words(self.seeds),
            "preset": self.preset,
            "set": parse_settings(self.settings),
            "keep": self.keep,
            "profile": self.profile,
            "tables": _words(self.tables),
            "add_to_page": self.add_to_page,
            **{name: absolute(getattr(self, name)) for name in ("out", "data", "yardstick", "page", "tests", "lpips")},
        }


def _words(text: str) -> list[str] | None:
    return [word.strip() for word in text.split(",") if word.strip()] or None


class FIELDWORK_OT_simulate(VerbOperator):
    """Build a scene and photograph it: a capture to try everything on, with the truth beside it"""

    bl_idname = "fieldwork.simulate"
    bl_label = "Simulate Capture"
    verb = "simulate"

    out: StringProperty(name="Folder", description="New or empty folder for the capture", subtype="DIR_PATH")
    scene: EnumProperty(
        name="Scene",
        description="What is built",
        items=[
            ("museum", "Museum", "Exhibits on plinths, one of them gilded in part"),
            ("facade", "Facade", "A weathered piece of a church front in the open, with its damage as classes"),
            ("fence", "Fence", "Thin things in a garden: a fence of wire, leaves, a sign"),
            ("vase", "Vase", "A vase with its lid and a stone ball on a table: closed bodies"),
        ],
    )
    views: IntProperty(name="Photos", description="Number of photos", default=48, min=4, soft_max=200)
    overviews: IntProperty(
        name="Overviews",
        description="How many of them show the whole from farther away, the last ones",
        min=0,
        soft_max=50,
    )
    size: IntVectorProperty(
        name="Size", description="Width and height of the photos", size=2, default=(480, 320), min=16
    )
    seed: IntProperty(name="Seed", description="Another seed, another scene", min=0)
    samples: IntProperty(name="Samples", description="Cycles samples per pixel", default=4, min=1)

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=380)

    def parameters(self, context: Context) -> dict[str, Any]:
        if not self.out:
            raise ValueError(t("Choose a folder for the capture."))
        return {
            "out": absolute(self.out),
            "scene": self.scene,
            "views": self.views,
            "overviews": self.overviews,
            "size": list(self.size),
            "seed": self.seed,
            "samples": self.samples,
        }


CLASSES = [FIELDWORK_OT_reconstruct, FIELDWORK_OT_simulate, FIELDWORK_OT_bench]
