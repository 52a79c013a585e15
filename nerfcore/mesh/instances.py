"""Instances: the separate things of one class on a surface, with names that stay the same from run to run."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ..errors import ProjectError
from ..files import write_json
from ..geometry.similarity import similarity_scale, transform_points
from ..project.runs import INSTANCES
from ..project.runs import KEPT_INSTANCES as KEPT
from .triangles import areas, border_edges, components

GAP = 3.0  # voxels that a thing may be torn apart by: a crack of the reconstruction is one or two wide
LEAST_SHARE = 0.01  # of the area of its class, below which a part is no instance
ALIKE = 2.0  # by how much the areas of what may be the same thing in two meshes differ
SAME_SIZE = 0.05  # areas within one such step are told apart by where the things stand, not by their noise


Piece = tuple[float, tuple[float, float, float]]  # area and mean place


@dataclass(frozen=True)
class Instance:
    """A connected thing of one class: `id` as in the mesh's `face_instance`, its name (`plinth.001`) and class; area
    (world units²) and the mean place of its surface; parts: area and place of each piece that it was joined from by hand, so
    that a mesh that is made again joins them again."""

    id: int
    name: str
    class_id: int
    area: float
    center: tuple[float, float, float]
    parts: tuple[Piece, ...] = ()


def find_instances(
    vertices: np.ndarray,
    faces: np.ndarray,
    face_class: np.ndarray,
    names: Mapping[int, str],
    void: int,
    gap: float,
    least_share: float = LEAST_SHARE,
) -> tuple[np.ndarray, list[Instance]]:
    """The instance (F,) uint32 of each face (F, 3), 0 for none, and the instances in the order of their numbers.

    Parts of a class whose borders come closer than `gap` are one instance. Void, and parts below `least_share` of the
    area of their class, belong to none. Numbers go by class, in it by size, things of one size by where they stand.

    Args:
        vertices: (V, 3); names: of the class ids; gap: in units of the vertices.
    """
    vertices = np.asarray(vertices, np.float64)
    area, middle = areas(vertices, faces), vertices[faces].mean(1)
    face_instance, found = np.zeros(len(faces), np.uint32), []
    for class_id in sorted(set(np.unique(face_class).tolist()) - {void}):
        own = np.flatnonzero(face_class == class_id)
        part = joined_parts(vertices, faces[own], gap)
        size = np.bincount(part, area[own])
        total = np.maximum(size, 1e-30)[:, None]
        center = np.stack([np.bincount(part, area[own] * middle[own, k]) for k in range(3)], 1) / total
        step = np.round(np.log(np.maximum(size, 1e-30)) / SAME_SIZE)
        order = np.lexsort((*np.round(center / max(gap, 1e-9)).T[::-1], -step))
        kept = [p for p in order.tolist() if size[p] >= least_share * size.sum() and size[p] > 0]
        for number, p in enumerate(kept, 1):
            name = f"{names.get(class_id, class_id)}.{number:03d}"
            x, y, z = center[p].tolist()
            found.append(Instance(len(found) + 1, name, class_id, float(size[p]), (x, y, z)))
            face_instance[own[part == p]] = len(found)
    return face_instance, found


def with_earlier_names(
    instances: list[Instance], earlier: list[Instance], reserved: Collection[str] = ()
) -> list[Instance]:
    """The instances of a mesh that was made again, each with the name of the earlier one of its class that stood where it
    does and was about as large; names that are new take free numbers, none that is `reserved`."""
    pairs = []
    for number, one in enumerate(instances):
        for index, old in enumerate(earlier):
            apart = distance_if_alike((one.area, one.center), (old.area, old.center))
            if old.class_id == one.class_id and apart is not None:
                pairs.append((apart, number, index))
    names: dict[int, str] = {}
    used: set[int] = set()
    for _, number, index in sorted(pairs):
        if number not in names and index not in used:
            names[number] = earlier[index].name
            used.add(index)
    taken, found = {*names.values(), *reserved}, []
    for number, one in enumerate(instances):
        name = names.get(number)
        if name is None:
            stem = one.name.rpartition(".")[0]
            free = (f"{stem}.{n:03d}" for n in itertools.count(1))
            name = one.name if one.name not in taken else next(n for n in free if n not in taken)
            taken.add(name)
        found.append(replace(one, name=name))
    return found


def with_earlier_numbers(
    face_instance: np.ndarray, instances: list[Instance], earlier: list[Instance]
) -> tuple[np.ndarray, list[Instance]]:
    """Instance (F,) of each face and the instances of a mesh that was made again, which have the numbers of the earlier ones of
    their names: scenes know things by their numbers. Others have numbers that none of the last mesh had."""
    known = {old.name: old.id for old in earlier}
    free = itertools.count(1 + max(known.values(), default=0))
    found = [replace(one, id=known.get(one.name) or next(free)) for one in instances]
    number = np.zeros(1 + max((one.id for one in instances), default=0), face_instance.dtype)
    for one, new in zip(instances, found):
        number[one.id] = new.id
    return number[face_instance], found


def with_class_names(instances: list[Instance], former: Collection[str], names: Mapping[int, str]) -> list[Instance]:
    """Instances, of which those that are called after a class by a `former` name of it are called after its present one, unless
    that is taken."""
    found, taken = [], {one.name for one in instances}
    for one in instances:
        numbered = [name for name in former if re.match(rf"{re.escape(name)}\.\d{{3}}(\D|$)", one.name)]
        old = max(numbered, key=len, default=None)
        if old is not None and one.class_id in names:
            new = names[one.class_id] + one.name[len(old) :]
            one = one if new in taken else replace(one, name=new)
            taken.add(new)
        found.append(one)
    return found


def with_earlier_joins(
    face_instance: np.ndarray, instances: list[Instance], earlier: list[Instance]
) -> tuple[np.ndarray, list[Instance]]:
    """Instance (F,) of each face and the instances of a mesh that was made again, where what stands at the places of pieces
    that were joined by hand is one again. Numbers of the others stay."""
    face_instance, found = face_instance.copy(), list(instances)
    for old in (one for one in earlier if one.parts):
        alike = [i for i in found if i.class_id == old.class_id]
        stand = [_nearest(alike, piece) for piece in old.parts]
        same = list(dict.fromkeys(i for i in stand if i is not None))
        if len(same) > 1:
            whole = joined(same)
        else:  # perhaps they are one by themselves now: it is still remembered what they were
            one = _nearest(alike, (old.area, old.center))
            same = [] if one is None else [one]
            whole = None if one is None else replace(one, parts=old.parts)
        if whole is not None:
            face_instance[np.isin(face_instance, [i.id for i in same])] = whole.id
            found = [whole if i.id == whole.id else i for i in found if i.id == whole.id or i not in same]
    return face_instance, found


def _nearest(instances: list[Instance], piece: Piece) -> Instance | None:
    """The nearest of some instances to a place that is of about this size."""
    apart = [(distance_if_alike((one.area, one.center), piece), one) for one in instances]
    return min(((d, one) for d, one in apart if d is not None), key=lambda pair: pair[0], default=(0.0, None))[1]


def joined(parts: list[Instance]) -> Instance:
    """One instance of several of a class, with number and name of the first, and what it is made of."""
    area = np.array([part.area for part in parts])
    x, y, z = np.average([part.center for part in parts], axis=0, weights=np.maximum(area, 1e-30)).tolist()
    pieces = tuple(piece for part in parts for piece in part.parts or ((part.area, part.center),))
    return replace(parts[0], area=float(area.sum()), center=(x, y, z), parts=pieces)


def distance_if_alike(one: Piece, other: Piece) -> float | None:
    """How far apart what may be the same thing in two meshes is; None where it is not: too far away or of another size."""
    (area, place), (other_area, other_place) = one, other
    apart = float(np.linalg.norm(np.subtract(place, other_place)))
    alike = max(area, other_area) <= ALIKE * min(area, other_area)
    return apart if alike and apart <= 0.5 * min(area, other_area) ** 0.5 else None


def joined_parts(vertices: np.ndarray, faces: np.ndarray, gap: float) -> np.ndarray:
    """Number (F,) of the part of each face (F, 3), where parts with borders nearer than `gap` to each other are one."""
    part = components(faces, len(vertices))
    count = int(part.max(initial=-1)) + 1
    at_border = np.unique(border_edges(faces))
    if count < 2 or not len(at_border):
        return part
    of_vertex = np.zeros(len(vertices), np.int64)
    of_vertex[faces] = part[:, None]
    pairs = scipy.spatial.KDTree(vertices[at_border]).query_pairs(gap, output_type="ndarray")
    a, b = of_vertex[at_border[pairs]].T
    linked = scipy.sparse.coo_matrix((np.ones(len(a), bool), (a, b)), (count, count))
    _, joined = scipy.sparse.csgraph.connected_components(linked, False)
    return joined[part]


def write_instances(folder: Path, instances: list[Instance]) -> Path:
    """Write instances.json into the folder of the mesh and return its path. Raises DiskError."""
    write_json(folder / INSTANCES, [asdict(instance) for instance in instances])
    return folder / INSTANCES


def read_instances(folder: Path) -> list[Instance]:
    """The instances that stand beside a mesh; none where it was made before there were any.

    Raises:
        ProjectError: the file is damaged.
    """
    path = folder / INSTANCES
    try:
        return [_read(value) for value in json.loads(path.read_text(encoding="utf-8"))]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork mesh` again.") from error


def write_kept(folder: Path, beyond: list[Instance], world_from_marks: np.ndarray) -> Path:
    """Write beside instances.json where the world of its places lies, (4, 4) from the frame in which marks stay, and the things
    that are known and lie beyond the region of the mesh; its path. Raises DiskError."""
    write_json(folder / KEPT, {"world_from_marks": world_from_marks.tolist(), "beyond": [asdict(i) for i in beyond]})
    return folder / KEPT


def read_known(folder: Path, world_from_marks: np.ndarray) -> list[Instance] | None:
    """The instances beside a mesh and those that were known beyond it, in the world as it lies now; None where it is not known how
    it lay.

    Raises:
        ProjectError: instances.json is damaged.
    """
    try:
        value = json.loads((folder / KEPT).read_text(encoding="utf-8"))
        motion = world_from_marks @ np.linalg.inv(np.array(value["world_from_marks"], np.float64).reshape(4, 4))
        beyond = [_read(one) for one in value["beyond"]]
    except (OSError, ValueError, TypeError, KeyError, np.linalg.LinAlgError):
        return None
    found = read_instances(folder)
    names, numbers = {one.name for one in found}, {one.id for one in found}
    free = itertools.count(1 + max([0, *numbers, *(one.id for one in beyond)]))
    for one in beyond:
        if one.name not in names:  # somebody gave the name to another one, or split took the number
            found.append(replace(one, id=next(free)) if one.id in numbers else one)
    return [_moved(one, motion) for one in found]


def _moved(one: Instance, motion: np.ndarray) -> Instance:
    """An instance carried by a similarity (4, 4)."""

    def piece(area: float, place: tuple[float, float, float]) -> Piece:
        x, y, z = transform_points(motion, np.array([place]))[0].tolist()
        return area * similarity_scale(motion) ** 2, (x, y, z)

    area, center = piece(one.area, one.center)
    return replace(one, area=area, center=center, parts=tuple(piece(*part) for part in one.parts))


def _read(value: dict[str, Any]) -> Instance:
    def place(given: Any) -> tuple[float, float, float]:
        x, y, z = (float(part) for part in given)
        return x, y, z

    pieces = tuple((float(area), place(given)) for area, given in value.get("parts", ()))
    return Instance(**{**value, "center": place(value["center"]), "parts": pieces})
