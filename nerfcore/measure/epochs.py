"""The verb `compare`: two epochs of one object, the meshes of two projects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ProjectError
from ..files import atomic_path, write_json
from ..geometry.registration import Registered, by_points, by_surfaces
from ..geometry.similarity import similarity_scale
from ..kernels.closest import ClosestPoints
from ..mesh.metrics import sample_surface
from ..mesh.stored import mesh_folder
from ..mesh.surface import Surface, to_world
from ..mesh.triangles import areas, components, cross, unit
from ..params import CompareParams
from ..progress import Reporter
from ..project.store import record_step
from .amounts import K
from .drawings import Subject, axis_names, framed, load_subject, warn_of_unused_scale
from .lettering import warn_of_missing
from .sheet import Entry, Sheet, write_sheet
from .views import picture, projection
from .wording import significant

SAMPLES = 100_000  # points of a surface that distances are taken from
FAR = 20.0  # voxels: what is farther from the other epoch has no counterpart there
CHUNK = 20_000  # points at once
LEAST_VOXELS = 0.1  # no change below this share of a cell is told from noise, however alike two meshes are
LEAST_CELLS = 20.0  # area in cells below which a connected patch of moved surface is noise
NOTHING = (0.6, 0.6, 0.6)  # colour of what has no counterpart
STEPS = 9  # of the legend


def compare(params: CompareParams, report: Reporter) -> dict[str, Any]:
    """Compare the mesh of a project with that of `other`, an earlier epoch of the same object.

    The other mesh is registered onto this one; distances are those of this mesh's vertices from it, positive where this
    one lies outside: something was added.

    Returns:
        {"unit", "transform": (4×4) world of this project from that of the other, "rms": of the registration, "detectable":
        distance from which on a change is none of noise (95 %), "changed_area": of connected patches that moved by more,
        "unmatched_area", "p05", "median", "p95"
        of the distances, "classes": [{"name", "before", "after", "change", "change_low", "change_high"}], "label_revision" and
        "other_label_revision": of the marks that the classes of the two are from, or None, "files"}
    Raises:
        ProjectError: one of them has no mesh. InputError: the file of common points.
    """
    folder, other = Path(params.project), Path(params.other)
    now, before = load_subject(folder, params.run), load_subject(other, params.other_run)
    report.stage("Registering")
    registered = register(now, before, params.points, report)
    past = to_world(before.surface, registered.transform)
    report.stage("Measuring distances")
    limit = params.limit or FAR * now.voxel
    distance = signed_distances(now.surface.vertices, past, report)
    distance[np.abs(distance) > limit] = np.nan
    if not np.isfinite(distance).any():
        raise ProjectError(
            f"Nothing of the two meshes is within {limit:.3g} of each other.",
            "Give common points (--points) or a larger --limit.",
        )
    target = params.out or mesh_folder(folder, params.run) / "compare"
    result = summary(now, before, registered, distance)
    report.stage("Drawing")
    warn_of_missing([now.title], report)
    warn_of_unused_scale(params.scale, now, report)
    colors, legend = distance_colors(distance, result["unit"])
    files = [write_distances(target / "distance.ply", now.surface, distance, colors)]
    noise = f"noise ±{length(result['detectable'], result['unit'])} (95 %)"
    files += draw_distances(target, now, colors, legend, noise, params, report)
    result["files"] = [str(path) for path in [*files, target / "compare.json"]]
    write_json(target / "compare.json", result)
    record_step(folder, "compare", params.model_dump(mode="json"), result)
    return result


def register(now: Subject, before: Subject, points: Path | None, report: Reporter) -> Registered:
    """The earlier epoch over the present one; sizes are fitted where one of the scales is not known."""
    with_scale = not (now.metric and before.metric)
    if points is not None:
        return by_points(points, with_scale)
    here, face = sample_surface(now.surface.vertices.astype(np.float64), now.surface.faces, SAMPLES)
    there, _ = sample_surface(before.surface.vertices.astype(np.float64), before.surface.faces, SAMPLES, seed=1)
    normals = unit(cross(now.surface.vertices.astype(np.float64), now.surface.faces))[face]
    return by_surfaces((here, normals), np.random.default_rng(0).permutation(there), with_scale, report)


def signed_distances(points: np.ndarray, surface: Surface, report: Reporter) -> np.ndarray:
    """Distance (N,) of points (N, 3) from a surface, negative behind it."""
    mesh, parts = ClosestPoints(surface.vertices, surface.faces), []
    for begin in range(0, len(points), CHUNK):
        report.progress(begin / len(points))
        some = np.asarray(points[begin : begin + CHUNK], np.float64)
        face, weights, far = mesh.find(some)
        corners = surface.faces[face]
        closest = np.einsum("nk,nkc->nc", weights, surface.vertices[corners])
        # Beside an edge the closest triangle may be seen from the side: normals of corners say which side is out.
        normal = np.einsum("nk,nkc->nc", weights, surface.normals[corners])
        parts.append(np.where(((some - closest) * normal).sum(1) < 0, -far, far))
    return np.concatenate(parts)


def summary(now: Subject, before: Subject, registered: Registered, distance: np.ndarray) -> dict[str, Any]:
    """What is known of the change, as JSON. Noise is told by the median of the absolute distances, which changes of less
    than half of the surface leave alone."""
    found = distance[np.isfinite(distance)]
    noise = 1.4826 * float(np.median(np.abs(found - np.median(found))))
    detectable = max(K * noise, registered.rms, LEAST_VOXELS * now.voxel)
    area = areas(now.surface.vertices.astype(np.float64), now.surface.faces)
    moved = moved_faces(now.surface.faces, area, distance, detectable, LEAST_CELLS * now.voxel**2)
    p05, middle, p95 = np.quantile(found, (0.05, 0.5, 0.95)).tolist()
    return {
        "unit": "m" if now.metric else "scene units",
        "transform": registered.transform.tolist(),
        "rms": registered.rms,
        "detectable": detectable,
        "changed_area": float(area[moved].sum()),
        "unmatched_area": float(area[~np.isfinite(distance[now.surface.faces]).all(1)].sum()),
        "p05": p05,
        "median": middle,
        "p95": p95,
        "classes": class_changes(now, before, similarity_scale(registered.transform)),
        "label_revision": now.label_revision,
        "other_label_revision": before.label_revision,
    }


def moved_faces(
    faces: np.ndarray, area: np.ndarray, distance: np.ndarray, detectable: float, least: float
) -> np.ndarray:
    """The faces (F,) bool of which every vertex moved by more than `detectable`, all to one side, in connected patches of an
    area of at least `least`: noise goes far here and there, but not as a patch.

    Args:
        area: (F,) of the faces (F, 3); distance: (V,) of the vertices, NaN where there is none.
    """
    moved, each = np.zeros(len(faces), bool), distance[faces]
    for side in (each, -each):
        with np.errstate(invalid="ignore"):
            own = np.flatnonzero((side > detectable).all(1))
        part = components(faces[own], len(distance))
        moved[own] = (np.bincount(part, area[own]) >= least)[part]
    return moved


def class_changes(now: Subject, before: Subject, scale: float) -> list[dict[str, Any]]:
    """Areas by the names of the classes before and after; with the ends of the change's 95 % interval where both epochs
    were measured. `scale`: by how much the earlier epoch was enlarged."""
    rows = []
    for name, (after, u_after), past in _by_name(now, before):
        was, u_was = past[0] * scale**2, None if past[1] is None else past[1] * scale**2
        change = after - was
        half = None if u_after is None or u_was is None else K * float(np.hypot(u_after, u_was))
        low, high = (None, None) if half is None else (change - half, change + half)
        rows.append(
            {"name": name, "before": was, "after": after, "change": change, "change_low": low, "change_high": high}
        )
    return rows


Area = tuple[float, float | None]  # and its standard uncertainty, where it was measured


def _by_name(now: Subject, before: Subject) -> list[tuple[str, Area, Area]]:
    """Names of the classes of either epoch, their area now and before; void is none."""
    found = [{s.names.get(c, str(c)): c for c in s.class_ids()} for s in (now, before)]
    names = list(dict.fromkeys([*found[0], *found[1]]))
    areas_ = [[_area(s, ids.get(name)) for name in names] for s, ids in zip((now, before), found)]
    return list(zip(names, *areas_))


def _area(subject: Subject, class_id: int | None) -> Area:
    if class_id is None:
        return 0.0, 0.0
    row = subject.measures.get(class_id)
    if row is None:
        return subject.area(class_id), None
    return row["area"], (row["area_high"] - row["area"]) / K  # the lower end is never below 0


def distance_colors(distance: np.ndarray, unit: str) -> tuple[np.ndarray, list[Entry]]:
    """Colours (N, 3) uint8 of distances (N,) from blue (less) over white to red (more), and their legend; the scale ends
    where 98 % of them lie."""
    from matplotlib import colormaps  # only where distances are drawn: it takes long

    found = distance[np.isfinite(distance)]
    reach = max(float(np.quantile(np.abs(found), 0.98)), 1e-9)
    ramp = colormaps["RdBu_r"]
    shown = ramp(np.nan_to_num(distance) / reach / 2 + 0.5)[:, :3]
    shown[~np.isfinite(distance)] = NOTHING
    legend = [
        Entry(("+" if share > 0 else "") + length(reach * share, unit), tuple(ramp(share / 2 + 0.5)[:3]))
        for share in np.linspace(1, -1, STEPS).tolist()
    ]
    return (shown * 255).round().astype(np.uint8), [*legend, Entry("nothing to compare with", NOTHING)]


def length(value: float, unit: str) -> str:
    """A length in words: millimetres where the unit is "m", else scene units."""
    return f"{significant(1000 * value)} mm" if unit == "m" else f"{significant(value)} units"


def write_distances(path: Path, surface: Surface, distance: np.ndarray, colors: np.ndarray) -> Path:
    """Write the mesh as PLY with the float attribute `distance` of each vertex (NaN: nothing to compare with). Raises
    DiskError."""
    import trimesh  # the library takes its time to load
    from trimesh.exchange.ply import export_ply

    mesh = trimesh.Trimesh(
        surface.vertices,
        surface.faces,
        vertex_colors=colors,
        vertex_attributes={"distance": distance.astype(np.float32)},
        process=False,
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(export_ply(mesh))
    return path


def draw_distances(
    folder: Path,
    subject: Subject,
    colors: np.ndarray,
    legend: list[Entry],
    note: str,
    params: CompareParams,
    report: Reporter,
) -> list[Path]:
    """Draw the distances as seen from some sides, with a note below; the files."""
    shown, files = replace(subject.surface, colors=colors), []
    for name in params.views:
        report.progress(params.views.index(name) / len(params.views), name)
        view = projection(name)
        found = view(shown.vertices)
        window, scale = framed(found[:, :2], params.scale, subject.metric)
        seen = picture(shown, None, view, window, float(found[:, 2].max()) + window.pixel, report)
        title, axes = f"{subject.title}: change, {name}", axis_names(view, 0)
        sheet = Sheet(
            title,
            window.low,
            window.high,
            scale,
            subject.metric,
            seen.color,
            axes,
            legend,
            "Distance from the earlier surface",
            note=note,
        )
        files += write_sheet(folder / f"distance_{name}", sheet, report.check)
    return files
