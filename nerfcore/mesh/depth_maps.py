"""Depth maps of a trained field: where rays become half opaque, and which of it other views confirm."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy
import torch

from ..data.box import box_poses
from ..data.camera_rays import CameraRays
from ..data.pixels import training_size
from ..data.scene import View
from ..geometry.cameras import Camera, pixel_centers, project, rays
from ..kernels.depth_arrays import FREE, MapArrays
from ..kernels.depth_normals import depth_normals
from ..kernels.device import kernel_device
from ..kernels.march import sample
from ..kernels.runtime import run_parallel
from ..kernels.surface import able_views, agreement, depth_quantiles
from ..progress import Reporter
from ..render.model import Model
from ..render.sparse_rays import sparse_rays

SIDE = 640  # longest side of a map; larger ones lose surface: docs/experiments.md, “How large depth maps are on a GPU”
CPU_PIXELS, GPU_PIXELS = 8e6, 2e8  # of all maps together
CPU_RAYS, GPU_RAYS = 8192, 1 << 18  # a tile; the CPU's fits a core's cache
FIELD_SHARE, FIELD_SIDE = 0.5, 160  # of a map's side on a CPU, and pixels at least: a field is soft, photos refine it
MOST_VIEWS = 96
OPAQUE, EMPTY = 0.5, 0.1  # opacities: something is there, nothing is there
CERTAIN = 20.0  # footprints of a pixel: spread of a depth up to which its slope can be relied on
ENOUGH = 0.24  # transmittance of a ray of which nothing more is asked: its spread is known, and that it hits something
STEEPEST = np.cos(np.radians(80))
EDGE, EDGE_PIXELS = 0.03, 5.5  # share, or footprints of a pixel, by which the depth of neighbours differs at an outline
NEIGHBOURS = 48  # views asked to confirm a depth: what lies at a picture's rim is seen by views that share little else
CONFIRMED = 2  # of them that must
# Of the depth, or footprints of a pixel where photos are small; pixels.
AGREE, AGREE_PIXELS, ROUND_TRIP = 0.01, 1.65, 1.5
OUTSIDE = -1.0  # depth of pixels beside the photo, which can confirm nothing
HIDDEN = 0.03  # share of a place's distance by which what hides it is nearer
BORDER = 33  # places along each side of a photo by which it is told where it ends
SMALLEST_FACE = 0.05  # share of a cube's face that a photo must show
FLAT, ASKED = ("PINHOLE", "OPENCV"), 96  # lenses of one flat picture; longest side at which others are asked for theirs


@dataclass(frozen=True)
class FlatView:
    """A pinhole picture of what one photo shows: camera, camera-to-box pose (4, 4), index of the photo among the chosen
    views, and inside (H, W): which pixels the photo covers."""

    camera: Camera
    pose: np.ndarray
    photo: int
    inside: np.ndarray


@dataclass(frozen=True)
class DepthMap:
    """What one picture shows, (H, W) float32, along the optical axis in normalised units: depth (0 unknown, FREE where
    nothing is), spread between transmittance 3/4 and 1/4, cosine of the angle between ray and normal."""

    depth: np.ndarray
    spread: np.ndarray
    cosine: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        return (self.depth > 0) & (self.depth < FREE)


def spread_views(views: list[View], most: int) -> list[View]:
    """At most `most` views, well spread over places and directions: each next one is the farthest from those chosen."""
    if len(views) <= most:
        return views
    centers = np.stack([v.camera_to_world[:3, 3] for v in views])
    size = float(np.linalg.norm(centers - centers.mean(0), axis=1).mean()) or 1.0
    places = np.concatenate([centers / size, np.stack([v.camera_to_world[:3, 2] for v in views])], 1)
    chosen, gap = [0], np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return [views[i] for i in sorted(chosen)]


def map_size(views: list[View], device: torch.device) -> int:
    """Longest side of the depth maps, so that all together stay affordable."""
    most = CPU_PIXELS if device.type == "cpu" else GPU_PIXELS
    cameras = [view.camera.resized(*training_size(view.camera, SIDE)) for view in views]
    pixels = {camera: _flat_pixels(camera) for camera in dict.fromkeys(cameras)}
    total = sum(pixels[camera] for camera in cameras)
    return max(64, int(SIDE * min(1.0, (most / total) ** 0.5)))


def _flat_pixels(camera: Camera) -> float:
    """Pixels of the flat pictures that show what a camera does, as small ones tell."""
    if camera.model in FLAT:
        return camera.width * camera.height
    small = camera.resized(*training_size(camera, ASKED))
    share = camera.pixels_per_radian / small.pixels_per_radian
    return share**2 * sum(face.inside.size for face in _faces(small, np.eye(4), 0))


def flat_views(views: list[View], box_from_world: np.ndarray, longest: int) -> list[FlatView]:
    """Pinhole pictures that together show what the views do: lenses undistorted, wide ones cut into faces of a cube."""
    made = []
    for index, (view, pose) in enumerate(zip(views, box_poses(views, box_from_world))):
        small = view.camera.resized(*training_size(view.camera, longest))
        if view.camera.model in FLAT:
            made.append(_flat(small, small.undistorted(), pose, np.eye(3), index))
        else:
            made += _faces(small, pose, index)
    return [view for view in made if view.inside.mean() >= SMALLEST_FACE]


def _faces(camera: Camera, pose: np.ndarray, index: int) -> list[FlatView]:
    """Of the faces of a cube around a wide camera those that show enough of its photo, cut to what they show of it."""
    ahead = _ahead(camera)
    parts = cube_faces(camera) if ahead is None else [(ahead, np.eye(3))]
    faces = [_flat(camera, face, pose, turn, index) for face, turn in parts]
    # A narrow lens fills little even of the only face that shows its photo.
    least = [min(SMALLEST_FACE * face.inside.size, SMALLEST_FACE * camera.width * camera.height) for face in faces]
    return [_cut(face) for face, fewest in zip(faces, least) if face.inside.sum() >= fewest]


def _ahead(camera: Camera) -> Camera | None:
    """The part of the face of the cube before a narrow camera that holds all of its photo, by what lies at the photo's border; None
    for one that sees beyond that face. The whole face of a narrow lens has many times the pixels of its photo."""
    width, height = camera.width, camera.height
    along, down = (np.linspace(0, n, BORDER) for n in (width, height))
    ends = [np.stack(np.broadcast_arrays(x, y), 1) for x, y in ((along, 0), (along, height), (0, down), (width, down))]
    directions, valid = rays(camera, np.concatenate(ends))
    face, _ = cube_faces(camera)[0]
    if not valid.all() or not (np.abs(directions[:, :2]) < directions[:, 2:]).all():
        return None
    place = directions[:, :2] / directions[:, 2:] * face.fx + face.cx
    low = np.maximum(np.floor(place.min(0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(place.max(0)).astype(int) + 2, face.width)
    size = {"width": int(high[0] - low[0]), "height": int(high[1] - low[1])}
    return face.model_copy(update={**size, "cx": face.cx - low[0], "cy": face.cy - low[1]})


def _cut(view: FlatView) -> FlatView:
    """The part of a picture that holds all of the photo in it."""
    (top, bottom), (left, right) = (np.flatnonzero(view.inside.any(axis))[[0, -1]] for axis in (1, 0))
    inside, camera = view.inside[top : bottom + 1, left : right + 1], view.camera
    size = {"width": inside.shape[1], "height": inside.shape[0]}
    moved = camera.model_copy(update={**size, "cx": camera.cx - left, "cy": camera.cy - top})
    return replace(view, camera=moved, inside=inside)


def cube_faces(camera: Camera) -> list[tuple[Camera, np.ndarray]]:
    """Six square pinholes of 90° with the resolution of a wide camera's middle, and their rotations (3, 3) into its
    axes."""
    side = max(16, round(2 * camera.pixels_per_radian))
    face = Camera(width=side, height=side, fx=side / 2, fy=side / 2, cx=side / 2, cy=side / 2)
    ahead = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
    turns = []
    for axis in np.array(ahead, float):
        down = np.array([0.0, 0, -axis[1]]) if axis[1] else np.array([0.0, 1, 0])
        turns.append(np.stack([np.cross(down, axis), down, axis], 1))
    return [(face, turn) for turn in turns]


def _flat(photo: Camera, flat: Camera, pose: np.ndarray, turn: np.ndarray, index: int) -> FlatView:
    directions, _ = rays(flat, pixel_centers(flat.width, flat.height).reshape(-1, 2))
    pixel = project(photo, directions @ turn.T)
    with np.errstate(invalid="ignore"):
        inside = (pixel >= 0).all(1) & (pixel <= [photo.width, photo.height]).all(1)
    moved = pose.copy()
    moved[:3, :3] = pose[:3, :3] @ turn
    return FlatView(flat, moved, index, inside.reshape(flat.height, flat.width))


def depth_maps(model: Model, views: list[FlatView], report: Reporter) -> list[DepthMap]:
    """Depth maps of all views; the reporter hears how long it will take."""
    small = [reduced(view) if model.priorities.device.type == "cpu" else view for view in views]
    rays = sparse_rays([v.camera for v in small], np.stack([v.pose for v in small]), model.device)
    model.refine(float(sum(v.inside.size for v in small)), report.check, rays)
    begin, maps = time.monotonic(), []
    for number, (view, rendered) in enumerate(zip(views, small)):
        left = (time.monotonic() - begin) / number * (len(views) - number) if number else 0.0
        report.progress(number / len(views), f"{left:.0f} s left" if number else "")
        maps.append(enlarged(render_depth(model, rendered, report.check), view))
    return maps


def reduced(view: FlatView) -> FlatView:
    """The view at `FIELD_SHARE` of its size, but at least `FIELD_SIDE` pixels long unless it is smaller itself."""
    width, height = view.camera.width, view.camera.height
    longest = max(width, height)
    share = min(1.0, max(FIELD_SHARE, FIELD_SIDE / longest))
    if share == 1:
        return view
    camera = view.camera.resized(max(1, round(share * width)), max(1, round(share * height)))
    # All of it is rendered: a pixel whose centre lies beside the photo is in part within.
    return replace(view, camera=camera, inside=np.ones((camera.height, camera.width), bool))


def enlarged(small: DepthMap, view: FlatView) -> DepthMap:
    """A depth map at the size of a view: inverse depths, in which planes are linear, interpolated within a surface, those
    of the nearest pixel at outlines."""
    height, width = small.depth.shape
    camera = view.camera
    if (camera.width, camera.height) == (width, height):
        return small
    nearest = _nearest(camera.width, camera.height, width, height)
    inverse = np.where(small.hit, 1 / np.where(small.hit, small.depth, 1), 0)
    low = scipy.ndimage.minimum_filter(inverse, 3, mode="nearest")
    high = scipy.ndimage.maximum_filter(inverse, 3, mode="nearest")
    place = np.meshgrid(*((np.arange(n) + 0.5) * m / n - 0.5 for n, m in ((camera.height, height), (camera.width, width))),
                        indexing="ij")  # fmt: skip
    between = scipy.ndimage.map_coordinates(inverse, place, order=1, mode="nearest")
    edge = max(EDGE, EDGE_PIXELS / (camera.fx * width / camera.width))
    smooth = ((low > 0) & (high - low < 2 * edge * low))[nearest]
    depth = np.where(smooth, 1 / np.where(smooth, between, 1), small.depth[nearest])
    depth = np.where(view.inside, depth, 0).astype(np.float32)
    return DepthMap(depth, small.spread[nearest], cosines(camera, depth))


def _nearest(width: int, height: int, from_width: int, from_height: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (H, 1) and columns (1, W) of a picture of another size that are nearest to the pixels of one (H, W)."""
    rows = ((np.arange(height) + 0.5) * from_height / height).astype(int)
    return rows[:, None], ((np.arange(width) + 0.5) * from_width / width).astype(int)[None]


