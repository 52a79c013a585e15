"""Showing and hiding classes of the labelled mesh, by a geometry-nodes modifier that leaves the mesh alone."""

from __future__ import annotations

from collections.abc import Iterable

import bpy

from ..roles import ROLE, Owner
from .surface import CLASS_ATTRIBUTE

NAME = "Fieldwork Classes"


def meshes(owner: Owner, objects: Iterable[bpy.types.Object] | None = None) -> list[bpy.types.Object]:
    """The labelled meshes of a project among objects, of the whole file by default. Those linked from another file are that
    file's to change."""
    objects = bpy.data.objects if objects is None else objects
    return [
        obj for obj in objects if obj.type == "MESH" and is_surface(obj) and owner.owns(obj) and obj.library is None
    ]


def is_surface(obj: bpy.types.Object) -> bool:
    """Whether an object is the labelled mesh of some project, or one class or instance of it."""
    role = str(obj.get(ROLE, ""))
    return role == "mesh" or role.startswith(("class:", "instance:"))


def hide_classes(obj: bpy.types.Object, hidden: list[int]) -> None:
    """Hide the faces of these classes, show all others."""
    modifier = obj.modifiers.get(NAME)
    if not hidden:
        if modifier is not None:
            group = modifier.node_group
            obj.modifiers.remove(modifier)
            if group is not None and group.users == 0:
                bpy.data.node_groups.remove(group)
        return
    if modifier is None:
        modifier = obj.modifiers.new(NAME, "NODES")
    if modifier.node_group is None:
        modifier.node_group = bpy.data.node_groups.new(f"{NAME} · {obj.name}", "GeometryNodeTree")
        for side in ("INPUT", "OUTPUT"):
            modifier.node_group.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    build(modifier.node_group, hidden)


def build(tree: bpy.types.NodeTree, hidden: list[int]) -> None:
    """Nodes that delete the faces whose class is one of `hidden`."""
    tree.nodes.clear()
    nodes, links = tree.nodes, tree.links
    source, target = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    attribute = nodes.new("GeometryNodeInputNamedAttribute")
    attribute.data_type = "INT"
    attribute.inputs["Name"].default_value = CLASS_ATTRIBUTE
    delete = nodes.new("GeometryNodeDeleteGeometry")
    delete.domain = "FACE"
    value = next(socket for socket in attribute.outputs if socket.enabled)
    any_of = None
    for number in hidden:
        equal = nodes.new("FunctionNodeCompare")
        equal.data_type, equal.operation = "INT", "EQUAL"
        a, b = (socket for socket in equal.inputs if socket.enabled and socket.type == "INT")
        links.new(value, a)
        b.default_value = number
        if any_of is None:
            any_of = equal.outputs[0]
        else:
            either = nodes.new("FunctionNodeBooleanMath")
            either.operation = "OR"
            links.new(any_of, either.inputs[0])
            links.new(equal.outputs[0], either.inputs[1])
            any_of = either.outputs[0]
    links.new(source.outputs[0], delete.inputs["Geometry"])
    links.new(any_of, delete.inputs["Selection"])
    links.new(delete.outputs[0], target.inputs[0])
