"""Work in the scene is done in slices, between which the user may do anything: what is held of the scene is looked up
again in each."""

from __future__ import annotations

from typing import Any

from ..errors import SceneChanged

_number = 0


def new_slice() -> None:
    """Blender has been free since: references to what is in the scene may lead nowhere."""
    global _number
    _number += 1


def number() -> int:
    """Of the present slice."""
    return _number


class Held:
    """A datablock that is needed in several slices, without a reference to it."""

    def __init__(self, items: Any, item: Any) -> None:
        """`items`: the list of `bpy.data` in which it is found."""
        self.items, self.name, self.uid = items, item.name, item.session_uid

    def __call__(self) -> Any:
        """The datablock. Raises SceneChanged: it is gone."""
        item = self.items.get(self.name)
        if item is None or item.session_uid != self.uid:  # it was renamed
            item = next((other for other in self.items if other.session_uid == self.uid), None)
        if item is None:
            raise SceneChanged(f"“{self.name}” was deleted while it was being made.")
        self.name = item.name
        return item