@torch.no_grad()
def render_depth(model: Model, view: FlatView, check: Callable[[], None]) -> DepthMap:
    """The depth map of one view: the median along each ray, inside the sample in which transmittance passes 1/2."""
    device, camera, grid = model.priorities.device, view.camera, model.render_grid()
    through = CameraRays([camera], view.pose[None], device)
    count = model.config.render.samples or model.config.sampling.samples
    axis = through.rotation[0, :, 2]

    @torch.no_grad()
    def tile(pixel: torch.Tensor) -> torch.Tensor:
        check()
        origins, directions = through(torch.zeros_like(pixel), pixel)
        s = sample(origins, directions, grid.cells, grid.skip_distance, grid.settings, count)
        density = model.field.density_until(ENOUGH, s.points, s.deltas, s.packed_info)
        near, middle, far, opacity = depth_quantiles(density, s.deltas, s.t, s.packed_info)
        along = directions @ axis
        # A ray that stays more transparent than 1/4 has its spread up to its end unknown: three times the half.
        spread = torch.where(far > 0, far - near, 3 * (middle - near))
        depth = torch.where(opacity >= OPAQUE, middle * along, torch.where(opacity < EMPTY, FREE, 0.0))
        return torch.stack([depth, spread * along], 1)

    pixels = torch.arange(camera.width * camera.height, device=device)
    tiles = pixels.split(CPU_RAYS if device.type == "cpu" else GPU_RAYS)
    values = torch.cat(run_parallel([partial(tile, some) for some in tiles], device)).cpu().numpy()
    shape = (camera.height, camera.width)
    depth = np.where(view.inside, values[:, 0].reshape(shape), 0).astype(np.float32)
    return DepthMap(depth, values[:, 1].reshape(shape), cosines(camera, depth))


