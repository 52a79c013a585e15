"""The child process of `fieldwork blend`: a package as a file of its own."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ..roles import FOLDER
from ..scene.build import Imported, import_package
from ..scene.cameras import clip_range
from ..scene.package import Package, read_package

PACKED_LIMIT = 256 * 2**20  # bytes of photos above which they stay outside the .blend


def write_blend(request: dict[str, Any], emit: Callable[..., None]) -> dict[str, Any]:
    """Build the package folder `request["package"]` in a new file and save it as `request["out"]`.

    `request["split"]`: "none", "classes" or "instances", one mesh object for each of them. `request["project"]`: the
    project's folder, which the file remembers.
    """
    package, imported = _build(request, emit, "Building the Blender file")
    imported.root[FOLDER] = _seen_from(Path(request["project"]).absolute(), Path(request["out"]).absolute().parent)
    prepare_scene(bpy.context.scene, len(package.cameras))
    _show_colors(imported, clip_range(package))
    warnings = imported.warnings
    size = sum((package.folder / camera["image"]).stat().st_size for camera in package.cameras)
    if size <= PACKED_LIMIT:
        for image in bpy.data.images:
            if image.source == "FILE":
                image.pack()
    else:
        warnings = [*warnings, f"The photos ({size >> 20} MiB) are not packed: the .blend reads {package.folder}."]
    bpy.data.orphans_purge(do_recursive=True)
    bpy.ops.wm.save_as_mainfile(filepath=request["out"], compress=True, relative_remap=True, copy=True)
    return {
        "objects": [item.name for item in imported.objects()],
        "cameras": len(imported.cameras),
        "points": len(package.xyz),
        "mesh": len(package.mesh["faces"]) if package.mesh is not None else None,
        "warnings": warnings,
    }


def _seen_from(folder: Path, start: Path) -> str:
    """A folder as Blender writes paths: beside the file's own, or absolute on another disk."""
    try:
        return "//" + Path(os.path.relpath(folder, start)).as_posix()
    except ValueError:
        return str(folder)


def _build(request: dict[str, Any], emit: Callable[..., None], stage: str) -> tuple[Package, Imported]:
    """The package of a request in an empty scene."""
    emit(kind="stage", name=stage)
    bpy.ops.wm.read_factory_settings()
    bpy.context.preferences.filepaths.save_version = 0
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    for collection in list(bpy.data.collections):
        bpy.data.collections.remove(collection)
    scene = bpy.context.scene
    scene.name = "Fieldwork"
    package = read_package(request["package"])
    imported = import_package(
        scene,
        package,
        split=request["split"],
        progress=lambda fraction, message: emit(kind="progress", fraction=fraction, message=message),
    )
    return package, imported


def prepare_scene(scene: bpy.types.Scene, frames: int) -> None:
    """Settings under which a render has the colours of the photos."""
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.frame_start, scene.frame_end = 1, max(frames, 1)
    scene.unit_settings.system = "METRIC"


def _show_colors(imported: Imported, clip: tuple[float, float]) -> None:
    """Let every 3D viewport show the colours of the photos, flat, through the first camera, and all that is in a range."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.shading.type, space.shading.light, space.shading.color_type = "SOLID", "FLAT", "VERTEX"
                    space.clip_start, space.clip_end = clip
                    space.overlay.show_relationship_lines = False  # one from every camera to the parent
                    if imported.cameras:
                        space.region_3d.view_perspective = "CAMERA"
