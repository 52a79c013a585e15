"""The mesh of all blocks on disk, in the world: exports/blocks of the whole capture's project."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..data.load import load_scene
from ..data.scene import Scene
from ..errors import TrainingError
from ..files import atomic_path
from ..geometry.similarity import similarity_scale, transform_points
from ..images.encode import write_picture
from ..kernels.closest import ClosestPoints
from ..mesh.build import not_refuted
from ..mesh.features import features_of
from ..mesh.instances import (
    GAP,
    find_instances,
    with_earlier_joins,
    with_earlier_names,
    with_earlier_numbers,
    write_instances,
    write_kept,
)
from ..mesh.lods import level_files, make_levels, write_level
from ..mesh.outputs import Places
from ..mesh.painted import training_photos, unwrapped
from ..mesh.parts import texture_of
from ..mesh.photo_texture import photo_texture, prepare
from ..mesh.stored import MESH, TEXTURE
from ..mesh.surface import Surface, class_table, to_world, with_faces
from ..mesh.triangles import area_share
from ..mesh.turntable import look_around, write_pictures
from ..mesh.verb import earlier_instances
from ..params import BlocksParams
from ..progress import Reporter
from ..project.fingerprints import alignment, write_made
from ..project.label_revision import map_revision
from ..project.runs import MEASURES, MESH_RECORD, SCENE_GRAPH, read_metrics, run_folder
from ..project.schema import step
from ..project.store import load_project, world_from_marks
from ..project.written import remove_former
from .join import joined, open_at_seams
from .plan import RUN, Plan, block_folder
from .surface import load_part

UNSEEN = "texture_unseen.png"
NAME = "blocks"  # folder in exports


def write_whole(folder: Path, plan: Plan, params: BlocksParams, report: Reporter) -> dict[str, Any]:
    """Join the surfaces of all blocks, number the instances over all of them, paint it from the photos if asked for, and write
    the mesh, which other verbs know as that of the run “blocks”. Nothing that was there is changed before all is made; names
    and joins of instances that were made by hand stay.

    Returns:
        {"blocks": [{"name", "photos", "psnr_train", "faces"}], "vertices", "faces", "open_at_seams": edges, "voxel",
        "unseen": the share of its area that fills small holes, "denied": the share that was left out, as photos disagree on
        it, "classes", "instances", "label_revision": of the marks that label maps are from, or None, "lods": [{"faces",
        "deviation"}], "files"}; with a texture "painted_by_photos"
    Raises:
        ProjectError, SettingError, TrainingError, DiskError, Cancelled.
    """
    from ..mesh.files import write_surface  # with its libraries, a quarter of a second

    report.stage("Joining the blocks")
    project = load_project(folder)
    inputs = {"alignment": alignment(project)}
    parts = [load_part(folder, block) for block in plan.blocks]
    common, filled = joined(parts)
    open_edges = open_at_seams(common, parts)
    scene, voxel = load_scene(folder, params.holdout), parts[0].voxel * similarity_scale(plan.world_from_common)
    kept, share = not_refuted(transform_points(plan.world_from_common, common.vertices), common.faces, scene, report)
    if not kept.any():
        raise TrainingError("The masks leave out all of the surface.", "Check the masks of the project.")
    common, filled = with_faces(common, kept), filled[kept]
    surface = to_world(common, plan.world_from_common)
    names = {scene.ignore_id: "void"} | {c.id: c.name for c in scene.classes}
    numbers, instances = find_instances(
        surface.vertices, surface.faces, surface.face_class, names, scene.ignore_id, GAP * voxel
    )
    target, out = folder / "exports" / NAME, params.out.absolute() if params.out else None
    earlier = earlier_instances(target, project, names)
    numbers, instances = with_earlier_joins(numbers, instances, earlier)
    numbers, instances = with_earlier_numbers(numbers, with_earlier_names(instances, earlier), earlier)
    surface = replace(surface, face_instance=numbers)
    painted = None if params.texture is None else paint(common, plan, scene, params.texture, report)
    texture = None if painted is None else texture_of(surface.faces, painted.uv, painted.image)
    levels = make_levels(surface, texture, params.lods, report)
    pictures: dict[str, np.ndarray] = {}
    if params.turntable is not None:
        report.stage("Looking at it")
        pictures = look_around(surface, texture, {c.id: c.color for c in scene.classes}, report)
    rows = [_row(folder, plan, number, len(part.surface.faces)) for number, part in enumerate(parts)]
    report.stage("Writing")
    revision = map_revision(load_project(folder))
    features = features_of(surface, scene.classes, scene.ignore_id, instances, revision)
    with Places() as places:
        here = places.waiting(target)
        there = here if out is None else places.waiting(out.parent)
        files = _write_arrays(here, surface, filled, painted) + [write_instances(here, instances)]
        write_kept(here, [], world_from_marks(project))
        files += write_surface(here / "mesh.ply", surface, features, "none", check=report.check)
        if out is not None:
            files += write_surface(there / out.name, surface, features, "none", texture, check=report.check)
        for number, level in enumerate(levels, 1):
            files += write_level(here, number, level, report.check)
            if out is not None:
                features = features_of(level.surface, scene.classes, scene.ignore_id, instances, revision)
                path = there / f"{out.stem}_lod{number}{out.suffix}"
                files += write_surface(path, level.surface, features, "none", level.texture, check=report.check)
        if params.turntable is not None:
            files += write_pictures(places.waiting(params.turntable), pictures, report)
        report.check()
        # From here on nothing stops it. What these say is no longer true, and what has no successor goes.
        written = {path.name for path in files if path.parent == here}
        for path in [target / MESH_RECORD, target / MEASURES, target / SCENE_GRAPH, *level_files(target)]:
            path.unlink(missing_ok=True)
        for name in {TEXTURE, UNSEEN} - written:
            (target / name).unlink(missing_ok=True)
    files = places.goals(files)
    if out is not None:
        remove_former(load_project(folder), "blocks", out, files)
    result = {
        "blocks": rows,
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "open_at_seams": open_edges,
        "voxel": voxel,
        "unseen": round(area_share(surface.vertices, surface.faces, filled), 4),
        "denied": round(share, 4),
        "classes": class_table(surface, names),
        "instances": len(instances),
        "label_revision": revision,
        "lods": [{"faces": len(level.surface.faces), "deviation": level.deviation} for level in levels],
        "files": [str(path) for path in files],
    }
    if painted is not None:
        result["painted_by_photos"] = round(painted.seen, 4)
    write_made(target / MESH_RECORD, step("blocks", params.model_dump(mode="json"), result, inputs))
    return result


@dataclass(frozen=True)
class Paint:
    """uv (F, 3, 2) of the faces' corners; image (S, S, 3) uint8 sRGB; unseen (S, S) uint8, 255 where no photo painted; seen:
    the share of the surface that one did."""

    uv: np.ndarray
    image: np.ndarray
    unseen: np.ndarray
    seen: float


def paint(surface: Surface, plan: Plan, scene: Scene, size: int | Literal["auto"], report: Reporter) -> Paint:
    """A texture of the photos for the whole surface, in the frame that blocks share; what no photo shows has the colours of the
    vertices.

    Raises:
        SettingError: no memory for the texture. TrainingError: the mesh cannot be unwrapped.
    """
    photos = training_photos(scene, np.linalg.inv(plan.world_from_common))
    uv = unwrapped(surface.vertices, surface.faces, photos, size, report)
    prepared = prepare(surface.vertices, surface.faces, uv.corners, photos, uv.size, report)
    closest = ClosestPoints(surface.vertices, surface.faces)

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        report.check()
        face, weights, _ = closest.find(points)
        mixed = (surface.colors[surface.faces[face]] * weights[..., None]).sum(1)
        return (mixed + 0.5).clip(0, 255).astype(np.uint8)

    made = photo_texture(prepared, color, report)
    return Paint(uv.corners, made.image, made.unseen, made.seen)


def _write_arrays(folder: Path, surface: Surface, filled: np.ndarray, painted: Paint | None) -> list[Path]:
    """mesh.npz, with the triangles (F,) that fill small holes as unseen, and the texture if there is one."""
    arrays = {**vars(surface), "unseen": filled} | ({} if painted is None else {"uv": painted.uv})
    with atomic_path(folder / MESH) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)
    written = [folder / MESH]
    if painted is not None:
        for name, picture in ((TEXTURE, painted.image), (UNSEEN, painted.unseen[..., None])):
            with atomic_path(folder / name) as temporary:
                write_picture(temporary, picture)
            written.append(folder / name)
    return written


def _row(folder: Path, plan: Plan, number: int, faces: int) -> dict[str, Any]:
    block = plan.blocks[number]
    trained = read_metrics(run_folder(block_folder(folder, block), RUN)).get("train", {})
    return {
        "name": block.name,
        "photos": len(block.images),
        "psnr_train": trained.get("psnr_train"),
        "faces": faces,
    }
