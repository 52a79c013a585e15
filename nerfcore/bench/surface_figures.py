"""Figures of a textured, labelled mesh beside the true surface and the photos that were held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree
from skimage.color import deltaE_ciede2000, rgb2lab
from trimesh.triangles import points_to_barycentric

from ..data.photo import photo_of
from ..data.scene import Scene, View
from ..images.picture import resized
from ..kernels.closest import ClosestPoints
from ..measure.closing import closed
from ..mesh.facelets import PIECES, Facelets, facelets, small_pieces
from ..mesh.metrics import Distances, distances, sample_surface
from ..mesh.painted import Painted
from ..mesh.surface import Surface
from ..mesh.surface_picture import surface_picture
from ..mesh.triangles import areas, components, cross, edge_ends, unit
from ..mesh.visibility import DepthBuffer, PosedCamera, depth_buffer, within
from .surface_outlines import outline_texels, true_outline

CLOSE = 0.01  # share of the size
ENOUGH = 3  # cameras that see what a mesh is asked to hold
FAR = 2.5  # of the median depth of the photos: what is farther is a background
MOST_CAPPED = 0.25  # share of a body's area that may stand on something
HIDDEN = 0.5  # footprints of a pixel that something lies in front of what it hides
NEAR_CORNER = 0.7  # of the way from a piece's middle to a corner
CUT = 4.0  # pixels: longest edge of pieces that are seen in part, where classes are asked
STEEPEST = 0.1  # cosine under which a camera is not said to see a place
MARGIN = 2.0  # radii of a piece by which it may lie beside a picture that shows some of it
ACROSS = 50  # pieces across what the photos show, from which points of the truth are taken
SAMPLES = 400_000  # a class of a fiftieth of the area is then known to 1.2 %
SAME_SIDE = np.cos(np.radians(60))


@dataclass(frozen=True)
class Truth:
    """The true surface of a simulated scene, in the world: vertices (V, 3), faces (F, 3), face_class (F,)."""

    vertices: np.ndarray
    faces: np.ndarray
    face_class: np.ndarray


class Sight:
    """What the photos of a scene show of the true surface.

    pixel: median footprint of a photo's pixel there; far: depth beyond which things are background; size: longest side
    of what enough cameras see. World units.
    """

    def __init__(self, truth: Truth, views: Sequence[View]) -> None:
        self.cameras = posed(views)
        self.pieces = pieces = small_pieces(truth.vertices, truth.faces)
        self.buffers = [depth_buffer(camera, pieces.vertices, pieces.faces) for camera in self.cameras]
        depths = [buffer.depth[buffer.face >= 0] for buffer in self.buffers]
        self.far = FAR * float(np.median(np.concatenate(depths)))
        near = [camera.footprint(z[z < self.far]) for camera, z in zip(self.cameras, depths)]
        self.pixel = float(np.median(np.concatenate(near)))
        self.truth = truth
        self.seen = self._sampled()
        self.size = float(np.ptp(self.seen[0], axis=0).max())

    def _sampled(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Points (M, 3) spread evenly over what is visible, their triangles (M,) of the truth, and its area. They are taken
        from small pieces of what lies before a camera, as a ground may reach far beyond what photos show."""
        small = self.pieces
        parent, limit = small.parent, float(np.ptp(small.vertices, axis=0).max()) / PIECES
        while True:  # what does not reach into a picture is left out before the rest is cut further
            some = np.flatnonzero(self._reached(small))
            parent = parent[some]
            if limit <= self.far / ACROSS or not len(some):
                break
            limit /= 2
            small = facelets(small.vertices, small.faces[some], limit=limit)
            parent = parent[small.parent]
        points, face = sample_surface(small.vertices, small.faces[some], 2 * SAMPLES)
        seen = self.visible(points, small.normals[some][face])
        return points[seen], parent[face[seen]], float(small.areas[some].sum() * seen.mean())

    def _reached(self, pieces: Facelets) -> np.ndarray:
        """Whether a camera may see something of pieces: (P,); no more is said of those that it does not."""
        radius = np.linalg.norm(pieces.vertices[pieces.faces] - pieces.centers[:, None], axis=2).max(1)
        found = np.zeros(len(pieces), bool)
        for camera in self.cameras:
            local = camera.local(pieces.centers)
            depth, pixel = camera.depth(local), camera.pixels(local)
            size = camera.camera.width, camera.camera.height
            longest = np.hypot(1, np.hypot(*size) * camera.footprint(np.ones(1)))  # ray of depth 1 in the picture
            around = np.linalg.norm(local, axis=1) < longest * (self.far + radius)
            beside = np.maximum(-pixel, pixel - size).max(1) * camera.footprint(np.maximum(depth, 0))
            # NaN, of what lies beside the lens: some of it may not.
            found |= around & (depth < self.far + radius) & (depth > -radius) & ~(beside > MARGIN * radius)
        return found

    def outline(self) -> np.ndarray:
        """Ends (E, 2, 3) of the edges that are seen and at which the true class changes."""
        edges, normals = true_outline(self.truth.vertices, self.truth.faces, self.truth.face_class)
        return edges[self.visible(edges.mean(1), normals)]

    def class_near(self, points: np.ndarray) -> np.ndarray:
        """True class (N,) of what is closest to points (N, 3), of all that enough cameras see: where one thing lies on
        another, the faces between them are nobody's."""
        shown, classes = self._shown
        return classes[shown.find(points)[0]]

    @cached_property
    def _shown(self) -> tuple[ClosestPoints, np.ndarray]:
        """What enough cameras see, and its class (S,) by triangle. What they see a part of, as of a ground on which a wall
        stands, is cut into smaller pieces."""
        pieces, limit = self.pieces, CUT * self.pixel
        ends = pieces.vertices[pieces.faces]
        longest = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max(1)
        seen = np.array([self.visible(place, pieces.normals) for place in _places(pieces)])
        in_part = seen.any(0) & ~seen.all(0) & (longest > limit)
        whole = np.flatnonzero(seen[0] & ~in_part)
        cut = facelets(pieces.vertices, pieces.faces[in_part], limit=limit)
        kept = np.flatnonzero(self.visible(cut.centers, cut.normals))
        parent = np.concatenate([pieces.parent[whole], pieces.parent[in_part][cut.parent[kept]]])
        # `facelets` keeps the vertices it is given in front of its own.
        faces = np.concatenate([pieces.faces[whole], cut.faces[kept]])
        return ClosestPoints(cut.vertices, faces), self.truth.face_class[parent]

    def visible_near(self, points: np.ndarray) -> np.ndarray:
        """Whether enough cameras see what is closest to points (N, 3), of all that any camera sees: what no camera sees,
        as the inside of a thing or the floor under a carpet, takes nothing from what lies before it."""
        pieces, looked_at = self.pieces, self._looked_at
        closest, weights, _ = ClosestPoints(pieces.vertices, pieces.faces[looked_at]).find(points)
        nearest = np.einsum("nk,nkc->nc", weights, pieces.vertices[pieces.faces[looked_at[closest]]])
        return self.visible(nearest, pieces.normals[looked_at[closest]])

    @cached_property
    def _looked_at(self) -> np.ndarray:
        """The pieces (L,) of which a camera sees the middle, or a place near a corner."""
        looks = [self.cameras_at(place, self.pieces.normals) > 0 for place in _places(self.pieces)]
        return np.flatnonzero(np.any(looks, axis=0))

    def visible(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Whether enough cameras see points (N, 3) of the truth with normals (N, 3): (N,)."""
        return self.cameras_at(points, normals) >= ENOUGH

    def cameras_at(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """How many cameras see points (N, 3) of the truth with normals (N, 3): (N,).

        What hides a point is the plane of the face that its pixel shows, cut with the ray to the point: a floor just under
        a carpet is hidden, however flat the camera looks on it.
        """
        seen, pieces = np.zeros(len(points), int), self.pieces
        for camera, buffer in zip(self.cameras, self.buffers):
            ray = points - camera.center
            distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
            local = camera.local(points)
            pixel, depth = camera.pixels(local), camera.depth(local)
            good = within(pixel, camera.camera.width, camera.camera.height) & (depth > 0) & (depth < self.far)
            good &= -(ray * normals).sum(1) > STEEPEST * distance
            rows = np.flatnonzero(good)
            x, y = pixel[rows].astype(int).T
            face = buffer.face[y, x]
            normal, corner = pieces.normals[face], pieces.vertices[pieces.faces[face, 0]]
            with np.errstate(divide="ignore", invalid="ignore"):
                reached = ((corner - camera.center) * normal).sum(1) / (ray[rows] * normal).sum(1)
            slack = HIDDEN * camera.footprint(depth[rows]) / distance[rows]
            seen[rows] += ~((face >= 0) & (reached > 0) & (reached < 1 - slack))
        return seen


def _places(pieces: Facelets) -> list[np.ndarray]:
    """The middles (P, 3) of pieces, and a place of each near each of its corners."""
    corners = pieces.vertices[pieces.faces]
    return [pieces.centers, *(corners[:, k] * NEAR_CORNER + pieces.centers * (1 - NEAR_CORNER) for k in range(3))]


def posed(views: Sequence[View]) -> list[PosedCamera]:
    """The cameras of views in the world."""
    return [PosedCamera(view.camera, np.asarray(view.camera_to_world, np.float64)) for view in views]


def surface_figures(
    surface: Surface,
    painted: Painted,
    truth: Truth,
    scene: Scene,
    thin: int | None = None,
    bodies: Sequence[tuple[int, ...]] = (),
) -> dict[str, float | None]:
    """All figures of a textured mesh in the world but those of time and memory; None: there is nothing to measure.

    Args:
        thin: class of a plate whose two sides are looked for. bodies: classes of each body whose volume is compared.
    """
    mesh = surface.vertices.astype(np.float64), surface.faces
    sight = Sight(truth, [scene.views[i] for i in scene.train])
    found = distances(mesh, (truth.vertices, truth.faces), sight.visible, SAMPLES, true=sight.seen)
    coarse, fine = found.scores(CLOSE * sight.size), found.scores(2 * sight.pixel)
    held_out = [scene.views[i] for i in scene.test]
    return {
        "f_size": coarse.f,
        "f_pixel": fine.f,
        "median_pixels": fine.median / sight.pixel,
        "median_size": fine.median / sight.size,
        "p95_pixels": fine.p95 / sight.pixel,
        "completeness": coarse.recall,
        "excess_area": 1 - coarse.precision,
        "normal_deg": fine.normal_deg,
        "both_sides": None if thin is None else both_sides(mesh, truth, sight, thin),
        "hit_share": hit_share(mesh, truth, held_out, sight.far),
        **class_figures(found, surface, painted, sight),
        "outline_texels": outline_texels(*mesh, painted, sight.outline(), CLOSE * sight.size),
        "volume_error": volume_error(mesh, surface.face_class, truth, bodies) if bodies else None,
        **picture_figures(mesh, painted, held_out),
        "seams": seam_ratio(surface.faces, painted),
    }


def both_sides(mesh: tuple[np.ndarray, np.ndarray], truth: Truth, sight: Sight, thin: int) -> float:
    """Of the two sides of a plate, of class `thin`, the share of the worse one that has a surface within two pixels which
    looks the same way."""
    plate = truth.faces[truth.face_class == thin]
    points, face = sample_surface(truth.vertices, plate, SAMPLES // 10)
    normals = unit(cross(truth.vertices, plate))[face]
    seen = sight.visible(points, normals)
    points, normals = points[seen], normals[seen]
    axis = np.abs(normals).sum(0).argmax()
    place, own = sample_surface(*mesh, count=4 * SAMPLES)
    near, index = KDTree(place).query(points, k=16, distance_upper_bound=2 * sight.pixel)
    facing = np.append(unit(cross(*mesh))[own], np.zeros((1, 3)), 0)[np.asarray(index)]
    same = (np.isfinite(near) & (np.einsum("nkc,nc->nk", facing, normals) > SAME_SIDE)).any(1)
    sides = [same[side * normals[:, axis] > SAME_SIDE] for side in (-1, 1)]
    return min(float(side.mean()) if len(side) else 0.0 for side in sides)


def volume_error(
    mesh: tuple[np.ndarray, np.ndarray], face_class: np.ndarray, truth: Truth, bodies: Sequence[tuple[int, ...]]
) -> float | None:
    """By how much the volume of the worst of some bodies is off, openings capped; None where one has no inside. A body is
    the largest part of the faces of its classes."""
    worst = 0.0
    for kinds in bodies:
        volumes = []
        for (vertices, faces), own in ((mesh, face_class), ((truth.vertices, truth.faces), truth.face_class)):
            chosen = faces[np.isin(own, kinds)]
            part = components(chosen, len(vertices))
            area = np.bincount(part, areas(vertices, chosen)) if len(chosen) else np.zeros(1)
            body = closed(vertices, chosen[part == area.argmax()], MOST_CAPPED)
            if body is None:
                return None
            volumes.append(body.volume)
        worst = max(worst, abs(volumes[0] / volumes[1] - 1))
    return worst


def hit_share(mesh: tuple[np.ndarray, np.ndarray], truth: Truth, views: Sequence[View], far: float) -> float:
    """Of the pixels of views that show the truth, nearer than `far`, the share that hits the mesh."""
    pieces, ours = small_pieces(truth.vertices, truth.faces), small_pieces(*mesh)

    def drawn(camera: PosedCamera, made: Facelets) -> DepthBuffer:
        return depth_buffer(camera, made.vertices, made.faces)

    solid = hit = 0
    for camera in posed(views):
        shown = drawn(camera, pieces).depth < far
        solid += int(shown.sum())
        hit += int((shown & (drawn(camera, ours).face >= 0)).sum())
    return hit / max(solid, 1)


def class_figures(found: Distances, surface: Surface, painted: Painted, sight: Sight) -> dict[str, float | None]:
    """mIoU by area of the texture's classes (of the faces', without a texture) where the mesh is close to the truth, and
    by how much the faces' area of the worst class is off, of classes that have at least a hundredth of what is seen; both
    are of what enough cameras see: two may show a mesh more of one thing, which is no error, nor is it the class of what
    enough of them see nearby."""
    near = found.to_truth < CLOSE * sight.size
    points, _ = sample_surface(surface.vertices.astype(np.float64), surface.faces, len(found.face))
    points, face = points[near], found.face[near]
    there = sight.visible_near(points)
    points, face = points[there], face[there]
    ours, theirs = classes_at(surface, painted, points, face), sight.class_near(points)
    shown = surface.face_class[face]
    seen = sight.truth.face_class[found.true_face]
    ious, off = [], []
    for number in np.unique(seen):
        one, other = ours == number, theirs == number
        if (one | other).any():
            ious.append((one & other).sum() / (one | other).sum())
        share = float((seen == number).mean())
        if share >= 0.01:
            area = (shown == number).sum() / len(found.face) * found.area
            off.append(abs(area / (share * found.true_area) - 1))
    return {
        "surface_miou": float(np.mean(ious)) if ious else None,
        "class_area_error": float(max(off)) if off else None,
    }


def classes_at(surface: Surface, painted: Painted, points: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Class (N,) at points (N, 3) of a mesh, which lie in its faces (N,)."""
    if painted.maps is None or painted.uv is None:
        return surface.face_class[face]
    weights = points_to_barycentric(surface.vertices.astype(np.float64)[surface.faces[face]], points)
    uv = np.einsum("nk,nkc->nc", weights, painted.uv.corners[face])
    size = len(painted.maps.ids)
    x, y = np.clip((uv * [1, -1] + [0, 1]) * size, 0, size - 1).astype(int).T
    return painted.maps.ids[y, x]


