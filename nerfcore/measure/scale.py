"""How sure the scale is, and control distances: lengths measured on the thing itself, to scale by or to check with."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError, SettingError
from ..geometry.similarity import transform_points
from ..images.names import joined
from ..poses.align import placed_point
from ..project.schema import Poses, Project
from ..project.store import world_from_sfm

COLUMNS = ("name", "from", "to", "metres", "u_mm", "use")
USES = ("scale", "check")
METRES = "m"  # the unit of a project whose scale is known
EXACT = "taken as exact: nothing says how sure it is"  # the source of such a scale
PLACED = 1.0  # voxels: standard uncertainty of a point that was picked on the surface, along the distance
HINT = (
    "Write a table with the columns name,from,to,metres,u_mm,use: points as “x y z” or names of photos, use “scale” or "
    "“check”; leave metres and u_mm empty where they are not known."
)


@dataclass(frozen=True)
class Distance:
    """A distance between two points (3,) of the world: its length in the world, the one known for it in metres, with its
    standard uncertainty in metres, or None; use: "scale", "check" or "" where none is known."""

    name: str
    start: np.ndarray
    end: np.ndarray
    known: float | None
    u_known: float
    use: str

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.end - self.start))


@dataclass(frozen=True)
class Scale:
    """unit "m", or "scene units" while the scale is not known; u: relative standard uncertainty; source: what it follows
    from, in words; factor: by how much the distances to scale by are longer than measured, 1 without any."""

    unit: str
    u: float
    source: str
    factor: float = 1.0


def read_distances(path: Path, frame: np.ndarray, poses: Poses) -> list[Distance]:
    """The distances of a .csv file with the columns `COLUMNS`; points are in the world of `frame` (4, 4), world from sfm.

    Raises:
        InputError: the file is missing or of another form, and in which line.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or []
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"The distances {path} cannot be read: {error}.", HINT) from error
    if not {"name", "from", "to"} <= set(columns) <= set(COLUMNS):
        raise InputError(f"{path} has the columns {', '.join(columns) or 'none'}.", HINT)
    return [_distance(path, number, row, frame, poses) for number, row in rows]


def _distance(path: Path, line: int, row: dict[str, str], frame: np.ndarray, poses: Poses) -> Distance:
    if None in row:
        raise InputError(f"{path}, line {line}: it has more cells than there are columns.", HINT)
    given = {key: (row.get(key) or "").strip() for key in COLUMNS}
    try:
        start, end = (_place(given[key], frame, poses) for key in ("from", "to"))
    except SettingError as error:
        raise InputError(f"{path}, line {line}: {error.message}", HINT) from error
    try:
        metres = float(given["metres"]) if given["metres"] else None
        unsure = float(given["u_mm"] or 0) / 1000
    except ValueError as error:
        raise InputError(f"{path}, line {line}: a length is no number.", HINT) from error
    use = given["use"] or ("check" if metres is not None else "")
    if use not in (*USES, "") or (metres is None) != (use == ""):
        raise InputError(f"{path}, line {line}: use is {use!r}, metres {given['metres']!r}.", HINT)
    if (metres is not None and not 0 < metres < np.inf) or not 0 <= unsure < np.inf:
        raise InputError(f"{path}, line {line}: lengths are positive.", HINT)
    if np.linalg.norm(end - start) < 1e-9:
        raise InputError(f"{path}, line {line}: both ends are the same place.", HINT)
    return Distance(given["name"], start, end, metres, unsure, use)


def _place(text: str, frame: np.ndarray, poses: Poses) -> np.ndarray:
    """A point (3,) of the world: “x y z”, with commas or without, or the name of a photo. Raises SettingError."""
    name = joined(text)  # as photos are called here, whose files may have spaces in their names
    known = any(image.name == name for image in poses.images)
    return placed_point(name if known and text else ",".join(text.replace(",", " ").split()), frame, poses)


def u_measured(distance: Distance, scale: Scale, voxel: float) -> float:
    """Standard uncertainty of a length in the world: that of the scale, and of the places of its two ends."""
    return float(np.hypot(distance.length * scale.u, np.sqrt(2) * PLACED * voxel))


def scale_of(project: Project, poses: Poses, distances: list[Distance], voxel: float, percent: float | None) -> Scale:
    """How sure the scale of a project is: what the user says, else from the distances to scale by, else from how it was
    set, both ends of a distance being placed to a voxel.

    Several distances give their weighted mean, its uncertainty widened where they differ more than they should
    (Birge, "The calculation of errors by the method of least squares", 1932).
    """
    if not project.frame.scale_known:
        return Scale("scene units", 0.0, "the scale is not known")
    by = [d for d in distances if d.use == "scale"]
    factor, u = 1.0, 0.0
    if by:
        ratio = np.array([(d.known or 0.0) / d.length for d in by])
        each = np.array([np.hypot(d.u_known, np.sqrt(2) * PLACED * voxel) / d.length for d in by])
        weight = 1 / np.maximum(each, 1e-9) ** 2
        factor, u = float((weight * ratio).sum() / weight.sum()), float(weight.sum() ** -0.5)
        if len(by) > 1:
            u *= max(1.0, float(np.sqrt((weight * (ratio - factor) ** 2).sum() / (len(by) - 1))))
    if percent is not None:
        return Scale(METRES, percent / 100, "as given", factor)
    if by:
        return Scale(METRES, u, f"{len(by)} control distance{'s' if len(by) > 1 else ''}", factor)
    return _as_set(project, poses, voxel)


def _as_set(project: Project, poses: Poses, voxel: float) -> Scale:
    """What the step that set the scale last says of it."""
    for step in reversed(project.provenance):
        if step.verb == "align" and step.settings.get("scale"):
            metres = float(step.settings["scale"][2])
            return Scale(METRES, np.sqrt(2) * PLACED * voxel / metres, f"one distance of {metres:g} m")
        residual = (step.result.get("gps") or {}).get("residual_m") if step.verb in ("align", "poses") else None
        if residual is not None:
            # Standard uncertainty of the slope of a straight line through positions.
            frame = world_from_sfm(project)
            centers = transform_points(frame, np.array([np.array(i.camera_to_world)[:3, 3] for i in poses.images]))
            spread = float(np.sqrt(((centers - centers.mean(0))[:, :2] ** 2).sum()))
            return Scale(METRES, float(residual) / max(spread, 1e-9), "GPS positions of the photos")
        if step.verb in ("poses", "import") and step.result.get("world_kept") is False:
            break  # what was set before was of another world
    return Scale(METRES, 0.0, EXACT)
