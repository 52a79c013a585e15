"""A surface moved to where the photos that it shows agree best with each other.

Depth maps compare photos by small flat patches, and fusing them is a mean: edges become round, and grooves fill. Here the
surface itself says which pixels of two photos show the same place; each vertex moves along its normal until what they show
is alike (Vu, Labatut, Pons and Keriven, "High accuracy and visibility-consistent dense multiview stereo", 2012), by steps of
Gauss and Newton, held by a thin plate where photos say little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch

from ..data.pixels import PixelStore
from ..kernels.depth_arrays import FREE, MapArrays
from ..kernels.warping import NOT_SEEN, photo_forces
from ..progress import Reporter, Stretch
from .depth_maps import DepthMap, FlatView, neighbours, pixel_directions
from .refine import grey_pictures, photo_pixels
from .surface import vertex_normals
from .triangles import border_edges, cross, unit
from .visibility import DepthBuffer, PosedCamera, depth_buffer, in_parallel

ROUNDS = 5
WIDTH, APART = 5, 0.03  # pixels of what is thin, and share of its depth by which what is behind it is farther
PARTNERS = 4  # photos that each is compared with
FARTHEST = 0.5  # footprints of a pixel that a vertex moves at most in a round
PLATE = 10.0  # how stiff the plate is, in units of how firmly photos hold half of the vertices
WEAK = 1e-3  # of that firmness: holds what no photo shows where it is
TURNS = 5  # times that vertices of triangles which would turn over move as those around them
SMOOTH = 0.5  # pixels over which slopes of a photo are taken
DRAWING = 0.2  # of the time of a round
STEEPEST = 0.17  # cosine under which a photo says nothing of a surface that it shows


@dataclass(frozen=True)
class Pictures:
    """What is compared: flat views of the photos; `grey` (P, 3) value and slopes along x and y, as `photo_forces` takes them;
    `maps`: their cameras, whose depths are not used."""

    views: list[FlatView]
    grey: torch.Tensor
    maps: MapArrays


def pictures_of(views: list[FlatView], store: PixelStore, maps: MapArrays, report: Reporter) -> Pictures:
    """Flat views with what their photos show, without what a mask or transparency takes away."""
    known = store.rgba[:, 3].cpu().numpy() > 127
    if store.usable is not None:
        used = np.zeros(len(known), bool)
        used[store.usable.cpu().numpy()] = True
        known &= used
    parts = []
    for view, grey in zip(views, grey_pictures(views, store, report)):
        photo, first = store.cameras[view.photo], int(store.first[view.photo])
        x, y = np.nan_to_num(photo_pixels(view, store)).clip(0, [photo.width - 1, photo.height - 1]).astype(int).T
        shown = view.inside & known[first + y * photo.width + x].reshape(grey.shape)
        down, right = (
            np.gradient(scipy.ndimage.gaussian_filter(grey, SMOOTH)) if min(grey.shape) > 1 else (grey * 0,) * 2
        )
        parts.append(np.stack([np.where(shown, grey, NOT_SEEN), right, down], -1).reshape(-1, 3))
    return Pictures(views, torch.from_numpy(np.concatenate(parts).astype(np.float32)).to(maps.depth.device), maps)


def without_unknown(pictures: Pictures) -> Pictures:
    """The pictures without pixels of which the maps do not know the depth, where something may stand in front of the surface."""
    known = (pictures.maps.depth > 0) & (pictures.maps.depth < FREE)
    grey = torch.where(known[:, None], pictures.grey, torch.tensor([NOT_SEEN, 0.0, 0.0], device=known.device))
    return replace(pictures, grey=grey)


def moved_by_photos(
    vertices: np.ndarray, faces: np.ndarray, pictures: Pictures, report: Reporter, free: np.ndarray | None = None
) -> np.ndarray:
    """Vertices (V, 3) float64 of triangles (F, 3), in the frame of the pictures, moved to where photos agree best. Those of open
    borders stay where they are, others move by the share `free` (V,) of each step, 1 where nothing is given, and no triangle
    is turned over."""
    before = place = np.asarray(vertices, np.float64)
    if not len(faces):
        return place
    around, free = means_around(faces, len(place)), np.ones(len(place)) if free is None else free.copy()
    free[border_edges(faces)] = 0
    plate = bending(around)
    edge = float(np.median(np.linalg.norm(place[faces[:, 0]] - place[faces[:, 1]], axis=1)))
    total, near = np.zeros(len(place)), []
    for number in range(ROUNDS):
        now = Stretch(report, number / ROUNDS, 1 / ROUNDS)
        drawn = _drawn(place, faces, pictures, Stretch(now, 0, DRAWING))
        near = near or neighbours(pictures.views, [as_map(picture) for picture in drawn], PARTNERS)
        pixel = _footprint(drawn)
        normals = vertex_normals(place, faces)
        force, firm = _forces(place, faces, normals, pictures, drawn, near, Stretch(now, DRAWING, 1 - DRAWING))
        if not firm.any():
            break
        usual = float(np.median(firm[firm > 0]))
        # Triangles smaller than a pixel have noise that none of them shows.
        stiff = PLATE * usual * max(pixel / edge, 1) ** 4
        step = _solved(plate, force - stiff * (plate @ total), firm + WEAK * usual, stiff, report)
        step = free * step.clip(-FARTHEST * pixel, FARTHEST * pixel)
        place, total = place + step[:, None] * normals, total + step
    return before + not_turned(before, place - before, faces, around, free)


def not_turned(
    before: np.ndarray, step: np.ndarray, faces: np.ndarray, around: scipy.sparse.csr_matrix, free: np.ndarray
) -> np.ndarray:
    """Steps (V, 3) from `before` (V, 3) that turn no triangle over: there vertices move as those around them do, by the share
    `free` (V,), or else not at all."""
    step, normals, left = step.copy(), cross(before, faces), TURNS
    while True:
        turned = (normals * cross(before + step, faces)).sum(1) < 0
        if not turned.any():
            return step
        some, left = np.unique(faces[turned]), left - 1
        step[some] = free[some, None] * (around[some] @ step) if left >= 0 else 0


def _drawn(place: np.ndarray, faces: np.ndarray, pictures: Pictures, report: Reporter) -> list[DepthBuffer]:
    def draw(view: FlatView) -> DepthBuffer:
        return depth_buffer(PosedCamera(view.camera, view.pose), place, faces, device)

    device = pictures.grey.device
    return [drawn for _, drawn in in_parallel(draw, pictures.views, report, "photos", device)]


def depths_of(drawn: DepthBuffer) -> np.ndarray:
    """Depth (H, W) of what a picture shows of the surface, 0 where it shows none."""
    return np.where(drawn.face >= 0, drawn.depth, 0).astype(np.float32)


def as_map(drawn: DepthBuffer) -> DepthMap:
    """The depth map of a surface that is known exactly."""
    depth = depths_of(drawn)
    return DepthMap(depth, np.zeros_like(depth), np.ones_like(depth))


def thin(drawn: DepthBuffer) -> np.ndarray:
    """Which pixels (H, W) show a thing less than `WIDTH` pixels wide, and so mix it with what is behind."""
    return scipy.ndimage.grey_closing(drawn.depth, WIDTH, mode="nearest") > (1 + APART) * drawn.depth


def _footprint(drawn: list[DepthBuffer]) -> float:
    """Median width of a pixel on the surface; 0 where no picture shows it."""
    widths = np.concatenate([d.view.footprint(d.depth[d.face >= 0]) for d in drawn])
    return float(np.median(widths)) if len(widths) else 0.0


def _forces(
    place: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    pictures: Pictures,
    drawn: list[DepthBuffer],
    near: list[list[int]],
    report: Reporter,
) -> tuple[np.ndarray, np.ndarray]:
    """The force (V,) of all photos on each vertex along its normal, and how firmly (V,) they hold it."""
    device = pictures.grey.device

    def flat(parts: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([part.reshape(-1) for part in parts]).astype(np.float32)).to(device)

    maps = replace(pictures.maps, depth=flat([np.where(thin(d), 0, depths_of(d)) for d in drawn]))
    nearest, facing = flat([d.nearest for d in drawn]), unit(cross(place, faces))
    slopes, offsets = barycentric_slopes(place[faces])
    along = np.einsum("fij,fj->fi", normals[faces], facing)  # of steps of the corners, along the normal of the triangle

    def of_view(number: int) -> tuple[np.ndarray, np.ndarray]:
        view, face = pictures.views[number], drawn[number].face
        if not near[number] or not (face >= 0).any():
            return np.zeros(len(place)), np.zeros(len(place))
        face = face.reshape(-1)
        told = photo_forces(
            pictures.grey,
            torch.from_numpy(facing[face].astype(np.float32)).to(device),
            nearest,
            maps,
            number,
            torch.tensor(near[number], dtype=torch.int32, device=device),
        )
        told = told.cpu().numpy().astype(np.float64)
        some = np.flatnonzero(told[:, 1] > 0)
        ray = pixel_directions(view.camera).reshape(-1, 3)[some].astype(np.float64) @ view.pose[:3, :3].T
        face = face[some]
        cosine = -np.einsum("ni,ni->n", ray, facing[face]) / np.linalg.norm(ray, axis=1)
        point = view.pose[:3, 3] + drawn[number].depth.reshape(-1)[some, None] * ray
        weights = (np.einsum("nij,nj->ni", slopes[face], point) + offsets[face]).clip(0, 1)
        share = weights / weights.sum(1, keepdims=True) * along[face]
        told = told[some, :2] * np.where(cosine > STEEPEST, cosine, 0)[:, None]
        pull, hold = share * told[:, :1], np.abs(share) * told[:, 1:]
        at = faces[face].reshape(-1)
        return np.bincount(at, pull.reshape(-1), len(place)), np.bincount(at, hold.reshape(-1), len(place))

    force, firm = np.zeros(len(place)), np.zeros(len(place))
    for _, (pull, hold) in in_parallel(of_view, range(len(drawn)), report, "photos", device):
        force += pull
        firm += hold
    return force, firm


def barycentric_slopes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How weights of corners (F, 3, 3) of triangles depend on a place in their planes: slopes (F, 3, 3) and what they are at
    the origin (F, 3); weights are slopes @ place + that. Of triangles without an area the first corner has all weight."""
    first, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(one, two)
    scale = np.maximum((normal**2).sum(1, keepdims=True), 1e-30)
    second, third = np.cross(two, normal) / scale, np.cross(normal, one) / scale
    slopes = np.stack([-second - third, second, third], 1)
    return slopes, np.array([1.0, 0, 0]) - np.einsum("fij,fj->fi", slopes, first)


