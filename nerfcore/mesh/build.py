"""From a trained field to a coloured surface: depth maps, fusion, extraction, cleaning, decimation, colours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch

from ..data.box import Box, looks_inward
from ..data.pixels import PixelStore
from ..data.scene import Scene, View
from ..errors import SettingError, TrainingError
from ..geometry.similarity import similarity_scale, transform_points
from ..images.picture import to_bytes
from ..kernels.depth_arrays import MapArrays
from ..params import MeshParams
from ..progress import Reporter
from ..project.schema import Project
from ..render.model import Model
from ..render.run import Trained
from ..verdict import LITTLE_IN_ONE
from . import depth_maps as dm
from .appearance import Photos
from .clean import clean, not_scraps
from .closed import closed_surface, unseen_faces
from .cut_outs import left_out
from .decimate import decimate
from .denied import denied
from .denoise import denoised
from .extract import extract
from .field_values import shade
from .fusion import TRUNCATION, Bricks, coarser, fuse_maps, tolerances
from .gaps import close_gaps, open_places
from .photometric import Pictures, moved_by_photos, pictures_of
from .refine import refined_maps
from .region import Region, choose_region, drawn_in, on_sides, sides_of
from .surface import vertex_normals
from .triangles import area_share, areas, compact, components

FEW_STEPS = 300  # of training, below which a field is a sketch
LITTLE_AGREEMENT = 0.3  # share below which the user is told
MUCH_DENIED = 0.05  # share of the area on which photos disagree, from which on the user is told


@dataclass(frozen=True)
class Built:
    """A surface in the normalised frame, and the region in which it was looked for: vertices (V, 3) float32, faces (F, 3)
    int32, normals (V, 3) unit, outward, colors (V, 3) uint8 sRGB; coarse: vertices (V', 3) and faces (F', 3) of the same
    surface at voxels of twice the size, not cleaned; unseen (F,) bool: triangles that close a surface which was asked to
    be watertight, its gaps, or small holes; None without any; denied: share of the area that was left out, as photos disagree
    on it."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    region: Region
    coarse: tuple[np.ndarray, np.ndarray]
    unseen: np.ndarray | None = None
    denied: float = 0.0


def build(trained: Trained, project: Project, scene: Scene, params: MeshParams, report: Reporter) -> Built:
    """The surface of a run.

    Raises:
        TrainingError: fewer than two photos; the views agree on no surface, or there is none in the region.
        SettingError: an impossible region, or `detail` without a known scale.
    """
    box = trained.info.box(project)
    bounds, voxel = wanted_bounds(params, scene, box), wanted_voxel(params, project, box)
    flats, store, maps = agreed_maps(trained, scene, box, report)
    region = choose_region(maps, bounds, params.resolution, voxel)
    region = replace(region, sides=wanted_sides(params, scene, box))
    report.stage("Fusing")
    bricks = fuse_maps(maps, region, report)
    report.stage("Extracting the surface")
    coarse, tolerance = extract(coarser(bricks), report), TRUNCATION * region.voxel
    coarse = denoised(*coarse, maps.depth.device, report), coarse[1]
    unseen, share, pictures = None, 0.0, pictures_of(flats, store, maps, report)
    if params.watertight:
        vertices, faces = closed_surface(bricks, maps, tolerance, params.faces, report)
        vertices = fitted(vertices, faces, pictures, report)
        vertices = vertices if bounds is None else drawn_in(vertices, region)[0]
    else:
        gaps = params.close_gaps / 100 * region.size
        vertices, faces, guessed = open_surface(bricks, maps, tolerance, region, params.faces, gaps, report, pictures)
        if bounds is not None:
            vertices, beyond = drawn_in(vertices, region)
            there = ~beyond[faces].all(1)
            faces, guessed = faces[there], guessed[there]
        kept, share = not_refuted(transform_points(box.world_from_box, vertices), faces, scene, report)
        vertices, faces = compact(vertices, faces[kept])
        unseen = guessed[kept] if guessed.any() else None
    if not len(faces):
        raise no_surface(params)
    check_parts(vertices, faces, report)
    report.stage("Reading colours")
    vertices, faces = vertices.astype(np.float32), faces.astype(np.int32)
    normals = vertex_normals(vertices, faces)
    painted = Photos(store, maps, np.array([flat.photo for flat in flats]), tolerance)
    colors = vertex_colors(trained.model, region, painted, vertices, normals, report)
    if params.watertight:
        unseen = unseen_faces(vertices, faces, maps, tolerance, report)
    return Built(vertices, faces, normals, colors, region, coarse, unseen, share)