def picture_figures(
    mesh: tuple[np.ndarray, np.ndarray], painted: Painted, views: Sequence[View]
) -> dict[str, float | None]:
    """PSNR of the textured mesh against photos where it is hit, the median difference of colour (CIEDE2000), and its gradient
    energy over theirs."""
    if painted.uv is None or painted.image is None or not views:
        return {"mesh_psnr": None, "delta_e": None, "gradient": None}
    psnr, off, energy = [], [], np.zeros(2)
    for view, camera in zip(views, posed(views)):
        picture, hit = surface_picture(camera, *mesh, painted.uv.corners, painted.image)
        photo = resized(photo_of(view), view.camera.width, view.camera.height).pixels[..., :3]
        covered = hit > 0.99
        error = (picture.astype(float) - photo)[covered] / 255
        psnr.append(-10 * np.log10(max(float((error**2).mean()), 1e-10)))
        ours, theirs = (rgb2lab(p[covered] / 255.0) for p in (picture, photo))
        off.append(deltaE_ciede2000(ours, theirs))
        inner = minimum_filter(covered, 3)
        energy += [(np.hypot(*np.gradient(p.astype(float).mean(2)))[inner] ** 2).sum() for p in (picture, photo)]
    return {
        "mesh_psnr": float(np.mean(psnr)),
        "delta_e": float(np.median(np.concatenate(off))),
        "gradient": float(energy[0] / max(energy[1], 1e-9)),
    }


