"""The child processes of `fieldwork blend` and `fieldwork export --to usd`: a package as a file of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ..errors import SceneError
from ..scene.build import Imported, import_package
from ..scene.materials import COLOR_ATTRIBUTE
from ..scene.package import Package, read_package

PACKED_LIMIT = 256 * 2**20  # bytes of photos above which they stay outside the .blend


def write_blend(request: dict[str, Any], emit: Callable[..., None]) -> dict[str, Any]:
    """Build the package folder `request["package"]` in a new file and save it as `request["out"]`.

    `request["split"]`: one mesh object for each class.
    """
    package, imported = _build(request, emit, "Building the Blender file")
    prepare_scene(bpy.context.scene, len(package.cameras))
    _show_colors(imported)
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


def write_usd(request: dict[str, Any], emit: Callable[..., None]) -> dict[str, Any]:
    """Write the cameras and the mesh of the package as USD, z up, in metres.

    The surface has the baked texture, else the colours of its classes; the photographed colours are its display
    colours, the classes its primvar `class_id`.

    Raises:
        SceneError: this Blender cannot write USD.
    """
    if not bpy.app.build_options.usd:
        raise SceneError(
            f"This Blender {bpy.app.version_string} was built without USD. Set FIELDWORK_BLENDER to another one."
        )
    package, imported = _build(request, emit, "Building the scene")
    for item in (imported.animated, imported.points):
        if item is not None:  # one camera for each photo is enough, and loose points are no surface
            bpy.data.objects.remove(item)
    texture = bpy.data.images.load(str(package.texture), check_existing=True) if package.texture else None
    for item in imported.meshes:
        item.data.color_attributes[COLOR_ATTRIBUTE].name = "displayColor"  # USD's name of it
        if texture is None and not package.classes:
            item.data.materials.clear()  # readers show the display colours where there is no material
        for material in item.data.materials:
            _make_plain(material, texture)
    emit(kind="stage", name="Writing")
    bpy.ops.wm.usd_export(filepath=request["out"], overwrite_textures=True)
    if not Path(request["out"]).stat().st_size:
        raise SceneError(f"Blender could not write {request['out']}.")
    return {"warnings": imported.warnings}


def _make_plain(material: bpy.types.Material, texture: bpy.types.Image | None) -> None:
    """A material that other programs know: the texture, or the colour of the class."""
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    shader, output = tree.nodes.new("ShaderNodeBsdfPrincipled"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs[0], output.inputs[0])
    shader.inputs["Roughness"].default_value = 1.0
    shader.inputs["Base Color"].default_value = material.diffuse_color
    if texture is not None:
        picture = tree.nodes.new("ShaderNodeTexImage")
        picture.image = texture
        tree.links.new(picture.outputs[0], shader.inputs["Base Color"])


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


def _show_colors(imported: Imported) -> None:
    """Let every 3D viewport show the colours of the photos, flat, through the first camera."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.shading.type, space.shading.light, space.shading.color_type = "SOLID", "FLAT", "VERTEX"
                    space.clip_end = 1000.0
                    space.overlay.show_relationship_lines = False  # one from every camera to the parent
                    if imported.cameras:
                        space.region_3d.view_perspective = "CAMERA"
