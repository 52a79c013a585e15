"""The verb `relations`: the scene graph of a mesh, and what of it a question means.

exports/RUN/scene_graph.json
    {"made": digest of the mesh and its instances, "things": [{"id", "name", "class_id", "class", "area", "center", "low",
    "high"}], "relations": [{"subject", "relation", "object", "gap"}], "label_revision": of the marks that classes are
    from, or null}; ids are those of `face_instance`, lengths in the world
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ProjectError
from ..files import write_json
from ..mesh.instances import Instance, read_instances
from ..mesh.metrics import sample_surface
from ..mesh.stored import load_surface, mesh_folder, mesh_record
from ..mesh.surface import Surface
from ..mesh.triangles import areas, cross, unit
from ..params import RelationsParams
from ..progress import Reporter
from ..project.fingerprints import digest
from ..project.label_revision import LABEL_REVISION
from ..project.runs import SCENE_GRAPH
from ..project.store import load_project, record_step
from .query import answer
from .relations import TOUCH, Thing, relations

MOST_POINTS = 8_000  # of a thing
LEAST_POINTS = 500
DENSITY = 0.7  # distance of points in units of the gap that is contact
VERSION = 2


def relate(params: RelationsParams, report: Reporter) -> dict[str, Any]:
    """Find how the instances of a mesh stand to each other, unless that is known, and answer a question about it.

    Returns:
        {"things": number, "relations": [{"subject", "relation", "object", "gap"}] by names, "found": names of the things
        that `query` means, "label_revision": of the marks that classes are from, or None, "reused", "file"}
    Raises:
        ProjectError: there is no mesh, it has no instances, or its files are damaged. InputError: the question.
    """
    folder = Path(params.project)
    load_project(folder)
    graph, reused = scene_graph(folder, params.run, report)
    found = answer(graph, params.query) if params.query.strip() else []
    names = {thing["id"]: thing["name"] for thing in graph["things"]}
    result = {
        "things": len(names),
        "relations": [{**r, "subject": names[r["subject"]], "object": names[r["object"]]} for r in graph["relations"]],
        "found": found,
        LABEL_REVISION: graph[LABEL_REVISION],
        "reused": reused,
        "file": str(mesh_folder(folder, params.run) / SCENE_GRAPH),
    }
    if not reused:
        record_step(folder, "relations", params.model_dump(mode="json"), {"things": len(names), "file": result["file"]})
    return result


def scene_graph(folder: Path, run: str, report: Reporter) -> tuple[dict[str, Any], bool]:
    """The scene graph of a run's mesh, made where there is none of its present instances; whether it was there already.

    Raises:
        ProjectError: there is no mesh, it has no instances, or its files are damaged.
    """
    record, target = mesh_record(folder, run), mesh_folder(folder, run)
    instances = read_instances(target)
    made = digest([VERSION, record.time, record.checkpoint, record.inputs, [vars(i) for i in instances]])
    known = stored_graph(target / SCENE_GRAPH)
    if known is not None and known["made"] == made:
        return known, True
    if not instances:
        raise ProjectError(
            f"The mesh of the run “{run}” has no instances.",
            "Give it classes (`fieldwork label accept`), then run `fieldwork mesh` again.",
        )
    surface, _ = load_surface(folder, run)
    names = {c.id: c.name for c in load_project(folder).classes}
    report.stage("Looking at the things")
    things = things_of(surface, instances, names, report)
    report.stage("Finding relations")
    graph = {"made": made, **as_json(things, relations(things), instances)}
    graph[LABEL_REVISION] = record.result.get(LABEL_REVISION)
    write_json(target / SCENE_GRAPH, graph)
    return graph, False


def stored_graph(path: Path) -> dict[str, Any] | None:
    """The scene graph in a file; None where there is no readable one."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        return value if {"made", "things", "relations"} <= set(value) else None
    except (OSError, ValueError, TypeError):
        return None


def things_of(surface: Surface, instances: list[Instance], names: dict[int, str], report: Reporter) -> list[Thing]:
    """The instances of a surface in the world as things, by points so dense that none passes between contacts."""
    if surface.face_instance is None:
        return []
    vertices = surface.vertices.astype(np.float64)
    normals, size = unit(cross(vertices, surface.faces)), areas(vertices, surface.faces)
    spacing = TOUCH * float(np.linalg.norm(np.ptp(vertices, axis=0))) * DENSITY
    made = []
    for number, instance in enumerate(instances):
        report.progress(number / len(instances), instance.name)
        own = np.flatnonzero(surface.face_instance == instance.id)
        if not len(own):
            continue
        area = float(size[own].sum())
        count = int(np.clip(area / max(spacing, 1e-12) ** 2, LEAST_POINTS, MOST_POINTS))
        points, face = sample_surface(vertices, surface.faces[own], count)
        branch = tuple(names.get(instance.class_id, str(instance.class_id)).split("/"))
        made.append(Thing(instance.id, instance.name, branch, points, normals[own][face], area))
    return made


def as_json(things: list[Thing], found: list[Any], instances: list[Instance]) -> dict[str, Any]:
    """Things and relations as scene_graph.json has them."""
    known = {instance.id: instance for instance in instances}
    return {
        "things": [
            {
                "id": thing.id,
                "name": thing.name,
                "class_id": known[thing.id].class_id,
                "class": "/".join(thing.branch),
                "area": thing.area,
                "center": list(known[thing.id].center),
                "low": thing.low.tolist(),
                "high": thing.high.tolist(),
            }
            for thing in things
        ],
        "relations": [
            {"subject": r.subject, "relation": r.kind, "object": r.other, "gap": round(r.gap, 6)} for r in found
        ],
    }