def seam_ratio(faces: np.ndarray, painted: Painted) -> float | None:
    """Mean difference of colour (CIEDE2000) across the seams of a texture over that across other edges of the mesh, each
    between places one texel and a half from the edge."""
    if painted.uv is None or painted.image is None or not len(painted.uv.seams):
        return None
    corners, size = painted.uv.corners.astype(np.float64), painted.image.shape[0]
    ends = edge_ends(faces)
    middle = ((corners + corners[:, [1, 2, 0]]) / 2).reshape(-1, 2)
    inward = np.repeat(corners.mean(1), 3, 0) - middle
    place = middle + inward * np.minimum(1.5 / size / np.maximum(np.linalg.norm(inward, axis=1), 1e-12), 1)[:, None]
    x, y = np.clip((place * [1, -1] + [0, 1]) * size, 0, size - 1).astype(int).T
    lab = rgb2lab(painted.image[y, x] / 255.0)
    span = int(faces.max()) + 1
    key = ends[:, 0].astype(np.int64) * span + ends[:, 1]
    order = np.argsort(key, kind="stable")
    pair = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    one, two = order[pair], order[pair + 1]
    off = deltaE_ciede2000(lab[one], lab[two])
    cut = np.sort(painted.uv.seams, 1).astype(np.int64)
    seam = np.isin(key[one], cut[:, 0] * span + cut[:, 1])
    return float(off[seam].mean() / max(off[~seam].mean(), 1e-9)) if seam.any() else None