def cosines(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Cosine (H, W) of the angle between each pixel's ray and the surface normal there; 0 where there is no surface or an
    outline."""
    directions = pixel_directions(camera)
    length = np.linalg.norm(directions, axis=-1)
    return (np.abs((normals(camera, depth) * directions).sum(-1)) / length).astype(np.float32)


def normals(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Unit normals (H, W, 3) in camera axes, towards the camera, from depth differences over one or two pixels; 0 where
    there is no surface or an outline."""
    lens = camera.fx, camera.fy, camera.cx, camera.cy
    depth = np.ascontiguousarray(depth, np.float32)
    return depth_normals(torch.from_numpy(depth), lens, max(EDGE, EDGE_PIXELS / camera.fx)).numpy()


def averaged(normals: np.ndarray, size: int) -> np.ndarray:
    """Normals (H, W, 3), averaged over windows of `size` pixels; 0 where there is none."""
    mean = np.stack([scipy.ndimage.uniform_filter(normals[..., k], size) for k in range(3)], -1)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    return np.where(length > 0.1, mean / np.maximum(length, 1e-9), 0).astype(np.float32)


def pixel_directions(camera: Camera) -> np.ndarray:
    """Where the pixels (H, W, 3) of a pinhole look, in camera axes, with z = 1."""
    place = pixel_centers(camera.width, camera.height)
    flat = (place - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([flat, np.ones_like(flat[..., :1])], -1).astype(np.float32)


def map_arrays(views: list[FlatView], maps: list[DepthMap], device: torch.device) -> MapArrays:
    """The maps as the kernels read them, without what is seen under less than 10° and without outlines; on the host where
    the device has no Warp."""
    device = kernel_device(device)
    sizes = torch.tensor([[v.camera.width, v.camera.height] for v in views], dtype=torch.int32)
    inverse = np.stack([np.linalg.inv(v.pose) for v in views]).astype(np.float32)

    def flat(parts: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([p.reshape(-1) for p in parts]).astype(np.float32)).to(device)

    return MapArrays(
        flat([np.where(m.hit & (m.cosine < STEEPEST), 0, m.depth) for m in maps]),
        flat([np.where(m.hit, m.cosine, 1) for m in maps]),
        flat([np.where(m.hit, m.spread, 0) for m in maps]),
        flat([certain_slopes(v, m) for v, m in zip(views, maps)]),
        torch.nn.functional.pad(sizes.prod(1).cumsum(0)[:-1], (1, 0)).int().to(device),
        sizes.to(device),
        torch.tensor([[v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy] for v in views]).float().to(device),
        torch.from_numpy(np.ascontiguousarray(inverse[:, :3, :3])).to(device),
        torch.from_numpy(np.ascontiguousarray(inverse[:, :3, 3])).to(device),
    )


def certain_slopes(view: FlatView, map_: DepthMap) -> np.ndarray:
    """Where (H, W) bool the spread of a map's depths is so small that their slope can be relied on."""
    return map_.hit & (map_.spread <= CERTAIN * map_.depth / view.camera.fx)


def confirmed_maps(
    views: list[FlatView],
    maps: list[DepthMap],
    device: torch.device,
    report: Reporter,
    around: list[list[int]] | None = None,
    needed: int = CONFIRMED,
    one_suffices: list[np.ndarray] | None = None,
    agree: float = AGREE,
    round_trip: float = ROUND_TRIP,
    few_suffice: bool = True,
) -> MapArrays:
    """The maps as the kernels read them, without what cannot be trusted: see `map_arrays`, and what `needed` other views
    do not confirm; where fewer could show a place, those, but at least one, if `few_suffice`. `around`: the neighbours of each view
    where they are known; `one_suffices`: for which pixels (H, W) bool of each map one other view is enough; `agree`: share by
    which a depth may differ at least; `round_trip`: pixels by which it may miss the pixel."""
    arrays = map_arrays(views, maps, device)
    photographed = torch.from_numpy(np.concatenate([view.inside.reshape(-1) for view in views])).to(arrays.depth.device)
    seen = replace(arrays, depth=torch.where(photographed, arrays.depth, OUTSIDE))
    confirmed, needed = [], min(needed, len({view.photo for view in views}) - 1)
    for index, near in enumerate(around or neighbours(views, maps)):
        report.progress(index / len(views))
        others = torch.tensor(near, dtype=torch.int32, device=arrays.depth.device)
        share = max(agree, AGREE_PIXELS / views[index].camera.fx)
        found = agreement(seen, index, others, share, round_trip, needed)
        enough = found >= needed
        if few_suffice:
            enough = found >= able_views(seen, index, others, HIDDEN, needed).clamp(min=min(1, needed))
        if one_suffices is not None:
            enough |= (found >= 1) & torch.from_numpy(one_suffices[index].reshape(-1)).to(found.device)
        confirmed.append(enough)
    keep = torch.cat(confirmed) | (arrays.depth >= FREE)
    return replace(arrays, depth=torch.where(keep, arrays.depth, 0.0))


def hit_points(arrays: MapArrays, view: int) -> torch.Tensor:
    """Points (N, 3) of the box frame that the pixels of one map show."""
    begin, (width, height) = int(arrays.first[view]), arrays.size[view].tolist()
    depth = arrays.depth[begin : begin + width * height]
    place = ((depth > 0) & (depth < FREE)).nonzero()[:, 0]
    z, (fx, fy, cx, cy) = depth[place], arrays.lens[view]
    x, y = place % width + 0.5, torch.div(place, width, rounding_mode="floor") + 0.5
    local = torch.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], 1)
    return (local - arrays.translation[view]) @ arrays.rotation[view]


