"""Export: the capture as a .blend of its own, and in the formats of other programs."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context

from ..addon.jobs.job import Done, Job
from ..addon.project import snapshot
from ..addon.props import StringProperty
from ..addon.text import t
from ..addon.undo import undo_step
from .base import ProjectOperator, absolute, need_poses, need_run, refresh_scenes, scene_of, scene_settings

OF_THE_MESH = {"glb", "obj", "ply", "stl", "usd", "masks"}
OF_THE_CAMERAS = {"transforms", "colmap"}


@scene_settings(run="run", out="export_path", split="export_split")
class FIELDWORK_OT_blend(ProjectOperator):
    """Write a .blend with the cameras, points, mesh and materials of the capture"""

    bl_idname = "fieldwork.blend"
    bl_label = "Write .blend"
    verb = "blend"
    needs = (need_run,)

    renders: StringProperty(
        name="Renders",
        description="Folder of rendered photos to show behind their cameras; empty: those of the panel",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )

    def parameters(self, context: Context) -> dict[str, Any]:
        project, run = self.project_path(context), self.value(context, "run")
        out = self.path(context, "out") or str(Path(project, "exports", run, f"{Path(project).name}.blend"))
        if not out.endswith(".blend"):
            raise ValueError(t("Name a file that ends in .blend."))
        if bpy.data.filepath and Path(out).resolve() == Path(bpy.data.filepath).resolve():
            raise ValueError(t("{} is open here: choose another file in the Export panel.", Path(out).name))
        split, renders = self.value(context, "split"), absolute(self.renders)
        return {"project": project, "run": run, "out": out, "split": split, "renders": renders}


@scene_settings(run="run", to="export_to", out="export_path", split="export_split", resolution="voxels")
class FIELDWORK_OT_export(ProjectOperator):
    """Write the mesh or the field in a format that other programs read"""

    bl_idname = "fieldwork.export"
    bl_label = "Export"
    verb = "export"
    needs = (need_poses,)

    @classmethod
    def reason(cls, context: Context) -> str | None:
        return super().reason(context) or cls.need_format(context)

    @staticmethod
    def need_format(context: Context) -> str | None:
        settings = context.scene.fieldwork
        if settings.export_to == "blend":
            return t("Choose a format for other programs in the Export panel")
        if settings.export_to in OF_THE_CAMERAS:
            return None
        folder = snapshot.folder_of(settings)
        mesh = folder is not None and (folder / "exports" / settings.run / "mesh.npz").is_file()
        if settings.export_to in OF_THE_MESH and not mesh:
            return t("Extract the mesh first")
        return need_run(context)

    def parameters(self, context: Context) -> dict[str, Any]:
        to = self.value(context, "to")
        if to == "blend":
            raise ValueError(t("Choose a format, or use Write .blend."))
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "to": to,
            "out": self.path(context, "out"),
            "split": self.value(context, "split"),
            "resolution": self.value(context, "resolution"),
        }

    def after(self) -> Done:
        name = bpy.context.scene.name
        return lambda job: show_volume(job, name)


def show_volume(job: Job, scene_name: str) -> None:
    """Bring a volume that was written into the scene."""
    refresh_scenes(job)
    if job.state != "done" or not job.result or job.result.get("to") != "vdb" or job.project is None:
        return
    scene = scene_of(job.project, scene_name)
    if scene is None:
        return
    from ..addon.scene import volume  # not at the top: enabling the extension must be quick

    volume.show(scene, snapshot.owner(job.project), Path(job.result["files"][0]))
    undo_step("Add Volume")


CLASSES = [FIELDWORK_OT_blend, FIELDWORK_OT_export]