def means_around(faces: np.ndarray, count: int) -> scipy.sparse.csr_matrix:
    """The matrix (count, count) that takes values of vertices to the means of their neighbours'."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    beside = scipy.sparse.coo_matrix((np.ones(len(ends)), ends.T), (count, count)).tocsr()
    beside = ((beside + beside.T) > 0).astype(float)
    amount = np.maximum(np.asarray(beside.sum(1))[:, 0], 1)
    return (scipy.sparse.diags(1 / amount) @ beside).tocsr()


def bending(around: scipy.sparse.csr_matrix) -> scipy.sparse.csr_matrix:
    """The energy (V, V) of a thin plate: squares of how far each value is from the mean of its neighbours."""
    apart = scipy.sparse.identity(around.shape[0]) - around
    return (apart.T @ apart).tocsr()


def _solved(
    plate: scipy.sparse.csr_matrix, force: np.ndarray, firm: np.ndarray, stiff: float, report: Reporter
) -> np.ndarray:
    """Shifts (V,) at which forces, what photos hold, and the plate are in balance."""
    matrix = (scipy.sparse.diags(firm) + stiff * plate).tocsr()
    own = scipy.sparse.diags(1 / matrix.diagonal())
    step, _ = scipy.sparse.linalg.cg(matrix, force, rtol=1e-3, maxiter=200, M=own, callback=lambda _: report.check())
    return step
