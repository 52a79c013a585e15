"""What a report may say of a mesh: only what is of the mesh that is there, and where it lies now."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import Any

from ..errors import ProjectError
from ..mesh.stored import mesh_folder, mesh_record
from ..progress import Reporter, shortened
from ..project.runs import MEASURES
from ..project.schema import Project, ProvenanceStep

MAKES = ("mesh", "blocks")  # verbs that make a mesh
DRAWS = ("plan", "section")


def mesh_stands(folder: Path, run: str, result: dict[str, Any], report: Reporter) -> bool:
    """Whether the mesh of a run is whole and lies where the project does; warns where it does not, and something is known
    of it."""
    try:
        mesh_record(folder, run)
    except ProjectError as error:
        target = mesh_folder(folder, run)
        if result.get("mesh") or (target / MEASURES).is_file() or _drawings(folder, run):
            report.warn(f"The report leaves out mesh, measures and drawings. {error}")
        return False
    return True


def current_drawings(folder: Path, project: Project, run: str, report: Reporter) -> list[Path]:
    """The drawings of a run, without those of an earlier mesh, of which it warns.

    What a drawing is of follows from the order of the steps: times of files are others once a project was copied.
    """
    made = max((n for n, step in enumerate(project.provenance) if step.verb in MAKES and _is_of(step, run)), default=-1)
    drawn = {}
    for number, step in enumerate(project.provenance):
        if step.verb in DRAWS and _is_of(step, run) and step.settings.get("out") is None:
            drawn |= {PureWindowsPath(path).name: number for path in step.result.get("files", [])}
    found = _drawings(folder, run)
    old = [path.name for path in found if drawn.get(path.name, made) < made]
    if old:
        told = shortened("The report leaves out drawings that were made of an earlier mesh", old)
        report.warn(f"{told} Run `fieldwork plan` or `fieldwork section` again, or delete them.")
    return [path for path in found if path.name not in old]


def _drawings(folder: Path, run: str) -> list[Path]:
    return sorted((mesh_folder(folder, run) / "drawings").glob("*.png"))


def _is_of(step: ProvenanceStep, run: str) -> bool:
    return step.settings.get("run", "blocks" if step.verb == "blocks" else run) == run
