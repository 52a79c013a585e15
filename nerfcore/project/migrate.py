"""Project files of earlier versions, brought to the present one.

Standard library only: Blender's side imports this module too.
"""

from __future__ import annotations

import json
import uuid
from typing import Any

NAMESPACE = uuid.UUID("7a1de3f0-7d0c-4b0e-9d8e-3a3f8d0c5b11")  # of the identities made for projects without one


def migrated(value: dict[str, Any]) -> dict[str, Any]:
    """The contents of a project.json of any known version as of version 2; the argument is left as it is.

    1 → 2: a project has an identity, `uuid`. It follows from when the project was made and from the hashes of its
    photos, so that every reader finds the same one until the file is written again.
    """
    version = value.get("version", 1)
    if version == 1:
        images = value.get("images")
        hashes = [
            image.get("sha256") for image in (images if isinstance(images, list) else []) if isinstance(image, dict)
        ]
        name = json.dumps([value.get("created"), hashes])
        value = {"uuid": uuid.uuid5(NAMESPACE, name).hex, **value, "version": 2}
    return value