def not_refuted(vertices: np.ndarray, faces: np.ndarray, scene: Scene, report: Reporter) -> tuple[np.ndarray, float]:
    """Which triangles (F,) bool stay, of a surface with vertices (V, 3) in the world: not parts on which photos disagree, nor
    what masks leave out; and what share of the area photos disagree on. Raises InputError: a photo or a mask cannot be read."""
    photos = [scene.views[i] for i in scene.train]
    kept = ~denied(vertices, faces, photos, report, scene.mask_mode)
    share = area_share(vertices, faces, ~kept)
    if share > MUCH_DENIED:
        report.warn(
            f"The photos disagree on {100 * share:.0f} % of the surface that the field shows, so that part is left out. "
            "Photos from nearer or from a steeper angle would tell where it is."
        )
    if scene.mask_mode == "empty":
        kept[kept] = ~left_out(vertices, faces[kept], photos, report)
        kept[kept] = not_scraps(vertices, faces[kept])
    return kept, share


def no_surface(params: MeshParams) -> TrainingError:
    """What to say where there is none in the region."""
    if params.detail is not None:
        return TrainingError(
            f"There is no surface in the region {params.region} in cells of {params.detail:g} mm.",
            "Give a smaller `--detail`, or another `--region`.",
        )
    if params.region in ("auto", "photos"):
        return TrainingError("The field has no surface in the region of interest.", "Train longer, or check the box.")
    return TrainingError(
        f"There is no surface in the region {params.region}.",
        "Its corners are in the aligned world, in its units; `photos` looks at all that the photos show.",
    )


def agreed_maps(
    trained: Trained, scene: Scene, box: Box, report: Reporter
) -> tuple[list[dm.FlatView], PixelStore, MapArrays]:
    """Depth maps of the training photos, corrected by these, without what other views do not confirm: the pictures that
    they are of, the pixels of the photos, and the maps in the normalised frame.

    Raises:
        TrainingError: fewer than two photos.
    """
    chosen = [scene.views[i] for i in scene.train]
    if len(chosen) < 2:
        raise TrainingError("A surface needs at least two posed photos.", "Add photos and run `fieldwork poses`.")
    if trained.state["steps"] < FEW_STEPS:
        report.warn(f"The field was trained for {trained.state['steps']} steps only: expect a sketch of the surface.")
    views = dm.spread_views(chosen, dm.MOST_VIEWS)
    flats = dm.flat_views(views, box.box_from_world, dm.map_size(views, trained.device))
    report.stage("Rendering depth maps")
    rendered = dm.depth_maps(trained.model, flats, report)
    report.stage("Comparing photos")
    store = read_photos(trained, scene, views, box, report)
    outward = not looks_inward(scene.views)
    maps, agreed = refined_maps(flats, rendered, store, trained.device, report, outward=outward)
    check_agreement(agreed, report)
    return flats, store, maps


