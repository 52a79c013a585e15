"""A field among Blender's objects: a second scene that renders the field, and nodes that composite both.

A scene has one render engine. The field's scene has the same camera, frames and objects, which hide the field there; its
passes FieldFront and FieldBehind go over and under what this scene renders of the objects. Shadows that the surface of the
capture catches darken both.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..errors import SceneError
from ..text import t
from . import fields, shadows
from .shared_scene import FIELD_SCENE, filter_width, made_for, scene_of, share, share_settings

NODE = "fieldwork_node"  # on nodes that are ours
ENGINE = "FIELDWORK"


def check(scene: bpy.types.Scene) -> None:
    """Raises SceneError: the scene has no camera or no field, or renders fields itself."""
    if scene.render.engine == ENGINE:
        raise SceneError(
            t("This scene renders the field itself. Choose the engine that renders the objects, such as Cycles.")
        )
    if scene.camera is None:
        raise SceneError(t("The scene has no active camera."))
    if not fields.all_parts(scene) and not scene.fieldwork.project:
        raise SceneError(t("The scene has no field: choose a project in the Fieldwork tab, or add a field."))


def set_up(scene: bpy.types.Scene) -> bpy.types.Scene:
    """Make the scene that renders the field, or bring the one that is there up to date, the one that renders shadows where it is
    needed, and the nodes of this one. Raises SceneError as `check`."""
    check(scene)
    caught = shadows.set_up(scene)
    made = scene_of(scene, FIELD_SCENE, t("{} · Field", scene.name))
    share(scene, made)
    made.render.engine = ENGINE
    made.render.filter_size = filter_width(scene)
    made.fieldwork.project, made.fieldwork.run = scene.fieldwork.project, scene.fieldwork.run
    live = made.fieldwork_live
    live.objects_hide = True
    live.source, live.samples = scene.fieldwork_live.source, max(scene.fieldwork_live.samples, 16)
    for layer in made.view_layers:
        layer.update_render_passes()
    scene.render.film_transparent = True
    scene.render.use_compositing = True
    _connect(scene, made, caught)
    return made


def follow(scene: bpy.types.Scene) -> None:
    """Let the scenes made for this one go on with its cameras, frames and size of picture, where these changed since."""
    made, caught = made_for(scene, FIELD_SCENE), made_for(scene, shadows.SHADOW_SCENE)
    for each in (made, caught):
        if each is not None:
            share_settings(scene, each)
    if made is not None and made.render.filter_size != filter_width(scene):
        made.render.filter_size = filter_width(scene)


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


def _connect(scene: bpy.types.Scene, made: bpy.types.Scene, caught: bpy.types.Scene | None) -> None:
    """FieldFront over (objects over FieldBehind), both fields times the pass of the shadows if a scene has caught some, before
    whatever the user makes of the picture; nodes that an earlier call made are made anew."""
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
    behind, front = field.outputs["FieldBehind"], field.outputs["FieldFront"]
    if caught is not None:
        shade = layers
        if caught != scene:
            shade = _new(tree, "CompositorNodeRLayers", "shadows", (-600, -700))
            shade.scene = caught
        # Only darker: where hardly any light falls, the pass says of what little objects add that it is many times as much.
        shade = _mix(tree, "shade", (-400, -600), "DARKEN", shade.outputs[shadows.PASS])
        behind = _mix(tree, "shade behind", (-200, -200), "MULTIPLY", behind, shade)
        front = _mix(tree, "shade front", (-200, -400), "MULTIPLY", front, shade)
    under = _over(tree, "behind", (0, 0), behind, layers.outputs["Image"])
    over = _over(tree, "front", (250, -100), under, front)
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


def _mix(tree: Any, role: str, place: tuple[float, float], blend: str, picture: Any, other: Any = None) -> Any:
    """A node that blends the colours of a picture with another's, or with white, and leaves its opacity; returns its result."""
    if hasattr(bpy.types, "CompositorNodeMixRGB"):
        node = _new(tree, "CompositorNodeMixRGB", role, place)
    else:  # Blender 5 has one for colours of all kinds
        node = _new(tree, "ShaderNodeMix", role, place)
        node.data_type = "RGBA"
    node.blend_type = blend
    amount, first, second = (socket for socket in node.inputs if socket.enabled)
    amount.default_value, second.default_value = 1.0, (1.0, 1.0, 1.0, 1.0)
    tree.links.new(picture, first)
    if other is not None:
        tree.links.new(other, second)
    return next(socket for socket in node.outputs if socket.enabled)
