"""The verb `measure`: areas, volumes and distances of a mesh, each with its uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..data.scene import Scene
from ..files import write_json
from ..mesh.facelets import Facelets, facelets
from ..mesh.instances import Instance, read_instances
from ..mesh.painted import LONGEST, training_photos
from ..mesh.photos import Photo
from ..mesh.stored import load_coarse, load_guessed, load_surface, mesh_folder, mesh_record
from ..mesh.surface import Surface
from ..mesh.surface_labels import index_of, view_votes
from ..mesh.visibility import DepthBuffers, in_parallel, observe
from ..params import MeasureParams
from ..progress import Reporter
from ..project.runs import MEASURES
from ..project.store import load_poses, load_project, record_step, world_from_sfm
from ..render.run import load_info, scene_as_trained
from .amounts import Amount, K, Labelled, area_amounts, summed, transferred, volume_amount
from .placing import area_deviations_of_place, u_places
from .resampling import Pieces, Votes, area_deviations
from .scale import EXACT, METRES, Distance, Scale, read_distances, scale_of, u_measured

WHOLE = "whole surface"


@dataclass(frozen=True)
class Sized:
    """How fine a surface is: side of its cells, and (labels (P,) of its pieces, how many labels) → standard uncertainty
    of the place of each label's surface, as `u_places` says it."""

    voxel: float
    u_places: Callable[[np.ndarray, int], np.ndarray]


@dataclass(frozen=True)
class Measured:
    """Amounts of the whole surface, by class and by instance, in their order; None for the volume of what is open. `guesses`:
    what of the whole area, of each class's and of each instance's is a guess."""

    area: Amount
    volume: Amount | None
    areas: list[Amount]
    volumes: list[Amount | None]
    instance_areas: list[Amount]
    instance_volumes: list[Amount | None]
    guesses: tuple[float, list[float], list[float]]


def measure(params: MeasureParams, report: Reporter) -> dict[str, Any]:
    """Measure the mesh of a run and write measures.json beside it.

    Returns:
        {"unit": "m" or "scene units", "scale": {"u_percent", "source", "factor"}, "whole": {"name", "area", "area_low",
        "area_high", "area_guessed", "volume", "volume_low", "volume_high"}, "classes" and "instances": [the same, with "id"], "distances":
        [{"name", "use", "length", "low", "high", "known", "difference"}], "label_revision": of the marks that the mesh's
        classes are from, or None, "file"}; lows and highs are the ends of 95 % intervals, volumes None where a thing is
        open; "area_guessed" is what of the area closes gaps, or a surface that was to be watertight.
    Raises:
        ProjectError: there is no mesh, or the project was aligned anew since. InputError: the file of distances.
    """
    folder = Path(params.project)
    project, poses = load_project(folder), load_poses(folder)
    surface, _ = load_surface(folder, params.run)
    guessed = load_guessed(folder, params.run)
    made = mesh_record(folder, params.run).result
    voxel = float(made["voxel"])
    target = mesh_folder(folder, params.run)
    distances = [] if params.distances is None else read_distances(params.distances, world_from_sfm(project), poses)
    scale = scale_of(project, poses, distances, voxel, params.scale_error)
    if scale.unit != METRES and any(d.known is not None for d in distances):
        report.warn(
            "The scale is not known: distances in metres are held against nothing. Set the scale with "
            "`fieldwork align --scale`, then run `fieldwork mesh` and `fieldwork measure` again."
        )
    if scale.unit != METRES and params.scale_error is not None:
        report.warn("--scale-error is not used: the scale is not known, and sizes are in scene units.")
    if scale.source == EXACT:
        report.warn(
            "Nothing says how sure the scale is: it is taken as exact, and its error is in no interval. Give distances to scale "
            "by (--distances), or how far off it may be (--scale-error)."
        )
    if abs(scale.factor - 1) > K * max(scale.u, 1e-6):
        report.warn(
            f"By the distances to scale by, lengths are {100 * (1 / scale.factor - 1):+.2f} % off: set the scale with "
            "`fieldwork align --scale`, then run `fieldwork mesh` and `fieldwork measure` again."
        )
    info = load_info(folder, params.run)
    scene = scene_as_trained(folder, params.run, info)
    photos = training_photos(scene, np.eye(4))
    instances = read_instances(target)
    coarse, known = load_coarse(folder, params.run), present(surface, scene)
    pieces = facelets(surface.vertices, surface.faces, limit=float(np.ptp(surface.vertices, axis=0).max()) * LONGEST)
    report.stage("Reading label maps")
    votes = gathered_votes(photos, pieces, list(known), report)
    if known and not len(votes.piece):
        report.warn("No photo has a label map: how sure the borders of classes are is not known and not counted.")
    if not known:
        report.note("The mesh has no classes: the whole surface is measured alone.")
    report.stage("Measuring")
    views, longest = [photo.view for photo in photos], info.image_size
    sized = Sized(voxel, partial(u_places, views, pieces.centers, longest=longest))
    measured = amounts(
        surface, pieces, coarse, sized, list(known), instances, votes, guessed, scale.u, params.caps, report
    )
    of_whole, of_classes, of_instances = measured.guesses
    result: dict[str, Any] = {
        "unit": scale.unit,
        "scale": {"u_percent": round(100 * scale.u, 4), "source": scale.source, "factor": round(scale.factor, 6)},
        "whole": {"name": WHOLE, **entries(measured.area, measured.volume, of_whole)},
        "classes": [
            {"id": c, "name": name, **entries(area, volume, guess)}
            for (c, name), area, volume, guess in zip(known.items(), measured.areas, measured.volumes, of_classes)
        ],
        "instances": [
            {"id": i.id, "name": i.name, "class_id": i.class_id, **entries(area, volume, guess)}
            for i, area, volume, guess in zip(
                instances, measured.instance_areas, measured.instance_volumes, of_instances
            )
        ],
        "distances": [distance_entry(d, scale, voxel) for d in distances],
        "label_revision": made.get("label_revision"),
    }
    report.stage("Writing")
    write_json(target / MEASURES, result)
    result["file"] = str(target / MEASURES)
    record_step(folder, "measure", params.model_dump(mode="json"), result)
    return result


