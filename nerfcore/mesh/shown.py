"""How much of the photos a mesh fills, and whether its silhouettes are those that masks cut out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..data.scene import Scene, View
from ..geometry.cameras import rays
from ..images.picture import resized
from ..images.working import MASK_UNKNOWN, nearest, read_image, read_picture
from ..kernels.raycast import FrontFaces
from ..progress import go_on
from .facelets import small_pieces
from .photos import Photo
from .visibility import PosedCamera, depth_buffer

CUT = 0.005  # of a mesh's size, up to which a side of the region that lies closer has cut it; not tuned
MOST_PHOTOS, ACROSS = 16, 48  # photos that are asked, evenly spread, and rays across each


def spread(count: int) -> list[int]:
    """Indices of at most `MOST_PHOTOS` of so many photos, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_PHOTOS)).round().astype(int)).tolist()


def cut_out(view: View, mask_mode: str) -> np.ndarray | None:
    """Which pixels (H, W) bool of a photo show the object that its mask or its transparency cuts out; None without."""
    width, height = view.camera.width, view.camera.height
    if view.mask is not None and mask_mode == "empty":
        return nearest(read_image(view.mask)[..., 0], width, height) > 127
    pixels = resized(read_picture(view.image), width, height).pixels
    if pixels.shape[2] < 4 or (pixels[..., 3] > 127).all():
        return None
    return pixels[..., 3] > 127


def _unknown(view: View) -> np.ndarray:
    """Which pixels (H, W) bool of a photo its mask does not know anything of."""
    width, height = view.camera.width, view.camera.height
    if view.mask is None:
        return np.zeros((height, width), bool)
    return nearest(read_image(view.mask)[..., 0], width, height) == MASK_UNKNOWN


def silhouette(
    scene: Scene,
    vertices: np.ndarray,
    faces: np.ndarray,
    check: Callable[[], None],
    region: tuple[np.ndarray, np.ndarray] | None = None,
) -> float | None:
    """Intersection over union of what held-out photos cut out (of all photos where none is held out) and what a mesh,
    vertices (V, 3) and faces (F, 3) in the scene's frame, covers there; None where nothing is cut out. Of a mesh of a region
    between two corners (3,) only where photos look into that; None where a side of it cuts the mesh, to `CUT` of its size, as
    photos show what lies beyond."""
    if region is not None and len(vertices):
        room = np.minimum(vertices - region[0], region[1] - vertices).min()
        if room < CUT * float(np.ptp(vertices, axis=0).max()):
            return None
    views = [scene.views[i] for i in scene.test or scene.train]
    pieces, box = small_pieces(vertices, faces), None if region is None else small_pieces(*box_surface(*region))
    both = either = 0
    for view in (views[i] for i in spread(len(views))):
        check()
        shown = cut_out(view, scene.mask_mode)
        if shown is None:
            continue
        camera = PosedCamera(view.camera, np.asarray(view.camera_to_world, np.float64))
        hit = depth_buffer(camera, pieces.vertices, pieces.faces).face >= 0
        counts = ~_unknown(view)
        if box is not None:
            counts &= depth_buffer(camera, box.vertices, box.faces).face >= 0
        both, either = both + int((hit & shown & counts).sum()), either + int(((hit | shown) & counts).sum())
    return both / either if either else None


def box_surface(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box between two corners (3,): vertices (8, 3) and triangles (12, 3), outward."""
    vertices = np.stack(np.meshgrid(*zip(low, high), indexing="ij"), -1).reshape(-1, 3)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([corners for a, b, c, d in sides for corners in ((a, b, c), (a, c, d))], np.int32)


def shown_share(
    photos: list[Photo], vertices: np.ndarray, faces: np.ndarray, check: Callable[[], None] = go_on
) -> float:
    """Share of the photos' pixels that show the front of a mesh, vertices (V, 3) and faces (F, 3) in the photos' frame."""
    if len(faces) == 0 or not photos:
        return 0.0
    mesh = FrontFaces(vertices, faces)
    hits = asked = 0
    for index in spread(len(photos)):
        check()
        camera, pose = photos[index].view.camera, photos[index].view.pose
        x = (np.arange(ACROSS) + 0.5) / ACROSS
        places = np.stack(np.meshgrid(x * camera.width, x * camera.height), -1).reshape(-1, 2)
        directions, valid = rays(camera, places)
        turned = directions[valid] @ pose[:3, :3].T
        face, _ = mesh.cast(np.broadcast_to(pose[:3, 3], turned.shape), turned)
        hits, asked = hits + int((face >= 0).sum()), asked + len(turned)
    return hits / max(asked, 1)
