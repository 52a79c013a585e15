"""How what belongs to a capture is recognised in a scene: by custom properties, so that it may be renamed.

`ROLE` says what it is in the capture, `UUID` of which project: the project's UUID, or the path of its folder where the
project has none yet. `PROJECT` is the name of that folder, for people; scenes of Fieldwork 0.1 have nothing else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

ROLE, PROJECT, UUID = "fieldwork_role", "fieldwork_project", "fieldwork_uuid"


class Owner(NamedTuple):
    """A project as scenes know it; `uuid` and `folder` (an absolute path) are empty where they are not known."""

    name: str
    uuid: str = ""
    folder: str = ""

    @staticmethod
    def of(folder: Path, uuid: str = "") -> Owner:
        return Owner(folder.name, uuid, str(folder))

    @property
    def key(self) -> str:
        """What stands for the project in scenes; empty where nothing but its name is known."""
        return self.uuid or self.folder

    def known_as(self, key: str) -> bool:
        """Whether the key of a scene is this project's, now or before it had a UUID."""
        return bool(key) and key in (self.uuid, self.folder)

    def owns(self, item: Any) -> bool:
        """Whether an object, collection, material or the like was made for this project."""
        key = item.get(UUID)
        return item.get(PROJECT) == self.name if key is None else self.known_as(key)

    def mark(self, item: Any, role: str) -> None:
        """Make the item this project's."""
        item[ROLE], item[PROJECT] = role, self.name
        if self.key:
            item[UUID] = self.key
