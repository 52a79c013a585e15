"""The verb `package`: what Blender needs of a capture, in a folder it can read without the engine's libraries."""

from __future__ import annotations

from typing import Any

from .blend_package import write_package
from .params import PackageParams
from .progress import Reporter
from .project import load_scene


def package(params: PackageParams, report: Reporter) -> dict[str, Any]:
    """Prepare the package of a project (see blend_package.py).

    Returns:
        {"folder", "cameras": count, "points": count, "mesh": whether there is one}
    Raises:
        ProjectError: there are no poses.
        InputError: a photo is missing.
    """
    folder = params.project.absolute()
    scene = load_scene(folder)
    target = write_package(folder, params.run, scene, folder.name, report, params.renders)
    return {
        "folder": str(target),
        "cameras": len(scene.views),
        "points": len(scene.points),
        "mesh": (target / "mesh.npz").is_file(),
    }
