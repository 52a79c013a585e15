"""What the verb `measure` left beside a mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import ProjectError
from ..mesh.stored import mesh_folder
from ..project.runs import MEASURES


def read_measures(project: Path, run: str) -> dict[str, Any] | None:
    """The measures of the mesh of a run; None where it was not measured. Raises ProjectError when they are damaged."""
    path = mesh_folder(project, run) / MEASURES
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork measure` again.") from error
