"""The surface of a run as the verb `mesh` left it on disk."""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from PIL import Image

from ..errors import ProjectError
from .files import Texture, texture_of
from .surface import Surface

MESH = "mesh.npz"
TEXTURE = "texture.png"


def mesh_folder(project: Path, run: str) -> Path:
    return Path(project) / "exports" / run


def load_surface(project: Path, run: str) -> tuple[Surface, Texture | None]:
    """The surface of a run in the world, and its texture, as `mesh` left them.

    Raises:
        ProjectError: there is none, or its file is damaged.
    """
    path = mesh_folder(project, run) / MESH
    try:
        with np.load(path, allow_pickle=False) as data:
            stored = [field for field in fields(Surface) if field.name in data or field.default is MISSING]
            surface = Surface(**{field.name: data[field.name] for field in stored})
            uv = data.get("uv", None)
    except FileNotFoundError as error:
        raise ProjectError(f"The run “{run}” has no mesh yet.", "Run `fieldwork mesh` first.") from error
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork mesh` again.") from error
    picture = path.with_name(TEXTURE)
    if uv is None or not picture.is_file():
        return surface, None
    with Image.open(picture) as image:
        return surface, texture_of(surface.faces, uv, np.array(image.convert("RGB")))
