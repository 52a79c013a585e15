"""The things of a capture in the open scene: their objects, found by what they were made from, and selecting them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import bpy
import numpy as np

from ..roles import ROLE, Owner
from .surface import INSTANCE_ATTRIBUTE, relate
from .visibility import meshes

PREFIX = "instance:"


def objects(owner: Owner) -> dict[int, bpy.types.Object]:
    """The objects of a project's instances by the instances' numbers."""
    return {int(str(item[ROLE])[len(PREFIX) :]): item for item in meshes(owner) if str(item[ROLE]).startswith(PREFIX)}


def describe(owner: Owner, graph: Mapping[str, Any]) -> None:
    """Note relations of a scene graph, and the names of its things, with their objects."""
    names = {thing["id"]: thing["name"] for thing in graph["things"]}
    for item in objects(owner).values():
        relate(item, names, graph["relations"])


def select(owner: Owner, numbers: Iterable[int], extend: bool = False) -> int:
    """Select these instances, alone or beside what is selected: their objects, or their faces where the surface is one object.
    Returns how many were found."""
    wanted, layer = list(numbers), bpy.context.view_layer
    layer.update()  # it does not list what was linked just now
    for item in layer.objects if not extend else ():
        item.select_set(False)
    found, own = 0, objects(owner)
    for number in wanted:
        item = own.get(number)
        if item is not None and item.name in layer.objects:
            item.hide_set(False)
            item.select_set(True)
            layer.objects.active = item
            found += 1
    return found or _select_faces(owner, wanted, extend)


def selected(owner: Owner) -> list[int]:
    """The instances whose objects are selected, the active one first; where the surface is one object, those whose faces are."""
    own, active = objects(owner), bpy.context.view_layer.objects.active
    chosen = [number for number, item in own.items() if item.select_get()]
    if own or active is None or active.type != "MESH" or not owner.owns(active) or not active.select_get():
        return sorted(chosen, key=lambda number: own[number] != active)
    attribute = active.data.attributes.get(INSTANCE_ATTRIBUTE)
    if attribute is None or active.mode != "OBJECT":
        return []
    instance = np.empty(len(active.data.polygons), np.int32)
    attribute.data.foreach_get("value", instance)
    return np.unique(instance[_chosen_faces(active)]).tolist()


def _chosen_faces(item: bpy.types.Object) -> np.ndarray:
    chosen = np.empty(len(item.data.polygons), bool)
    item.data.polygons.foreach_get("select", chosen)
    return chosen


def _select_faces(owner: Owner, numbers: list[int], extend: bool) -> int:
    layer, found = bpy.context.view_layer, 0
    for item in meshes(owner):
        attribute = item.data.attributes.get(INSTANCE_ATTRIBUTE)
        if str(item[ROLE]) != "mesh" or attribute is None or item.mode != "OBJECT" or item.name not in layer.objects:
            continue
        instance = np.empty(len(item.data.polygons), np.int32)
        attribute.data.foreach_get("value", instance)
        wanted = chosen = np.isin(instance, numbers)
        if extend:
            chosen = wanted | _chosen_faces(item)
        edges = np.zeros(len(item.data.edges), bool)
        vertices = np.zeros(len(item.data.vertices), bool)
        corner_edge, corner_vertex = (np.empty(len(item.data.loops), np.int32) for _ in range(2))
        item.data.loops.foreach_get("edge_index", corner_edge)
        item.data.loops.foreach_get("vertex_index", corner_vertex)
        count = np.empty(len(item.data.polygons), np.int32)  # the user may have made quads of the triangles
        item.data.polygons.foreach_get("loop_total", count)
        corners = np.repeat(chosen, count)
        edges[corner_edge[corners]] = True
        vertices[corner_vertex[corners]] = True
        for values, part in ((chosen, item.data.polygons), (edges, item.data.edges), (vertices, item.data.vertices)):
            part.foreach_set("select", values)
        item.data.update()
        item.select_set(True)
        layer.objects.active = item
        found += len(set(instance[wanted].tolist()))
    return found
