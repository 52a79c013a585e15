"""What an earlier import made for a project in a scene, found by its role, and what is missing, made."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy

from ..roles import ROLE, UUID, Owner

Steps = Generator[tuple[float, str], None, Any]  # yields the share that is done and what is next


class Owned:
    """The collections and objects of one project in one scene."""

    def __init__(self, scene: bpy.types.Scene, owner: Owner) -> None:
        self.owner = owner
        self.collection = self._collection(scene.collection, f"Fieldwork · {owner.name}", "all")
        self.camera_collection = self._collection(self.collection, f"Cameras · {owner.name}", "cameras")
        self.known = {item[ROLE]: item for item in self.collection.all_objects if ROLE in item and owner.owns(item)}
        self.used: set[str] = set()

    def _collection(self, parent: bpy.types.Collection, name: str, role: str) -> bpy.types.Collection:
        for child in parent.children:
            if child.get(ROLE) == role and self.owner.owns(child):
                self.owner.mark(child, role)  # one of before the project had a UUID
                return child
        made = bpy.data.collections.new(name)
        self.owner.mark(made, role)
        parent.children.link(made)
        return made

    def object(
        self, role: str, name: str, data: Any, parent: bpy.types.Object | None = None, group: str = ""
    ) -> bpy.types.Object:
        """The object of a role, with `data` if it is new; `group`: the collection it stands in then, of this name."""
        self.used.add(role)
        item = self.known.get(role)
        if item is None:
            item = bpy.data.objects.new(name, data)
            self._place(role, group).objects.link(item)
            item.parent = parent
        self.owner.mark(item, role)
        return item

    def _place(self, role: str, group: str) -> bpy.types.Collection:
        if role.startswith("camera"):
            return self.camera_collection
        return self._collection(self.collection, group, f"group:{group}") if group else self.collection

    def existing(self, role: str) -> bpy.types.Object | None:
        return self.known.get(role)

    def with_mesh(
        self, role: str, name: str, mesh: bpy.types.Mesh, parent: bpy.types.Object | None, group: str = ""
    ) -> bpy.types.Object:
        """The object of a role with this mesh, in place of the one an earlier import made, wherever that is used."""
        item = self.existing(role)
        if item is None:
            return self.object(role, name, mesh, parent, group)
        self.object(role, name, mesh)
        before, kept = item.data, item.data.name
        before.user_remap(mesh)
        bpy.data.meshes.remove(before)
        mesh.name = kept
        return item

    def remove_unused(self) -> None:
        """Take away what the package no longer has."""
        for role, item in self.known.items():
            if role not in self.used:
                bpy.data.objects.remove(item)
        for child in list(self.collection.children):
            if str(child.get(ROLE, "")).startswith("group:") and not child.all_objects and not child.children:
                bpy.data.collections.remove(child)


def find(items: Any, owner: Owner, role: str, name: str) -> Any:
    """The material or node group of a role among those of the file; None when there is none.

    `name`: what it is called in scenes of Fieldwork 0.1, which know materials and groups by nothing else.
    """
    found = next((item for item in items if item.get(ROLE) == role and owner.owns(item)), None)
    if found is None:
        old = items.get(name)
        found = old if old is not None and ROLE not in old and UUID not in old else None
    if found is not None:
        owner.mark(found, role)
    return found


def hand_over(old: Owner, new: Owner) -> None:
    """Let what was made for one project belong to another: the same one under another name or in another place."""
    for items in (bpy.data.objects, bpy.data.collections, bpy.data.materials, bpy.data.node_groups):
        for item in items:
            if ROLE in item and old.owns(item):
                new.mark(item, item[ROLE])
