"""What an earlier import made for a project in a scene, found by its role, and what is missing, made.

What the user changed since is left to him (edited.py), and what is new comes beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from ..errors import SceneChanged
from ..roles import ROLE, UUID, Owner, by_role, is_local
from . import slices
from .edited import Steps, object_changed, release, surface_edited
from .own_look import give_own_look
from .slices import Held

VOLUME = "volume"  # role of what volume.py shows
# Custom properties of objects: what they were called, and the group they were put in, which follow new names of classes.
NAME, GROUP = "fieldwork_name", "fieldwork_group"


class Owned:
    """The collections and objects of one project in one scene, looked up again in every slice."""

    def __init__(self, scene: bpy.types.Scene, owner: Owner) -> None:
        self.owner = owner
        self.used: set[str] = set()
        self.classes: set[str] = set()  # names of the classes that there are
        self.kept: list[str] = []  # names of what the user had changed and has now for himself
        self._scene = Held(bpy.data.scenes, scene)
        self._slice = -1
        self._known: dict[str, bpy.types.Object] = {}

    @property
    def scene(self) -> bpy.types.Scene:
        return self._scene()

    @property
    def collection(self) -> bpy.types.Collection:
        return self._collection(self.scene.collection, f"Fieldwork · {self.owner.name}", "all")

    @property
    def known(self) -> dict[str, bpy.types.Object]:
        """The objects of the capture that are there by their roles; volumes are shown and taken away by themselves."""
        if self._slice != slices.number():
            self._slice = slices.number()
            # Wherever the user has put them; of copies those in the capture's own collection are the originals.
            self._known = by_role([*self.collection.all_objects, *self.scene.objects], self.owner)
            self._known.pop(VOLUME, None)
        return self._known

    def release_copies(self) -> None:
        """Let the user have what he made as copies of the objects."""
        for item in self.scene.objects:
            if ROLE not in item or not self.owner.owns(item) or not is_local(item):
                continue
            first = self.known.get(item[ROLE], item)
            if first != item:
                release(item)
                if item.type == "MESH" and item.data != first.data:
                    give_own_look(item.data, self.owner)

    def _collection(self, parent: bpy.types.Collection, name: str, role: str) -> bpy.types.Collection:
        for child in parent.children_recursive:
            if child.get(ROLE) == role and self.owner.owns(child) and is_local(child):
                self.owner.mark(child, role)  # one of before the project had a UUID
                return child
        made = bpy.data.collections.new(name)
        self.owner.mark(made, role)
        parent.children.link(made)
        return made

    def object(self, role: str, name: str, data: Any, group: str = "") -> bpy.types.Object:
        """The object of a role, with `data` if it is new; `group`: the collection it stands in then, of this name. One that the
        user has not renamed is called by this name."""
        self.used.add(role)
        item = self.known.get(role)
        if item is not None and item.get(NAME) == item.name:
            call(item, name)
        if item is not None and item.get(GROUP, group) != group and item[GROUP] not in self.classes:
            self._rename_group(item[GROUP], group)
        if item is None:
            item = bpy.data.objects.new(name, data)
            call(item, name)
            self._place(role, group).objects.link(item)
            self.known[role] = item
            if role == "root":  # also of what is left from one that was deleted
                for other in self.known.values():
                    if other != item and other.parent is None:
                        other.parent = item
            else:
                item.parent = self.existing("root")
        self.owner.mark(item, role)
        if group:
            item[GROUP] = group
        return item

    def _rename_group(self, old: str, new: str) -> None:
        """Let the collection of a class have its new name, unless there is one of this name."""
        groups = {child.get(ROLE): child for child in self.collection.children if self.owner.owns(child)}
        found = groups.get(f"group:{old}")
        if found is not None and f"group:{new}" not in groups:
            found.name = new if found.name == old else found.name
            self.owner.mark(found, f"group:{new}")

    def _place(self, role: str, group: str) -> bpy.types.Collection:
        if role.startswith("camera"):
            return self._collection(self.collection, f"Cameras · {self.owner.name}", "cameras")
        return self._collection(self.collection, group, f"group:{group}") if group else self.collection

    def existing(self, role: str) -> bpy.types.Object | None:
        return self.known.get(role)

    @property
    def root(self) -> bpy.types.Object:
        """The parent of everything. Raises SceneChanged: it is gone."""
        root = self.existing("root")
        if root is None:
            raise SceneChanged("The parent of the capture was deleted meanwhile.")
        return root

    def leave(self, role: str) -> None:
        """Let the user have the object of a role as it is; the next `object` is a new one."""
        item = self.known.pop(role, None)
        if item is None:
            return
        release(item)
        if item.type == "MESH":
            give_own_look(item.data, self.owner)
        self.kept.append(item.name)

    def leave_edited(self, roles: set[str]) -> Steps:
        """Let the user have what he made of the surface, whose objects will have these roles, before the materials and
        node groups it looks by are made anew."""
        for role in [role for role in self.known if role not in self.used]:
            item = self.existing(role)
            if item is not None and item.type == "MESH" and (yield from self._changed(role, role in roles)):
                self.leave(role)

    def _changed(self, role: str, replaced: bool) -> Steps:
        """Whether the user made something of an object that would go with it; `replaced`: with its mesh alone."""
        item = self.existing(role)
        if item is None or (not replaced and object_changed(item)):
            return item is not None
        return item.type == "MESH" and (yield from surface_edited(item, self.owner))

    def with_mesh(self, role: str, name: str, held: Held, group: str = "") -> Steps:
        """The object of a role with this mesh, in place of the one an earlier import made, wherever that is used; beside
        one that the user edited. Returns it."""
        if (yield from self._changed(role, replaced=True)):
            self.leave(role)
        before = self.existing(role)
        called = before.name if before is not None else ""
        item = self.object(role, name, held(), group)
        if before is not None:
            old, kept = before.data, before.data.name
            old.user_remap(held())
            bpy.data.meshes.remove(old)
            held().name = item.name if kept == called else kept
        return item

    def remove_unused(self) -> Steps:
        """Take away what the package no longer has; what the user changed stays, as his own."""
        for role in [role for role in self.known if role not in self.used]:
            changed = yield from self._changed(role, replaced=False)
            item = self.existing(role)
            if item is not None and changed:
                self.leave(role)
            elif item is not None:
                del self.known[role]
                bpy.data.objects.remove(item)
        for child in list(self.collection.children):
            if str(child.get(ROLE, "")).startswith("group:") and not child.all_objects and not child.children:
                bpy.data.collections.remove(child)


def call(item: bpy.types.Object, name: str) -> None:
    """Give an object a name, which it has until the user gives it another one."""
    item.name = name
    item[NAME] = item.name


def find(items: Any, owner: Owner, role: str, name: str, fits: Callable[[Any], bool] = lambda item: True) -> Any:
    """The material or node group of a role among those of the file that fit; None when there is none.

    `name`: what it is called in scenes of Fieldwork 0.1, which know materials and groups by nothing else.
    """
    own = (item for item in items if item.get(ROLE) == role and owner.owns(item) and is_local(item))
    found = next((item for item in own if fits(item)), None)
    if found is None:
        old = items.get((name, None))  # None: in no library
        found = old if old is not None and ROLE not in old and UUID not in old and fits(old) else None
    if found is not None:
        owner.mark(found, role)
    return found


def hand_over(old: Owner, new: Owner) -> None:
    """Let what was made for one project belong to another: the same one under another name or in another place."""
    for items in (bpy.data.objects, bpy.data.collections, bpy.data.materials, bpy.data.node_groups):
        for item in items:
            if ROLE in item and old.owns(item) and is_local(item):
                new.mark(item, item[ROLE])
