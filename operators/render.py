"""Render: images of the field from the scene's camera, its animation, or the photo cameras."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context

from ..addon import paths
from ..addon.choices import PASSES
from ..addon.errors import SceneError
from ..addon.jobs.job import Done, Job, Steps
from ..addon.jobs.queue import queue
from ..addon.project import snapshot
from ..addon.props import BoolProperty, IntVectorProperty, StringProperty
from ..addon.roles import Owner
from ..addon.scene.frame import scene_from_capture
from ..addon.scene.slices import Held
from ..addon.text import t
from ..addon.undo import undo_step
from .base import ProjectOperator, absolute, need_held_out, need_run, refresh_scenes, scene_of, scene_settings
from .scene import show_image


def camera_fault(scene: bpy.types.Scene) -> str | None:
    """Why the scene cannot be rendered from its camera, as a sentence; None when it can."""
    camera = scene.camera
    if camera is None:
        return t("The scene has no active camera.")
    if camera.type != "CAMERA":
        return t("“{}” is the active camera, but no camera.", camera.name)
    if camera.data.type != "PERSP":
        return t("“{}” is not a perspective camera.", camera.name)
    return None


def write_cameras(
    path: Path, scene: bpy.types.Scene, animated: bool, size: tuple[int, int], owner: Owner | None = None
) -> Steps:
    """Write the scene's camera as transforms.json, a frame in each step: intrinsics in pixels, camera-to-capture with
    Blender's axes.

    Where the capture of a project was moved in the scene, the camera is taken as it stands to the capture.
    """
    # Not at the top: enabling the extension must be quick.
    from ..addon.scene.lens import picture_size
    from ..nerfcore.files import write_json

    place, render = Held(bpy.data.scenes, scene), scene.render
    width, height = (own or seen for own, seen in zip(size, picture_size(render)))
    numbers = [scene.frame_current]
    if animated:
        numbers = list(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    frames = []
    for number in numbers:
        frames.append({"file_path": f"frame_{number:04}", **camera_at(place(), number, width, height, owner)})
        yield len(frames) / len(numbers), t("frame {}", number)
    write_json(path, {"frames": frames})


def camera_at(scene: bpy.types.Scene, number: int, width: int, height: int, owner: Owner | None) -> dict[str, Any]:
    """Pose and intrinsics of the scene's camera in a frame, as transforms.json has them; the scene stays in its frame.

    Raises SceneError: the scene has no camera any more, or in this frame not a perspective one.
    """
    current = scene.frame_current
    if number != current:
        scene.frame_set(number)  # markers may change the camera
    try:
        if fault := camera_fault(scene):
            raise SceneError(t("Frame {}: {}", number, fault))
        layer = scene.view_layers[0]
        layer.update()  # a layer that no window shows is behind, or has not been evaluated at all
        evaluated = scene.camera.evaluated_get(layer.depsgraph)
        # A scaled parent must not scale the camera's axes; what is mirrored stays so.
        capture_from_scene = scene_from_capture(scene, owner).inverted_safe()
        matrix = (capture_from_scene @ evaluated.matrix_world).normalized()
        aspect = scene.render.pixel_aspect_x, scene.render.pixel_aspect_y
        lens = intrinsics(evaluated.data, width, height, aspect)
    finally:
        if number != current:
            scene.frame_set(current)  # the window may be drawn between two steps
    return {"transform_matrix": [list(row) for row in matrix], **lens}


def intrinsics(camera: bpy.types.Camera, width: int, height: int, aspect: Sequence[float]) -> dict[str, float]:
    """Pinhole intrinsics of a Blender camera as transforms.json has them; `aspect`: width and height of a pixel."""
    from ..addon.scene.lens import pinhole  # not at the top: enabling the extension must be quick

    fx, fy, cx, cy = pinhole(camera, width, height, aspect)
    angle = 2 * math.atan(width / 2 / fx)
    return {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "camera_angle_x": angle}


CAMERAS = "cameras.json"  # beside the images


@scene_settings(run="run", source="render_from", orbit="orbit", size="size", passes="passes")
class FIELDWORK_OT_render(ProjectOperator):
    """Render images of the trained field"""

    bl_idname = "fieldwork.render"
    bl_label = "Render Field"
    verb = "render"
    needs = (need_run,)

    out: StringProperty(
        name="Output", description="Folder for the images; empty: renders of the run, in exports of the project", subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    camera: StringProperty(
        name="Camera File", description="transforms.json with the cameras; empty: as chosen under From",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip

    baked: BoolProperty(
        name="Baked", description="Render the baked field: faster, but not quite the same", default=False,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    edits: StringProperty(
        name="Edits", description="File of classes and things that are edited, with Baked; empty: none",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    frame_range: IntVectorProperty(
        name="Frames", description="First and last frame of a part, counted from 0; -1: all", size=2, default=(-1, -1),
        min=-1, options={"SKIP_SAVE"},
    )  # fmt: skip

    @classmethod
    def reason(cls, context: Context) -> str | None:
        settings = context.scene.fieldwork
        if settings.render_from in ("camera", "animation") and context.scene.camera is None:
            return t("The scene has no active camera")
        if settings.render_from == "photos" and (reason := need_held_out(context)):
            return reason
        return super().reason(context)

    def parameters(self, context: Context) -> dict[str, Any]:
        project, run = self.project_path(context), self.value(context, "run")
        source, size = self.value(context, "source"), tuple(self.value(context, "size"))
        folder = paths.absolute(self.out) if self.out else Path(project) / "exports" / run / "renders" / source
        passes = self.value(context, "passes")
        if not passes:
            raise ValueError(t("Choose at least one pass."))
        params: dict[str, Any] = {
            "project": project,
            "run": run,
            "out": str(folder),
            "passes": [name for name, *_ in PASSES if name in passes],
            "size": list(size) if all(size) else None,
            "baked": self.baked,
            "edits": absolute(self.edits) if self.edits else None,
            "frame_range": list(self.frame_range) if min(self.frame_range) >= 0 else None,
        }
        if any(size) and not all(size) and (self.camera or source not in ("camera", "animation")):
            raise ValueError(t("Give both width and height under Size, or 0 for both."))
        if self.camera:
            return {**params, "camera": absolute(self.camera)}
        if source in ("photos", "all"):
            return {**params, "test" if source == "photos" else "all": True}
        if source == "orbit":
            return {**params, "orbit": self.value(context, "orbit")}
        if fault := camera_fault(context.scene):
            raise ValueError(fault)
        if context.scene.render.use_border:
            self.report({"INFO"}, t("The whole picture is rendered: Render Region is for F12"))
        return {**params, "camera": str(folder / CAMERAS), "size": None}

    def before(self, context: Context, params: dict[str, Any]) -> Steps | None:
        if self.camera or "camera" not in params:
            return None
        animated, size = self.value(context, "source") == "animation", tuple(self.value(context, "size"))
        return write_cameras(
            Path(params["camera"]), context.scene, animated, size, snapshot.owner(Path(params["project"]))
        )

    def after(self) -> Done:
        return show_result


def show_result(job: Job) -> Steps | None:
    """Bring the rendered images into Blender as image datablocks, and into the scene as its settings say."""
    refresh_scenes(job)
    if job.state != "done" or job.result is None or job.project is None:
        return None
    # Not at the top: enabling the extension must be quick.
    from ..addon.render.result import show_steps

    scene, files = scene_of(job.project), [Path(path) for path in job.result["frames"]]
    # An orbit has no camera in the scene.
    show_as = scene.fieldwork.show_as if scene is not None and "orbit" not in job.params else "none"
    photos = "test" in job.params or "all" in job.params
    if photos and show_as != "none":
        _show_straightened(job, show_as)
        show_as = "none"
    return then_shown(show_steps(scene, files, show_as, photos, snapshot.owner(job.project)), files)


def then_shown(steps: Steps, files: list[Path]) -> Steps:
    """Steps after which the first picture is shown in an image editor; a step of undo."""
    yield from steps
    undo_step("Show Renders from Fieldwork")
    first = next((path for path in files if path.suffix == ".png"), None)
    if first is not None and not bpy.app.background:
        show_image(first)


def _show_straightened(job: Job, show_as: str) -> None:
    """Blender's cameras know no lens distortion: the engine takes it out of the renders before they are shown."""

    def show(done: Job) -> Steps | None:
        scene = scene_of(done.project) if done.project else None
        if done.state != "done" or not done.result or scene is None:
            return None
        from ..addon.render.result import show_steps

        files = sorted(Path(done.result["folder"], "renders").glob("*.png"))
        return then_shown(show_steps(scene, files, show_as, True, snapshot.owner(done.project)), [])

    params = {name: job.params[name] for name in ("project", "run")} | {"renders": job.params["out"]}
    queue.follow_up(queue.make("package", params, show))


CLASSES = [FIELDWORK_OT_render]