def present(surface: Surface, scene: Scene) -> dict[int, str]:
    """Names of the classes on a surface by id; void is none."""
    names = {c.id: c.name for c in scene.classes}
    ids = sorted(set(np.unique(surface.face_class).tolist()) - {scene.ignore_id})
    return {c: names.get(c, str(c)) for c in ids}


def amounts(
    surface: Surface,
    pieces: Facelets,
    coarse: tuple[np.ndarray, np.ndarray],
    sized: Sized,
    class_ids: list[int],
    instances: list[Instance],
    votes: Votes,
    guessed: np.ndarray | None,
    u_scale: float,
    most_capped: float,
    report: Reporter,
) -> Measured:
    """Areas and volumes of a surface, of its classes and of its instances.

    Args:
        pieces: of the surface; coarse: the surface (vertices, faces) at cells of twice the size. votes: for `class_ids`. guessed (F,) bool: triangles that are a guess; None: none is. u_scale: relative uncertainty of lengths.
            most_capped: share of a closed part's area that caps may have.
    """
    of_class = index_of(class_ids)[np.minimum(surface.face_class, max(class_ids, default=0) + 1)]
    of_instance = np.zeros(len(surface.faces), np.int64)
    if surface.face_instance is not None:
        of_instance = positions(surface.face_instance, [i.id for i in instances])
    labels = Pieces(pieces.centers, pieces.areas, of_class[pieces.parent], of_instance[pieces.parent])
    u_class, u_instance = area_deviations(labels, votes, len(instances))
    report.check()
    vertices = surface.vertices.astype(np.float64)
    fine = [Labelled(vertices, surface.faces, label) for label in (np.ones_like(of_class), of_class + 1, of_instance)]
    of_piece = [np.ones_like(labels.label), labels.label + 1, labels.instance]
    rough = transferred(coarse, pieces.centers, of_piece, sized.voxel)
    report.check()
    counts = 2, len(class_ids) + 1, len(instances) + 1
    places = [sized.u_places(label, n) for label, n in zip(of_piece, counts)]
    report.check()
    moved = [area_deviations_of_place(f.vertices, f.faces, f.label, place) for f, place in zip(fine, places)]
    report.check()
    (area,), by_class, by_instance = (
        area_amounts(f.areas(n)[1:], r.areas(n)[1:], u, place[1:], u_scale)
        for f, r, n, u, place in zip(fine, rough, counts, (np.zeros(1), u_class, u_instance), moved)
    )

    def volume(kind: int, number: int, area: Amount) -> Amount | None:
        one = fine[kind].closed(number, most_capped)
        report.check()
        other = rough[kind].closed(number, most_capped)
        report.check()
        return volume_amount(one, other, area.value, sized.voxel, places[kind][number], u_scale)

    volumes = []
    for number, instance in enumerate(instances):
        report.progress(number / len(instances), instance.name)
        volumes.append(volume(2, number + 1, by_instance[number]))
    together = [summed([v for v, i in zip(volumes, instances) if i.class_id == class_id]) for class_id in class_ids]
    guess = np.zeros(len(surface.faces), bool) if guessed is None else guessed
    (whole,), of_classes, of_instances = (
        Labelled(vertices, f.faces[guess], f.label[guess]).areas(n)[1:].tolist() for f, n in zip(fine, counts)
    )
    guesses = whole, of_classes, of_instances
    return Measured(area, volume(0, 1, area), by_class, together, by_instance, volumes, guesses)


