"""The verb `instances`: the things of a mesh, renamed, joined and split by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ..errors import InputError, ProjectError
from ..files import staged, write_json
from ..mesh.instances import Instance, joined, read_instances, write_instances
from ..mesh.stored import MESH, mesh_folder, mesh_record
from ..mesh.triangles import areas, components
from ..params import InstancesParams
from ..progress import Reporter
from ..project.label_revision import LABEL_REVISION
from ..project.runs import MEASURES, SCENE_GRAPH
from ..project.store import load_project, record_step
from .mesh_files import read_arrays, write_files

PACKAGE = "package/package.json"  # beside the mesh, see blender/package.py
LEAST_SHARE = 0.01  # of the area of what is split, below which a piece stays with the nearest other one


def instances(params: InstancesParams, report: Reporter) -> dict[str, Any]:
    """List the instances of a mesh, or change one thing about them.

    Returns:
        {"instances": [{"id", "name", "class_id", "class", "area"}], "changed": names that are new, "label_revision": of the
        marks that classes are from, or None, "file"}
    Raises:
        ProjectError: there is no mesh or its files are damaged. InputError: there is no such instance, the new name is
        taken, instances of several classes are to be one, or one is not to be split. DiskError.
    """
    folder = Path(params.project)
    project, target = load_project(folder), mesh_folder(folder, params.run)
    record = mesh_record(folder, params.run)
    before = read_instances(target)
    after, changed, numbers = before, [], None
    if params.rename:
        after, changed = renamed(before, *params.rename)
        for path in (target / MEASURES, target / PACKAGE):
            _rename_in(path, params.rename[0], changed[0])
    elif params.merge or params.split:
        arrays = read_arrays(target / MESH)
        if "face_instance" not in arrays:
            raise ProjectError(f"{target / MESH} has no instances.", "Run `fieldwork mesh` again.")
        report.stage("Changing instances")
        done = merged(arrays, before, params.merge) if params.merge else split(arrays, before, params.split)
        numbers, after, changed = done
    if after is not before:
        with staged(target) as here:
            write_instances(here, after)
            write_files(here, folder, params.run, after, numbers, report)
            if numbers is not None:
                for path in (target / MEASURES, target / SCENE_GRAPH):  # they are of others
                    path.unlink(missing_ok=True)
        record_step(folder, "instances", params.model_dump(mode="json"), {"changed": changed})
    names = {c.id: c.name for c in project.classes}
    return {
        "instances": [
            {"id": i.id, "name": i.name, "class_id": i.class_id, "class": names.get(i.class_id, ""), "area": i.area}
            for i in after
        ],
        "changed": changed,
        LABEL_REVISION: record.result.get(LABEL_REVISION),
        "file": str(target / "instances.json"),
    }


def renamed(known: list[Instance], old: str, new: str) -> tuple[list[Instance], list[str]]:
    """The instances with another name for one of them. Raises InputError."""
    one, new = chosen(known, old), new.strip()
    if not new:
        raise InputError("The new name is empty.", "Give a name after the old one.")
    if any(other.name == new for other in known if other.id != one.id):
        raise InputError(f"There is an instance “{new}” already.", "Give another name.")
    return [replace(i, name=new) if i.id == one.id else i for i in known], [new]


def _rename_in(path: Path, old: str, new: str) -> None:
    """Give an instance its new name in measures or a package, where there are any. Raises ProjectError, DiskError."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        for row in [*value.get("instances", []), *value.get("measures", {}).get("instances", [])]:
            if row["name"] == old:
                row["name"] = new
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Delete it and make it again.") from error
    write_json(path, value)


def merged(
    arrays: dict[str, np.ndarray], known: list[Instance], names: list[str]
) -> tuple[np.ndarray, list[Instance], list[str]]:
    """Instance of each face and the instances, where those of these names are one, which has the first one's name."""
    parts = [chosen(known, name) for name in dict.fromkeys(names)]
    if len(parts) < 2:
        raise InputError("Only one instance was named.", "Name at least two that shall be one.")
    if len({part.class_id for part in parts}) > 1:
        raise InputError(
            "Instances of several classes cannot be one.", "Label them alike first (`fieldwork label stroke`)."
        )
    first, ids = parts[0], [part.id for part in parts]
    face_instance = arrays["face_instance"].copy()
    face_instance[np.isin(face_instance, ids)] = first.id
    whole = joined(parts)
    return face_instance, [whole if i.id == first.id else i for i in known if i.id not in ids[1:]], [first.name]


def split(
    arrays: dict[str, np.ndarray], known: list[Instance], name: str
) -> tuple[np.ndarray, list[Instance], list[str]]:
    """Instance of each face and the instances, where the connected pieces of one are instances of their own: the largest
    keeps number and name."""
    one = chosen(known, name)
    own = np.flatnonzero(arrays["face_instance"] == one.id)
    faces, vertices = arrays["faces"][own], arrays["vertices"].astype(np.float64)
    part = components(faces, len(vertices))
    size = np.bincount(part, areas(vertices, faces))
    kept = [p for p in np.argsort(-size, kind="stable").tolist() if size[p] >= LEAST_SHARE * size.sum()]
    if len(kept) < 2:
        raise InputError(f"“{name}” is one connected piece.", "Mark its parts as different classes to tell them apart.")
    middle = vertices[faces].mean(1)
    big = np.isin(part, kept)
    if not big.all():
        part[~big] = part[big][np.asarray(scipy.spatial.KDTree(middle[big]).query(middle[~big])[1])]
    face_instance, made = arrays["face_instance"].copy(), []
    number, taken = max(i.id for i in known), {i.name for i in known}
    for p in kept[1:]:
        number += 1
        face_instance[own[part == p]] = number
        free = next(f"{one.name}.{n}" for n in range(2, len(taken) + 3) if f"{one.name}.{n}" not in taken)
        taken.add(free)
        area, center = _measured(arrays, face_instance == number)
        made.append(Instance(number, free, one.class_id, area, center))
    area, center = _measured(arrays, face_instance == one.id)
    rest = [replace(i, area=area, center=center, parts=()) if i.id == one.id else i for i in known]
    return face_instance, [*rest, *made], [instance.name for instance in made]


def chosen(known: list[Instance], name: str) -> Instance:
    """The instance of a name. Raises InputError."""
    found = next((instance for instance in known if instance.name == name), None)
    if found is None:
        there = ", ".join(i.name for i in known[:20]) or "none"
        raise InputError(f"There is no instance “{name}”.", f"There are {there}.")
    return found


def _measured(arrays: dict[str, np.ndarray], mask: np.ndarray) -> tuple[float, tuple[float, float, float]]:
    """Area and mean place of some faces."""
    vertices, faces = arrays["vertices"].astype(np.float64), arrays["faces"][mask]
    area = areas(vertices, faces)
    x, y, z = (np.average(vertices[faces].mean(1), axis=0, weights=np.maximum(area, 1e-30))).tolist()
    return float(area.sum()), (x, y, z)
