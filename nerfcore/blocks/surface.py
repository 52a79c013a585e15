"""The surface of one block: the depth maps that see it fused on the grid of all, and of it what lies in the block's core.

Near a seam both neighbours fuse the same maps on the same grid, so that they get the same triangles there, to the bit: cut
between the cells of the grid, their meshes meet vertex by vertex. Maps that say nothing of a block (`sights`) change nothing in
it, and are not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..data.pixels import PixelStore
from ..data.scene import Scene, View
from ..errors import ProjectError, TrainingError
from ..files import UNREADABLE_ARRAYS, atomic_path
from ..geometry.similarity import similarity_scale, transform_points
from ..kernels.depth_arrays import MapArrays
from ..kernels.device import use_device
from ..mesh.appearance import Photos
from ..mesh.build import Built, agreed_maps, fitted, read_photos, vertex_colors
from ..mesh.clean import shown
from ..mesh.decimate import decimate_patches
from ..mesh.denoise import denoised
from ..mesh.depth_maps import MOST_VIEWS, FlatView, flat_views, map_size, spread_views
from ..mesh.extract import extract
from ..mesh.fusion import BRICK, NEAR, TRUNCATION, WIDER, fuse_maps, grid_of, is_soft, tolerances
from ..mesh.painted import training_photos
from ..mesh.photometric import Pictures, pictures_of, without_unknown
from ..mesh.region import Region, region_around
from ..mesh.surface import Surface, to_world, vertex_normals, with_faces
from ..mesh.triangles import compact
from ..mesh.verb import paint
from ..params import MeshParams
from ..progress import Reporter
from ..project.runs import run_folder
from ..project.store import load_project
from ..render.run import Trained, load_trained, scene_as_trained
from .maps import cut_maps, joined_maps, load_maps, moved, save_maps
from .plan import MAPS, PART, RUN, SIGHTS, BlockPlan, Plan, block_folder
from .sights import Sights, chosen, load_sights, save_sights, sights_of

FADE = 16  # voxels from a seam, where vertices stay where they are, to where noise is taken off as it is elsewhere
BEYOND = 0.5  # how far beyond the blocks surfaces are looked for at most, in the shared frame, which is 2 wide


@dataclass(frozen=True)
class Part:
    """A block's surface in the frame that all blocks share; `seams` (S, 2) axis and place of the planes it was cut at;
    `voxel` of the grid."""

    surface: Surface
    seams: np.ndarray
    voxel: float


def make_maps(folder: Path, plan: Plan, block: BlockPlan, report: Reporter) -> int:
    """Render the depth maps of a trained block, correct them by its photos, and keep them in the shared frame: how many.

    Raises:
        ProjectError, TrainingError, DiskError.
    """
    own = block_folder(folder, block)
    trained, project = load_trained(own, RUN), load_project(own)
    box = trained.info.box(project)
    _, _, maps = agreed_maps(trained, scene_as_trained(own, RUN, trained.info), box, report)
    common_from_world = np.linalg.inv(plan.world_from_common)
    maps = moved(maps, common_from_world @ box.world_from_box)
    reach = _corners(common_from_world, plan.reach(block))
    maps = cut_maps(maps, reach, _corners(common_from_world, plan.whole))
    save_sights(run_folder(own, RUN) / SIGHTS, sights_of(maps, limit_of(plan)))
    save_maps(run_folder(own, RUN) / MAPS, maps)
    return len(maps)


def make_part(
    folder: Path, plan: Plan, block: BlockPlan, resolution: int, faces: int | None, report: Reporter
) -> dict[str, Any]:
    """Mesh a block's core, with the classes and colours of its photos.

    Args:
        resolution: cells along the longest side of a block. faces: triangles at most, where the seams allow.
    Returns:
        {"vertices", "faces", "maps": how many were fused, "of": how many all blocks have, "read": names of the blocks whose maps
        were read}
    Raises:
        ProjectError, TrainingError, DiskError.
    """
    own = block_folder(folder, block)
    trained, project = load_trained(own, RUN), load_project(own)
    scene = scene_as_trained(own, RUN, trained.info)
    report.stage("Fusing")
    device = use_device()
    sights = [load_sights(run_folder(block_folder(folder, b), RUN) / SIGHTS) for b in plan.blocks]
    region = shared_region(load_project(folder).frame.bounds, plan, sights, resolution)
    heard = [seen.speak_of(*part_box(region, plan, block, sights)) for seen in sights]
    read = {b.name: load_maps(run_folder(block_folder(folder, b), RUN) / MAPS, device)
            for b, keep in zip(plan.blocks, heard) if keep.any() or b is block}  # fmt: skip
    maps = joined_maps([chosen(read[b.name], keep) for b, keep in zip(plan.blocks, heard) if keep.any()])
    vertices, triangles, inside, seams = core_surface(maps, region, plan, block, report, sights)
    if not inside.any():
        raise TrainingError(f"Block {block.name} has no surface.", "Train longer, or cut into fewer blocks.")
    if faces is not None and inside.sum() > faces:
        report.stage("Simplifying")
        target = round(faces * len(triangles) / inside.sum())
        vertices, triangles, inside = decimate_patches(vertices, triangles, inside.astype(np.int64), target, report)
        inside = inside.astype(bool)
    free = away_from(seams, vertices, FADE * region.voxel)
    vertices = denoised(vertices, triangles, maps.depth.device, report, free)
    box = trained.info.box(project)
    box_from_common = box.box_from_world @ plan.world_from_common
    views = spread_views([scene.views[i] for i in scene.train], MOST_VIEWS)
    flats = pictures_shown(read[block.name], views, box.box_from_world, run_folder(own, RUN) / MAPS)
    store = read_photos(trained, scene, views, box, report)
    pictures = pictures_of(flats, store, moved(read[block.name], box_from_common), report)
    points = transform_points(box_from_common, vertices)
    step = fitted(points, triangles, without_unknown(pictures), report, free) - points
    vertices = vertices + step / similarity_scale(box_from_common)
    made = _painted(trained, own, scene, store, pictures, vertices, triangles, region, box_from_common, report)
    # At a seam, vertices of neighbours are the same to the bit; those of `made` went to the box and back.
    exact = replace(to_world(made, np.linalg.inv(box_from_common)), vertices=vertices.astype(np.float32))
    part = Part(with_faces(exact, inside), seams, region.voxel)
    save_part(run_folder(own, RUN) / PART, part)
    counts = {"vertices": len(part.surface.vertices), "faces": len(part.surface.faces)}
    return {**counts, "maps": len(maps), "of": sum(map(len, heard)), "read": list(read)}


def pictures_shown(maps: MapArrays, views: list[View], box_from_world: np.ndarray, path: Path) -> list[FlatView]:
    """The pictures that a block's depth maps, read from `path`, are of: a GPU makes larger ones than a CPU, and blocks of a cluster are not
    meshed where their maps were made. Raises ProjectError: the maps are not of these photos."""
    for kind in ("cpu", "cuda"):
        flats = flat_views(views, box_from_world, map_size(views, torch.device(kind)))
        if [[flat.camera.width, flat.camera.height] for flat in flats] == maps.size.tolist():
            return flats
    raise ProjectError(
        f"{path} holds depth maps of another size than the photos have.", "Remove it and run `fieldwork blocks` again."
    )


def away_from(seams: np.ndarray, vertices: np.ndarray, distance: float) -> np.ndarray:
    """How far vertices (V, 3) are from the nearest of the planes (S, 2), axis and place: (V,) from 0 on it to 1 at `distance`
    and beyond. Neighbours so have one vertex in one place at their seam."""
    near = np.full(len(vertices), distance)
    for axis, place in seams:
        near = np.minimum(near, np.abs(vertices[:, int(axis)] - place))
    return near / distance


def limit_of(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of the space in which surfaces are looked for at most, in the shared frame."""
    low, high = _corners(np.linalg.inv(plan.world_from_common), plan.whole)
    return low - BEYOND, high + BEYOND