def open_surface(
    bricks: Bricks,
    maps: MapArrays,
    tolerance: float,
    region: Region,
    most: int | None,
    gaps: float,
    report: Reporter,
    pictures: Pictures | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What two views see of the fused surface, in about `most` triangles where a number is given, and which of these (F,) bool
    close small holes, or gaps, by a guess; else open where nothing is known, but for gaps up to a width of `gaps`, and where the
    region cuts it.
    `pictures`: the photos that it is fitted to."""
    vertices, faces = extract(bricks, report)
    if not len(faces):
        return vertices, faces, np.zeros(0, bool)
    report.stage("Cleaning the surface")
    near = tolerances(bricks, vertices, faces, tolerance)
    vertices, faces, guessed = clean(vertices, faces, maps, near, report)
    kept = ~open_places(vertices, faces, guessed, bricks, maps, report)
    (vertices, faces), guessed = compact(vertices, faces[kept]), guessed[kept]
    if gaps:
        report.stage("Closing gaps")
        vertices, faces, guessed = close_gaps(bricks, vertices, faces[~guessed], gaps, maps, report)
    before = vertices[faces].mean(1)
    if most is not None and len(faces) > most:
        report.stage("Simplifying")
        vertices, faces = decimate(vertices, faces, most, report)
    vertices = denoised(vertices, faces, maps.depth.device, report)
    if pictures is not None:
        vertices = fitted(vertices, faces, pictures, report)
    faces = faces[~on_sides(vertices, faces, region, region.voxel / 2)]
    faces = faces[not_scraps(vertices, faces)]  # simplifying tears thin ones off
    vertices, faces = compact(vertices, faces)
    if not guessed.any():
        return vertices, faces, np.zeros(len(faces), bool)
    _, nearest = scipy.spatial.KDTree(before).query(vertices[faces].mean(1))
    return vertices, faces, guessed[nearest]


def fitted(
    vertices: np.ndarray, faces: np.ndarray, pictures: Pictures, report: Reporter, free: np.ndarray | None = None
) -> np.ndarray:
    """Vertices (V, 3) of triangles (F, 3) moved to where the photos agree best, without the noise that this leaves. Each moves by
    the share `free` (V,) of the way, 1 where nothing is given."""
    report.stage("Fitting to the photos")
    moved = moved_by_photos(vertices, faces, pictures, report, free)
    return denoised(moved, faces, pictures.maps.depth.device, report, free)


def wanted_bounds(params: MeshParams, scene: Scene, box: Box) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners (3,) in the normalised frame of what holds the region that was asked for; None: what the photos show.

    Raises:
        SettingError: it is not six finite numbers, or empty.
    """
    wanted = wanted_region(params, scene)
    if wanted is None:
        return None
    corners = np.stack(np.meshgrid(*zip(*wanted), indexing="ij"), -1).reshape(-1, 3)
    moved = transform_points(box.box_from_world, corners)
    return moved.min(0), moved.max(0)


def wanted_sides(params: MeshParams, scene: Scene, box: Box) -> np.ndarray | None:
    """The sides (6, 4) of the region that was asked for in the normalised frame, where it stands at an angle there, as the
    project was turned since the field was trained; see `region.sides_of`. Raises SettingError."""
    wanted = wanted_region(params, scene)
    return None if wanted is None else sides_of(*wanted, box.world_from_box)


def wanted_region(params: MeshParams, scene: Scene) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners (3,) in the world of the region that was asked for; None: what the photos show.

    Raises:
        SettingError: it is not six finite numbers, or empty.
    """
    if params.region == "photos":
        return None
    if params.region == "auto":
        if scene.bounds is None:
            return None
        low, high = scene.bounds
    else:
        try:
            low, high = np.array([float(n) for n in params.region.split(",")]).reshape(2, 3)
        except ValueError as error:
            raise SettingError(
                f"{params.region} is no region.", "Give auto, photos, or x0,y0,z0,x1,y1,z1 in the aligned world."
            ) from error
        if not np.isfinite([low, high]).all():
            raise SettingError(
                f"The region {params.region} has no end.", "Give numbers, or photos for all that the photos show."
            )
        if not (low < high).all():
            raise SettingError(f"The region {params.region} is empty.", "Give x0 < x1, y0 < y1, z0 < z1.")
    return low, high


def wanted_voxel(params: MeshParams, project: Project, box: Box) -> float | None:
    """Side of a voxel in the normalised frame for the detail that was asked for; None without.

    Raises:
        SettingError: the scale is not known.
    """
    if params.detail is None:
        return None
    if not project.frame.scale_known:
        raise SettingError(
            "A detail in millimetres needs the scale of the capture.",
            "Set it with `fieldwork align`, or use resolution.",
        )
    return params.detail / 1000 / similarity_scale(box.world_from_box)


def check_agreement(share: float, report: Reporter) -> None:
    """Warn where the views agree on little of what they show."""
    if share < LITTLE_AGREEMENT:
        report.warn(
            f"The views agree on {100 * share:.0f} % of what they show only: the surface will have holes. "
            "Train longer, or check the poses."
        )


def check_parts(vertices: np.ndarray, faces: np.ndarray, report: Reporter) -> None:
    """Warn where the surface is in scraps."""
    largest, parts = largest_share(vertices, faces)
    if largest < LITTLE_IN_ONE:
        report.warn(
            f"The surface is in {parts} parts, the largest with {100 * largest:.0f} % of the area. "
            "More photos or longer training may join them."
        )


def largest_share(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, int]:
    """Share of the area that the largest connected part of triangles (F, 3) has, and how many parts there are."""
    area = np.bincount(components(faces, len(vertices)), areas(vertices, faces))
    return float(area.max() / max(area.sum(), 1e-30)), len(area)


def read_photos(trained: Trained, scene: Scene, views: list[View], box: Box, report: Reporter) -> PixelStore:
    """The pixels and labels of the chosen views, at the size they were trained with."""
    index = {view.name: number for number, view in enumerate(scene.views)}
    indices = [index[view.name] for view in views]
    ids, device = trained.info.class_ids, torch.device("cpu")
    return PixelStore(scene, indices, ids, box.box_from_world, trained.info.image_size, device, report)


def vertex_colors(
    model: Model, region: Region, photos: Photos, points: np.ndarray, normals: np.ndarray, report: Reporter
) -> np.ndarray:
    """Colours (N, 3) uint8 of surface points (N, 3) with normals (N, 3): the photos', and the field's where no photo
    shows them."""
    color, covered = photos.observe(points, normals, report)
    if not covered.all():
        color[~covered], _ = shade(
            model, points[~covered], normals[~covered], False, region.voxel, lambda _: report.check()
        )
    return to_bytes(color)