def hit_values(arrays: MapArrays, values: torch.Tensor, view: int) -> torch.Tensor:
    """Of `values` (P,) those (N,) of the points that `hit_points` gives."""
    begin = int(arrays.first[view])
    some = slice(begin, begin + int(arrays.size[view].prod()))
    depth = arrays.depth[some]
    return values[some][(depth > 0) & (depth < FREE)]


def neighbours(views: list[FlatView], maps: list[DepthMap], most: int = NEIGHBOURS) -> list[list[int]]:
    """Of each view the others that show the same best: those that see most of its surface, at an angle that is not too
    wide."""
    centers = np.stack([v.pose[:3, 3] for v in views])
    out = []
    for index, (view, map_) in enumerate(zip(views, maps)):
        rows, columns = np.nonzero(map_.hit)
        some = slice(None, None, max(1, len(rows) // 500))
        c, z = view.camera, map_.depth[rows[some], columns[some]]
        local = np.stack([(columns[some] + 0.5 - c.cx) / c.fx * z, (rows[some] + 0.5 - c.cy) / c.fy * z, z], 1)
        points = local @ view.pose[:3, :3].T + view.pose[:3, 3]
        score = np.zeros(len(views))
        mine = view.pose[:3, 3] - points
        mine /= np.maximum(np.linalg.norm(mine, axis=1, keepdims=True), 1e-9)
        for other, seen_by in enumerate(views):
            if other == index or not len(points):
                continue
            place = (points - centers[other]) @ seen_by.pose[:3, :3]
            with np.errstate(invalid="ignore"):
                pixel = project(seen_by.camera, place)
                inside = (pixel >= 0).all(1) & (pixel < [seen_by.camera.width, seen_by.camera.height]).all(1)
            theirs = centers[other] - points
            theirs /= np.maximum(np.linalg.norm(theirs, axis=1, keepdims=True), 1e-9)
            angle = np.degrees(np.arccos(np.clip((mine * theirs).sum(1), -1, 1)))
            # Best at 15°; the same place says nothing new, far around little is the same.
            score[other] = (inside * np.exp(-((angle - 15) ** 2) / (2 * np.where(angle < 15, 6, 20) ** 2))).sum()
        order = np.argsort(-score, kind="stable")[:most]
        out.append([int(i) for i in order if score[i] > 0])
    return out
