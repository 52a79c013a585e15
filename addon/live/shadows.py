"""Shadows of a scene's objects on a field: the surface of the capture catches them.

Only Cycles has shadow catchers, which also hide what is behind them. Where another engine renders the objects, the surface is
a holdout there, and a scene of its own lets Cycles make the pass of the shadows.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..errors import SceneError
from ..roles import ROLE
from ..scene.visibility import is_surface
from ..text import t
from .objects import SOLID, with_instances
from .shared_scene import filter_width, scene_of, share

PASS = "Shadow Catcher"
SHADOW_SCENE = "fieldwork_shadow_scene"  # on a scene: that of its shadows
SAMPLES = 64


def surfaces(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The surfaces of captures in a scene, whole or by class or instance, also those in instances of collections."""
    return [obj for obj in with_instances(scene.objects) if obj.type == "MESH" and is_surface(obj)]


def catch(scene: bpy.types.Scene) -> None:
    """Let the surfaces of a scene catch shadows. Raises SceneError: one is another file's, which says that it catches none."""
    for obj in surfaces(scene):
        if obj.library is not None:
            if not obj.is_shadow_catcher:
                raise SceneError(
                    t("The surface “{}” is linked: press Catch Shadows in {}.", obj.name, obj.library.filepath)
                )
            continue
        obj.is_shadow_catcher, obj.is_holdout, obj.hide_render = True, False, False
        for slot in obj.material_slots:
            if slot.material is not None and slot.material.use_nodes:
                _receive_light(slot.material.node_tree)


def _receive_light(tree: bpy.types.NodeTree) -> None:
    """Let Cycles see an unlit material as grey and matt on objects that catch shadows: light of its own has none. Other engines
    and the viewport's preview show it as it is."""
    output = tree.get_output_node("CYCLES")
    links = output.inputs["Surface"].links if output is not None else ()
    if not links or links[0].from_node.type != "EMISSION":
        return
    kinds = ("ShaderNodeAttribute", "ShaderNodeBsdfDiffuse", "ShaderNodeMixShader", "ShaderNodeOutputMaterial")
    catches, matt, mix, seen = nodes = [tree.nodes.new(kind) for kind in kinds]
    catches.attribute_type, catches.attribute_name = "OBJECT", "is_shadow_catcher"
    matt.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
    seen.target = "CYCLES"
    tree.links.new(catches.outputs["Fac"], mix.inputs[0])
    tree.links.new(links[0].from_socket, mix.inputs[1])
    tree.links.new(matt.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], seen.inputs["Surface"])
    for column, node in enumerate(nodes):
        node.location = output.location.x + 220 * (column - 1), output.location.y - 250


def set_up(scene: bpy.types.Scene) -> bpy.types.Scene | None:
    """The scene whose first view layer has the pass of the shadows, which is made where it is not there; None: nothing catches
    any. Raises SceneError: there is no Cycles."""
    own = scene.render.engine == "CYCLES"
    if not any(_catches(obj) for obj in (with_instances(scene.objects) if own else surfaces(scene))):
        return None
    if not hasattr(scene, "cycles"):
        raise SceneError(t("Only Cycles makes shadows on the field: enable the add-on Cycles Render Engine."))
    _hold_out(scene.view_layers[0].layer_collection, not own)
    made = scene
    if not own:
        made = scene_of(scene, SHADOW_SCENE, t("{} · Shadows", scene.name))
        if made.render.engine != "CYCLES":  # a new one
            made.render.engine = "CYCLES"
            made.cycles.samples, made.cycles.use_denoising = SAMPLES, False
        share(scene, made)
        _hold_out(made.view_layers[0].layer_collection, False)
        made.cycles.pixel_filter_type, made.cycles.filter_width = "BLACKMAN_HARRIS", max(filter_width(scene), 0.01)
    made.view_layers[0].cycles.use_pass_shadow_catcher = True
    made.view_layers[0].update_render_passes()
    return made


def _catches(obj: bpy.types.Object) -> bool:
    return obj.is_shadow_catcher and not obj.hide_render


def _hold_out(layer: Any, held: bool) -> None:
    """Make the collections of a view layer that hold catching surfaces, and else nothing but what belongs to captures,
    holdouts, or no holdouts any more."""
    for child in layer.children:
        solid = [obj for obj in with_instances(child.collection.all_objects) if obj.type in SOLID]
        if any(is_surface(obj) and _catches(obj) for obj in solid) and all(ROLE in obj for obj in solid):
            child.holdout = held
        else:
            _hold_out(child, held)
