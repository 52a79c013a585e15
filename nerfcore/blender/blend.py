"""The verb `blend`: a capture as a .blend, by a package for Blender and a Blender that reads it."""

from __future__ import annotations

import time
from typing import Any

from ..data.load import load_scene
from ..errors import SettingError
from ..params import BlendParams
from ..progress import Reporter
from ..project.store import record_step
from .package import write_package
from .process import write_in_blender


def blend(params: BlendParams, report: Reporter) -> dict[str, Any]:
    """Write the cameras, points and mesh of a project into `params.out`.

    Returns:
        {"file", "objects": [names], "cameras", "points", "mesh": faces or null, "seconds", "warnings"}.
    Raises:
        SettingError: the output is not named *.blend.
        ProjectError: there are no poses.
        BlenderError: Blender is missing or failed.
    """
    started = time.monotonic()
    out = params.out.absolute()
    if out.suffix != ".blend":
        raise SettingError(f"{out} is no Blender file.", "Name a file that ends in .blend.")
    folder = params.project.absolute()
    scene = load_scene(folder)
    package = write_package(folder, params.run, scene, folder.name, report, params.renders)
    warnings = []
    if not (package / "mesh.npz").is_file():
        warnings.append("There is no mesh yet: the .blend holds cameras and points only. Run `fieldwork mesh` first.")
    if not len(scene.points):
        warnings.append("The project has no sparse points.")
    result = write_in_blender("blend", package, out, params.split == "classes", report)
    for warning in [*warnings, *result.pop("warnings")]:
        report.warn(warning)
    record_step(folder, "blend", params.model_dump(mode="json"), {"file": str(out)})
    return {
        "file": str(out),
        **result,
        "seconds": round(time.monotonic() - started, 1),
        "warnings": report.warnings,
    }
