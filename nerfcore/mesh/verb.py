"""The verb `mesh`: the labelled surface, as arrays for Blender and as PLY, OBJ, GLB or STL for everybody else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data.box import Box
from ..data.load import class_inputs, load_scene, view_inputs
from ..data.scene import Scene
from ..errors import ProjectError
from ..files import require_writable
from ..geometry.similarity import similarity_scale
from ..images.picture import to_bytes
from ..params import MeshParams
from ..progress import Reporter
from ..project.fingerprints import (
    Earlier,
    Fingerprint,
    alignment,
    compare,
    digest,
    moved,
    read_made,
    rounded,
    write_made,
)
from ..project.runs import MESH_RECORD, checkpoint_id, state_id
from ..project.schema import Project, step
from ..project.store import load_project, record_step, world_from_marks
from ..render.run import Trained, load_info, load_trained, scene_as_trained
from ..verdict import mesh_verdict
from .build import Built, build, largest_share, wanted_bounds, wanted_region, wanted_sides
from .coverage import coverage
from .field_values import shade
from .formats import check_format
from .instances import (
    GAP,
    Instance,
    find_instances,
    read_instances,
    read_known,
    with_class_names,
    with_earlier_joins,
    with_earlier_names,
    with_earlier_numbers,
)
from .lods import make_levels
from .outputs import Made, write_outputs
from .painted import Painted, paint_surface, training_photos
from .parts import texture_of
from .photo_texture import check_memory
from .photos import Photo
from .preview import preview
from .shown import shown_share, silhouette
from .surface import Surface, class_table, is_watertight, to_world
from .triangles import area_share
from .turntable import look_around


def mesh(params: MeshParams, report: Reporter) -> dict[str, Any]:
    """Extract the surface of a run and write it to exports/<run>/ (and to `out`), in world units.

    Returns:
        {"vertices", "faces", "watertight", "voxel": in world units, "classes": {name: {"faces", "area"}},
        "instances": how many, "lods": [{"faces", "deviation": in world units}],
        "label_revision": of the marks that the classes are from, or None, "files"};
        "texture": its size in pixels, or None;
        "shown": the share of the photos' pixels that show the mesh; "solid_shown", "holes",
        "overlap_shown" and "seen_by_few": see `coverage.Coverage` (solid, holes, overlapped, few); "verdict";
        "silhouette" of a capture with masks: see `shown.silhouette`;
        for a preview see `preview.preview`;
        "unseen": the share of its area that closes small holes or gaps, or that fewer than two photos see of a watertight
        one; "denied": the share of the area that photos disagree on, which is left out;
        with a texture of photos "painted_by_photos", the share of its texels that a photo shows
    Raises:
        SettingError: unknown format, impossible region, or no memory for the texture. ProjectError, TrainingError, DiskError.
    """
    if params.preview:
        return preview(params, report)
    folder = Path(params.project)
    if params.out is not None:
        check_format(params.out)
        require_writable(params.out)
        params = params.model_copy(update={"out": params.out.absolute()})
    if params.turntable is not None:
        require_writable(params.turntable / "color_0.png")
    if isinstance(params.texture, int):
        check_memory(params.texture)
    project, trained = load_project(folder), load_trained(folder, params.run)
    scene = scene_as_trained(folder, params.run, trained.info)
    inputs = mesh_inputs(params)
    built = build(trained, project, scene, params, report)
    target = folder / "exports" / params.run
    box = trained.info.box(project)
    photos = training_photos(scene, box.box_from_world)
    painted = paint(trained, built, photos, params, scene.ignore_id, report)
    texture = None
    if painted.uv is not None and painted.image is not None:
        texture = texture_of(built.faces, painted.uv.corners, painted.image)
    classes = painted.classes
    plain = Surface(built.vertices, built.faces, built.normals, built.colors, classes.class_id, classes.face_class)
    surface = to_world(plain, box.world_from_box)
    names = {scene.ignore_id: "void"} | {c.id: c.name for c in scene.classes}
    voxel = built.region.voxel * similarity_scale(box.world_from_box)
    face_instance, instances = find_instances(
        surface.vertices, surface.faces, surface.face_class, names, scene.ignore_id, GAP * voxel
    )
    earlier = earlier_instances(target, project, names)
    beyond = beyond_region(earlier, wanted_region(params, scene))
    face_instance, instances = with_earlier_joins(face_instance, instances, earlier)
    instances = with_earlier_names(instances, earlier, [one.name for one in beyond])
    face_instance, instances = with_earlier_numbers(face_instance, instances, earlier)
    surface = replace(surface, face_instance=face_instance)
    levels = make_levels(surface, texture, params.lods, report)
    judged = judge(trained, scene, box, built, surface, photos, params, report)
    colors = {c.id: c.color for c in scene.classes}
    pictures: dict[str, np.ndarray] = {}
    if params.turntable is not None:
        report.stage("Looking at it")
        pictures = look_around(surface, texture, colors, report, painted.maps.ids if painted.maps else None)
    revision = trained.info.label_revision
    known = {one.name for one in instances}
    beyond = [one for one in beyond if one.name not in known]
    made = Made(
        surface,
        texture,
        painted,
        built,
        box,
        instances,
        beyond,
        world_from_marks(project),
        levels,
        pictures,
        revision,
    )
    report.stage("Writing")
    files = write_outputs(target, made, scene, params, report)
    result = {
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "watertight": is_watertight(surface.faces),
        "voxel": voxel,
        "classes": class_table(surface, names),
        "instances": len(instances),
        "lods": [{"faces": len(level.surface.faces), "deviation": level.deviation} for level in levels],
        "label_revision": revision,
        "texture": None if painted.image is None else len(painted.image),
        "files": [str(path) for path in files],
        **judged,
    }
    if painted.seen is not None:
        result["painted_by_photos"] = round(painted.seen, 4)
    settings = params.model_dump(mode="json")
    write_made(target / MESH_RECORD, step("mesh", settings, result, inputs, state_id(trained.state)))
    record_step(folder, "mesh", settings, result, inputs)
    return result


def earlier_instances(target: Path, project: Project, names: Mapping[int, str]) -> list[Instance]:
    """The instances that are known of the mesh that is there, where they lie in the world now, by the present `names` of the
    classes; none where they cannot be read."""
    made = read_made(target / MESH_RECORD)
    if made is None:
        return []
    try:
        known = read_known(target, world_from_marks(project))
        if known is None:  # of an earlier version
            known = [] if moved(made, project) else read_instances(target)
        return with_class_names(known, set(made.result.get("classes", {})) - set(names.values()), names)
    except ProjectError:  # it is written anew
        return []


def beyond_region(instances: list[Instance], region: tuple[np.ndarray, np.ndarray] | None) -> list[Instance]:
    """Those whose middle lies outside of a region of the world, between two corners (3,)."""
    if region is None:
        return []
    low, high = region
    return [one for one in instances if not ((low <= one.center) & (one.center <= high)).all()]


def judge(
    trained: Trained,
    scene: Scene,
    box: Box,
    built: Built,
    surface: Surface,
    photos: list[Photo],
    params: MeshParams,
    report: Reporter,
) -> dict[str, Any]:
    """What photos say of a surface: "shown", "solid_shown", "holes", "overlap_shown", "seen_by_few", "unseen", "denied", "verdict"
    and "silhouette" of `mesh`."""
    report.stage("Comparing it with the photos")
    scene = scene.unseen_by(trained.info.images)
    shown = shown_share(photos, built.vertices, built.faces, report.check)
    bounds, sides = wanted_bounds(params, scene, box), wanted_sides(params, scene, box)
    found = coverage(trained.model, scene, box.box_from_world, built.vertices, built.faces, bounds, report.check, sides)
    solid, overlapped = (None if share is None else round(share, 4) for share in (found.solid, found.overlapped))
    largest, _ = largest_share(built.vertices, built.faces)
    result: dict[str, Any] = {"shown": round(shown, 4), "solid_shown": solid, "holes": round(found.holes, 4)}
    result |= {"overlap_shown": overlapped, "seen_by_few": round(found.few, 4)}
    guessed = guess_share(built)
    asked = 0.0 if params.watertight else guessed if params.close_gaps else None
    hit = shown if bounds is None or solid is None else None  # a region may be little of what photos show
    result["verdict"] = mesh_verdict(
        hit, found.solid, found.holes, largest, found.overlapped, found.few, asked, built.denied
    )
    result |= {"unseen": round(guessed, 4), "denied": round(built.denied, 4)}
    outlines = silhouette(scene, surface.vertices, surface.faces, report.check, wanted_region(params, scene))
    return result if outlines is None else {**result, "silhouette": round(outlines, 4)}


def guess_share(built: Built) -> float:
    """Share of the area of a surface that is marked as unseen."""
    return 0.0 if built.unseen is None else area_share(built.vertices, built.faces, built.unseen)


def mesh_inputs(params: MeshParams) -> Fingerprint:
    """What a mesh depends on. Raises ProjectError."""
    folder = Path(params.project)
    info = load_info(folder, params.run)
    scene = load_scene(folder, info.holdout)
    settings = params.model_dump(mode="json", exclude={"project", "run", "out", "preview"})
    # Defaults are left out, as in records that knew no others. Surfaces come from rendered depth maps.
    if not settings["close_gaps"]:
        del settings["close_gaps"]
    rendering = [changed] if (changed := info.config.render.model_dump(mode="json", exclude_defaults=True)) else []
    out = str(params.out.absolute()) if params.out else None
    return {
        "trained field": checkpoint_id(folder, params.run),
        "alignment": alignment(load_project(folder)),
        "classes": class_inputs(scene),
        "settings": digest([settings, out, *rendering]),
        "region": digest(None if scene.bounds is None else rounded(scene.bounds)),
        **view_inputs(scene, scene.train, files=True),
    }


def meshed(params: MeshParams) -> Earlier:
    """The mesh that is there, if it is of the present field and settings."""
    target = Path(params.project) / "exports" / params.run
    made = read_made(target / MESH_RECORD)
    if made is None:
        return Earlier()
    # The project may have been moved since; a file of the user's choice is where it was.
    known = [Path(file) for file in made.result.get("files", [])]
    files = [target / f.name if f.parent.parts[-2:] == target.parts[-2:] else f for f in known]
    made.result["files"] = [str(path) for path in files]
    return compare(made, mesh_inputs(params), files)


def paint(
    trained: Trained, built: Built, photos: list[Photo], params: MeshParams, void: int, report: Reporter
) -> Painted:
    """Texture and classes for a surface in the normalised frame; what photos do not say is read from the field."""
    model, voxel = trained.model, built.region.voxel

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return to_bytes(shade(model, points, normals, False, voxel, lambda _: report.check())[0])

    def probabilities(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        found = shade(model, points, normals, True, voxel, lambda _: report.check())[1]
        assert found is not None
        return found

    ids = trained.info.class_ids if model.field.classes else []
    return paint_surface(
        built.vertices,
        built.faces,
        built.colors,
        photos,
        params.texture,
        params.texture_kind,
        ids,
        void,
        color,
        probabilities if ids else None,
        report,
        not params.watertight,
    )
