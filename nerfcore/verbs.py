"""The verbs: what Fieldwork can do. The command line, the engine and the panels all go through `run_verb`."""

from __future__ import annotations

import gc
import importlib
from types import ModuleType
from typing import Any, NamedTuple

from . import params as p
from .progress import Reporter


class Verb(NamedTuple):
    """`function` is "module:name" below this package, called as function(params, report) → JSON-ready dict.

    `immediate`: an edit of project.json that takes no time; it runs beside a job of the same project.
    """

    params: type[p.Params]
    function: str
    summary: str
    immediate: bool = False


VERBS = {
    "doctor": Verb(p.DoctorParams, "engine.doctor:doctor", "Check the engine, the device and the disk."),
    "simulate": Verb(p.SimulateParams, "blender.simulate:simulate", "Build a scene and photograph it with Cycles."),
    "dataset": Verb(p.DatasetParams, "blender.dataset:dataset", "Photograph any .blend as a posed, labelled data set."),
    "new": Verb(p.NewParams, "capture.ingest:new", "Make a project from photos or a video."),
    "import": Verb(p.ImportParams, "data.importer:import_dataset", "Make a project from a posed data set."),
    "poses": Verb(p.PosesParams, "poses.estimate:estimate_poses", "Estimate the camera poses."),
    "align": Verb(p.AlignParams, "poses.align:align", "Set the up direction and the metric scale."),
    "classes": Verb(p.ClassesParams, "project.edit:classes", "List or change the classes.", immediate=True),
    "region": Verb(p.RegionParams, "project.edit:region", "Show, set or clear the region of interest.", immediate=True),
    "train": Verb(p.TrainParams, "train.verb:train", "Train the field."),
    "evaluate": Verb(p.EvaluateParams, "evaluate.verb:evaluate", "Measure the held-out images."),
    "bake": Verb(p.BakeParams, "bake.verb:bake", "Bake the field into voxels that render fast."),
    "render": Verb(p.RenderParams, "film.edits:render", "Render images from the field."),
    "mesh": Verb(p.MeshParams, "mesh.verb:mesh", "Extract the labelled surface."),
    "turntable": Verb(p.TurntableParams, "mesh.turntable:turntable", "Picture the mesh from all around."),
    "measure": Verb(p.MeasureParams, "measure.verb:measure", "Measure areas, volumes and distances on the mesh."),
    "instances": Verb(
        p.InstancesParams, "things.edit:instances", "List, rename, join or split the things of the mesh."
    ),
    "relations": Verb(p.RelationsParams, "things.graph:relate", "Tell how the things of the mesh stand to each other."),
    "plan": Verb(p.PlanParams, "measure.drawings:plan", "Draw plans and elevations to scale."),
    "section": Verb(p.SectionParams, "measure.drawings:section", "Draw a section of the mesh to scale."),
    "compare": Verb(p.CompareParams, "measure.epochs:compare", "Compare the meshes of two epochs of one object."),
    "report": Verb(p.ReportParams, "evaluate.report:report", "Write a report by which others can check and repeat it."),
    "label prepare": Verb(p.LabelPrepareParams, "labels.preparation:prepare", "Prepare a run for labelling by marks."),
    "label stroke": Verb(p.LabelStrokeParams, "labels.stroke:stroke", "Mark a place on a photo.", immediate=True),
    "label propagate": Verb(
        p.LabelPropagateParams, "labels.propagate:propagate", "Carry the marks over the whole surface."
    ),
    "label checkout": Verb(
        p.LabelCheckoutParams, "labels.stroke:checkout", "Show another revision of the marks.", immediate=True
    ),
    "label overlay": Verb(p.LabelOverlayParams, "labels.overlay:overlay", "Draw the labels of a photo."),
    "label parts": Verb(p.LabelPartsParams, "labels.part_picture:parts", "Tell the parts of the surface in a photo."),
    "label next": Verb(p.LabelNextParams, "labels.next_photo:next_photo", "Find the photo to mark next."),
    "label import": Verb(
        p.LabelImportParams, "labels.exchange:import_labels", "Read labels of another labelling tool."
    ),
    "label export": Verb(
        p.LabelExportParams, "labels.exchange:export_labels", "Write labels for another labelling tool."
    ),
    "label carry": Verb(p.LabelCarryParams, "labels.carry:carry", "Take over the labels of an earlier epoch."),
    "label accept": Verb(p.LabelAcceptParams, "labels.accept:accept", "Give the run the classes of the marks."),
    "assist embed": Verb(
        p.AssistEmbedParams, "labels.assist.verbs:embed", "Encode photos ahead for clicks, with a model you bring."
    ),
    "assist segment": Verb(
        p.AssistSegmentParams,
        "labels.assist.verbs:segment",
        "Cut out a thing by clicks or a box, with a model you bring.",
    ),
    "assist suggest": Verb(
        p.AssistSuggestParams, "labels.assist.verbs:suggest", "Guess the classes of photos, with a model you bring."
    ),
    "blend": Verb(p.BlendParams, "blender.blend:blend", "Write a .blend with cameras, points, mesh and materials."),
    "package": Verb(p.PackageParams, "blender.package:package", "Prepare cameras, points and mesh for Blender."),
    "export": Verb(p.ExportParams, "export.verb:export", "Write what other programs read."),
    "bench": Verb(p.BenchParams, "bench.verb:bench", "Reproduce a table of figures on this machine."),
    "reconstruct": Verb(p.ReconstructParams, "workflows.reconstruct:reconstruct", "Photos in, a labelled .blend out."),
    "blocks": Verb(
        p.BlocksParams, "workflows.blocks:blocks", "Train and mesh a large capture in parts that meet without a seam."
    ),
    "batch": Verb(
        p.BatchParams, "workflows.batch:batch", "Reconstruct many captures, one after the other or on a cluster."
    ),
}


def run_verb(name: str, params: p.Params, report: Reporter) -> dict[str, Any]:
    """Run one verb in this process and return its JSON-ready result (keys as documented in docs/cli.md).

    Raises:
        FieldworkError: a failure the user can act on.
        Cancelled: the reporter was asked to stop; the project is left resumable.
    """
    _, function = VERBS[name].function.split(":")
    return getattr(load_verb(name), function)(params, report)


def load_verb(name: str) -> ModuleType:
    """The module of a verb. The first time its libraries load, which takes seconds: a quarter less without looking for
    garbage meanwhile, of which libraries that load make little."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        return importlib.import_module(f".{VERBS[name].function.split(':')[0]}", __package__)
    finally:
        if collecting:
            gc.enable()
