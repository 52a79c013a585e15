"""A field among Blender's objects: a second scene that renders the field, and nodes that composite both.

A scene has one render engine. The field's scene has the same camera, frames and objects, which hide the field there; its
passes FieldFront and FieldBehind go over and under what this scene renders of the objects.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..errors import SceneError
from ..text import t
from . import fields

FIELD_SCENE = "fieldwork_field_scene"  # on a scene: that of its fields
NODE = "fieldwork_node"  # on nodes that are ours
ENGINE = "FIELDWORK"
SHARED = (
    "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "use_border",
    "border_min_x", "border_max_x", "border_min_y", "border_max_y", "use_crop_to_border", "fps", "fps_base",
    "use_motion_blur", "motion_blur_shutter", "motion_blur_position",
)  # fmt: skip


def set_up(scene: bpy.types.Scene) -> bpy.types.Scene:
    """Make the scene that renders the field, or bring the one that is there up to date, and the nodes of this one.

    Raises SceneError: this scene has no camera or no field, or renders fields itself.
    """
    if scene.render.engine == ENGINE:
        raise SceneError(
            t("This scene renders the field itself. Choose the engine that renders the objects, such as Cycles.")
        )
    if scene.camera is None:
        raise SceneError(t("The scene has no active camera."))
    if not fields.field_objects(scene.objects) and not scene.fieldwork.project:
        raise SceneError(t("The scene has no field: choose a project in the Fieldwork tab, or add a field."))
    made = scene.get(FIELD_SCENE) or bpy.data.scenes.new(t("{} · Field", scene.name))
    scene[FIELD_SCENE] = made
    _share(scene, made)
    scene.render.film_transparent = True
    scene.render.use_compositing = True
    _connect(scene, made)
    return made


def _share(scene: bpy.types.Scene, made: bpy.types.Scene) -> None:
    """Let the field's scene see what this scene sees."""
    made.camera, made.world = scene.camera, scene.world
    made.frame_start, made.frame_end, made.frame_step = scene.frame_start, scene.frame_end, scene.frame_step
    made.unit_settings.scale_length = scene.unit_settings.scale_length
    for name in SHARED:
        setattr(made.render, name, getattr(scene.render, name))
    made.render.engine = ENGINE
    made.render.filter_size = filter_width(scene)
    made.render.film_transparent = True
    made.render.use_compositing = False
    for child in scene.collection.children:
        if child.name not in made.collection.children:
            made.collection.children.link(child)
    for obj in scene.collection.objects:
        if obj.name not in made.collection.objects:
            made.collection.objects.link(obj)
    made.view_layers[0].update()  # the view layer of a new scene has no collections before
    _share_collections(scene.view_layers[0].layer_collection, made.view_layers[0].layer_collection)
    made.fieldwork.project, made.fieldwork.run = scene.fieldwork.project, scene.fieldwork.run
    live = made.fieldwork_live
    live.objects_hide = True
    live.source, live.samples = scene.fieldwork_live.source, max(scene.fieldwork_live.samples, 16)
    for layer in made.view_layers:
        layer.update_render_passes()


def _share_collections(seen: Any, made: Any) -> None:
    """Let the collections of a view layer be excluded, or holdouts, in another one where they are so in the first."""
    for child in seen.children:
        other = made.children.get(child.name)
        if other is not None:
            other.exclude, other.holdout = child.exclude, child.holdout
            _share_collections(child, other)


def filter_width(scene: bpy.types.Scene) -> float:
    """Width in pixels of the filter of the scene's engine: edges are composited well only where both have the same."""
    if scene.render.engine == "CYCLES":
        cycles = scene.cycles
        return 0.0 if cycles.pixel_filter_type == "BOX" else cycles.filter_width
    return scene.render.filter_size


def tree_of(scene: bpy.types.Scene) -> tuple[Any, Any]:
    """The compositor's tree of a scene, and the node into which its result goes; made where there are none."""
    if hasattr(scene, "compositing_node_group"):  # Blender 5
        tree = scene.compositing_node_group
        if tree is None:
            tree = scene.compositing_node_group = bpy.data.node_groups.new(scene.name, "CompositorNodeTree")
        if not any(item.item_type == "SOCKET" and item.in_out == "OUTPUT" for item in tree.interface.items_tree):
            tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        kind, name = "GROUP_OUTPUT", "NodeGroupOutput"
    else:
        scene.use_nodes = True
        tree, kind, name = scene.node_tree, "COMPOSITE", "CompositorNodeComposite"
    out = next((node for node in tree.nodes if node.type == kind), None) or tree.nodes.new(name)
    return tree, out


def _connect(scene: bpy.types.Scene, made: bpy.types.Scene) -> None:
    """FieldFront over (objects over FieldBehind), before whatever the user makes of the picture; nodes that an earlier
    call made are made anew."""
    tree, out = tree_of(scene)
    ours = [node for node in tree.nodes if NODE in node]
    end = next((node for node in ours if node[NODE] == "front"), None)
    plain = next((n for n in tree.nodes if n.type == "R_LAYERS" and n.scene in (None, scene) and NODE not in n), None)
    old = end if end is not None else plain
    # What the picture of the objects goes into now gets the composite instead.
    targets = [link.to_socket for link in old.outputs[0].links if NODE not in link.to_node] if old is not None else []
    for node in ours:
        tree.nodes.remove(node)
    layers = plain if plain is not None else _new(tree, "CompositorNodeRLayers", "objects", (-600, 200))
    layers.scene = scene
    field = _new(tree, "CompositorNodeRLayers", "field", (-600, -300))
    field.scene = made
    field.layer = made.view_layers[0].name
    under = _over(tree, "behind", (-250, 0), field.outputs["FieldBehind"], layers.outputs["Image"])
    over = _over(tree, "front", (0, -100), under, field.outputs["FieldFront"])
    for socket in targets or [out.inputs[0]]:
        tree.links.new(over, socket)


def _new(tree: Any, kind: str, role: str, place: tuple[float, float]) -> Any:
    node = tree.nodes.new(kind)
    node[NODE], node.location = role, place
    return node


def _over(tree: Any, role: str, place: tuple[float, float], background: Any, foreground: Any) -> Any:
    """An Alpha Over node for pictures with associated alpha; returns its result."""
    node = _new(tree, "CompositorNodeAlphaOver", role, place)
    if "Background" in node.inputs:  # Blender 5 calls them by name
        below, above = node.inputs["Background"], node.inputs["Foreground"]
    else:
        below, above = (socket for socket in node.inputs if socket.type == "RGBA")
    tree.links.new(background, below)
    tree.links.new(foreground, above)
    return node.outputs[0]