def shared_region(bounds: list[list[float]] | None, plan: Plan, sights: Sequence[Sights], resolution: int) -> Region:
    """Where surfaces are looked for in the shared frame, the same for each block: `bounds` (corners in the world), else
    what the maps of all blocks show."""
    common_from_world = np.linalg.inv(plan.world_from_common)
    inner = None if bounds is None else _corners(common_from_world, (np.array(bounds[0]), np.array(bounds[1])))
    whole = np.array(plan.high) - np.array(plan.low)
    widest = max(float((np.array(block.high) - np.array(block.low)).max()) for block in plan.blocks)
    limit, hits = limit_of(plan), np.concatenate([seen.hits for seen in sights])
    hits = hits[((hits >= limit[0]) & (hits <= limit[1])).all(1)]
    sizes = np.concatenate([seen.sizes for seen in sights])
    found = region_around(
        hits, lambda: float(np.median(sizes)), inner, max(1, round(resolution * float(whole.max()) / widest))
    )
    return replace(found, low=np.maximum(found.low, limit[0]), high=np.minimum(found.high, limit[1]))


def part_box(
    region: Region, plan: Plan, block: BlockPlan, sights: Sequence[Sights]
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """What `Sights.speak_of` is asked for a block: corners (3,) of the part of the grid that it computes, how far behind a
    surface maps are heard, and room for what they mark and what is looked up in them. `sights`: of all blocks."""
    origin, counts = grid_of(region)
    brick, truncation = BRICK * region.voxel, TRUNCATION * region.voxel
    if is_soft([seen.spread for seen in sights], region.voxel):
        truncation *= WIDER
    first, end = _bricks(_corners(np.linalg.inv(plan.world_from_common), plan.reach(block)), origin, brick, counts)
    return origin + brick * first, origin + brick * (end + 1), truncation, 1.5 * truncation + NEAR * region.voxel


def core_surface(
    maps: MapArrays,
    region: Region,
    plan: Plan,
    block: BlockPlan,
    report: Reporter,
    sights: Sequence[Sights],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The surface of a block and of its overlap with others, in the shared frame: vertices (V, 3), triangles (F, 3), which
    of them (F,) bool are in the core, and the planes (S, 2) between it and its neighbours: axis, place.

    Args:
        maps: those of all blocks that speak of this one, in the order of the blocks. sights: of all blocks.
    """
    origin, counts = grid_of(region)
    common_from_world, brick = np.linalg.inv(plan.world_from_common), BRICK * region.voxel
    low, high = _bricks(_corners(common_from_world, plan.core(block)), origin, brick, counts)
    first, end = _bricks(_corners(common_from_world, plan.reach(block)), origin, brick, counts)
    # A cell at the far side of a brick needs corners of the next one.
    focal = min(float(seen.focal) for seen in sights)
    bricks = fuse_maps(maps, region, report, (first, end + 1), focal, [seen.spread for seen in sights])
    report.stage("Extracting the surface")
    vertices, faces = extract(bricks, report)
    if len(faces):
        tolerance = tolerances(bricks, vertices, faces, TRUNCATION * region.voxel)
        vertices, faces = compact(vertices, faces[shown(vertices, faces, maps, tolerance, report)])
    place = (vertices[faces].mean(1) - origin) / brick
    shared = np.stack([low > 0, high < counts], 1)
    inside = ((place >= np.where(shared[:, 0], low, -np.inf)) & (place < np.where(shared[:, 1], high, np.inf))).all(1)
    planes = [
        (axis, origin[axis] + brick * at[axis])
        for axis in range(3)
        for at, cut in zip((low, high), shared[axis])
        if cut
    ]
    return vertices, faces, inside, np.array(planes, np.float64).reshape(-1, 2)


def save_part(path: Path, part: Part) -> None:
    """Atomically write a block's surface. Raises DiskError."""
    arrays = {name: value for name, value in vars(part.surface).items() if value is not None}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays, seams=part.seams, voxel=np.float64(part.voxel))


def load_part(folder: Path, block: BlockPlan) -> Part:
    """The surface of a block. Raises ProjectError: there is none, or its file is damaged."""
    path = run_folder(block_folder(folder, block), RUN) / PART
    try:
        with np.load(path, allow_pickle=False) as data:
            surface = Surface(**{f.name: data[f.name] for f in fields(Surface) if f.name in data})
            return Part(surface, data["seams"], float(data["voxel"]))
    except FileNotFoundError as error:
        raise ProjectError(f"{path} is missing.", "Run `fieldwork blocks` again.") from error
    except (*UNREADABLE_ARRAYS, KeyError, TypeError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Remove it and run `fieldwork blocks` again.") from error


def _painted(
    trained: Trained,
    folder: Path,
    scene: Scene,
    store: PixelStore,
    pictures: Pictures,
    vertices: np.ndarray,
    faces: np.ndarray,
    region: Region,
    box_from_common: np.ndarray,
    report: Reporter,
) -> Surface:
    """A surface of the shared frame in a block's box, with the colours and classes that the block's photos show."""
    box = trained.info.box(load_project(folder))
    report.stage("Reading colours")
    scale = similarity_scale(box_from_common)
    own = Region(*_corners(box_from_common, (region.low, region.high)), region.voxel * scale)
    points, faces = transform_points(box_from_common, vertices).astype(np.float32), faces.astype(np.int32)
    normals = vertex_normals(points, faces)
    photos = Photos(store, pictures.maps, np.array([flat.photo for flat in pictures.views]), TRUNCATION * own.voxel)
    colors = vertex_colors(trained.model, own, photos, points, normals, report)
    built = Built(points, faces, normals, colors, own, (points[:0], faces[:0]))
    posed = training_photos(scene, box.box_from_world)
    params = MeshParams(project=folder, run=RUN)
    classes = paint(trained, built, posed, params, scene.ignore_id, report).classes
    return Surface(points, faces, normals, colors, classes.class_id, classes.face_class)


def _corners(matrix: np.ndarray, box: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The corners (3,) of a box moved by a similarity without a turn; what is infinite stays so."""
    scale, shift = np.diag(matrix)[:3], matrix[:3, 3]
    return np.asarray(box[0]) * scale + shift, np.asarray(box[1]) * scale + shift


def _bricks(
    box: tuple[np.ndarray, np.ndarray], origin: np.ndarray, brick: float, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The bricks (3,) nearest to the corners of a box."""
    low, high = ((np.clip((corner - origin) / brick, 0, counts)).round().astype(int) for corner in box)
    return low, high
