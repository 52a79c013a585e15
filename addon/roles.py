"""How what belongs to a capture is recognised in a scene: by custom properties, so that it may be renamed.

`ROLE` says what it is in the capture, `UUID` of which project. `PROJECT` is the name of the project's folder, for people;
scenes of Fieldwork 0.1 have nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

ROLE, PROJECT, UUID = "fieldwork_role", "fieldwork_project", "fieldwork_uuid"
FOLDER = "fieldwork_folder"  # on the parent, in files of `fieldwork blend`: the project's folder, seen from the file


class Owner(NamedTuple):
    """A project as scenes know it: the name of its folder, and its UUID, empty where that is not known."""

    name: str
    uuid: str = ""

    def owns(self, item: Any) -> bool:
        """Whether an object, collection, material or the like was made for this project."""
        return item[UUID] == self.uuid if UUID in item else item.get(PROJECT) == self.name

    def mark(self, item: Any, role: str) -> None:
        """Make the item this project's."""
        item[ROLE], item[PROJECT] = role, self.name
        if self.uuid:
            item[UUID] = self.uuid


def is_local(item: Any) -> bool:
    """Whether a datablock is this file's to change: neither linked from another nor an override of what is."""
    return item.library is None and item.override_library is None


def by_role(objects: Iterable[Any], owner: Owner) -> dict[str, Any]:
    """The file's own objects of a project by their roles. Copies, which have the role as well, come after their original."""
    found: dict[str, Any] = {}
    for item in objects:
        if ROLE in item and owner.owns(item) and is_local(item):
            found.setdefault(item[ROLE], item)
    return found