def positions(face_instance: np.ndarray, ids: Sequence[int]) -> np.ndarray:
    """The position of each face's instance (F,) among `ids`, counted from 1; 0 for none of them. The ids have gaps where
    instances were joined."""
    position = np.zeros(max([int(face_instance.max(initial=0)), *ids]) + 1, np.int64)
    position[list(ids)] = np.arange(1, len(ids) + 1)
    return position[face_instance.astype(np.int64)]


def gathered_votes(photos: list[Photo], pieces: Facelets, class_ids: list[int], report: Reporter) -> Votes:
    """The votes of all photos with a label map for the pieces that they are among the best to see."""
    classes, index = len(class_ids), index_of(class_ids)
    labelled = [photo for photo in photos if photo.labels is not None]
    if not labelled or not classes:
        return Votes(0, np.zeros(0, int), np.zeros(0, int), np.zeros((0, classes)))
    seen = observe(DepthBuffers([photo.view for photo in labelled], pieces), report)

    def read(number: int) -> tuple[np.ndarray, ...]:
        return view_votes(labelled[number], number, pieces, seen, index, classes)

    found = [(n, face, vote) for n, (face, vote, *_) in in_parallel(read, range(len(labelled)), report, "label maps")]
    photo = np.repeat([n for n, *_ in found], [len(face) for _, face, _ in found])
    return Votes(len(labelled), photo, np.concatenate([f for _, f, _ in found]), np.concatenate([v for *_, v in found]))


def entries(area: Amount, volume: Amount | None, guessed: float) -> dict[str, Any]:
    """An area, of which `guessed` is a guess, and a volume as JSON, with what their uncertainties are made of."""
    row: dict[str, Any] = {}
    for name, amount in (("area", area), ("volume", volume)):
        low, high = (None, None) if amount is None else amount.interval
        row |= {name: None if amount is None else amount.value, f"{name}_low": low, f"{name}_high": high}
    parts = {"scale": area.u_scale, "photos": area.u_photos, "geometry": area.u_geometry, "place": area.u_place}
    row |= {"area_guessed": guessed, "area_u": parts}
    return row


def distance_entry(distance: Distance, scale: Scale, voxel: float) -> dict[str, Any]:
    """A distance as JSON: measured, with its 95 % interval, and beside what is known of it; the difference is None where
    nothing is known, or the scale is not."""
    compared = distance.known is not None and scale.unit == METRES
    length, spread = distance.length, K * u_measured(distance, scale, voxel)
    return {
        "name": distance.name,
        "use": distance.use,
        "length": length,
        "low": max(0.0, length - spread),
        "high": length + spread,
        "known": distance.known,
        "difference": length - (distance.known or 0.0) if compared else None,
    }
