"""How much of the photos a mesh fills."""

from __future__ import annotations

import numpy as np

from ..geometry.cameras import rays
from ..kernels.raycast import FrontFaces
from .photos import Photo

MOST_PHOTOS, ACROSS = 16, 48  # photos that are asked, evenly spread, and rays across each


def shown_share(photos: list[Photo], vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share of the photos' pixels that show the front of a mesh, vertices (V, 3) and faces (F, 3) in the photos' frame."""
    if len(faces) == 0 or not photos:
        return 0.0
    mesh = FrontFaces(vertices, faces)
    hits = asked = 0
    for index in np.unique(np.linspace(0, len(photos) - 1, min(len(photos), MOST_PHOTOS)).round().astype(int)):
        camera, pose = photos[index].view.camera, photos[index].view.pose
        x = (np.arange(ACROSS) + 0.5) / ACROSS
        places = np.stack(np.meshgrid(x * camera.width, x * camera.height), -1).reshape(-1, 2)
        directions, valid = rays(camera, places)
        turned = directions[valid] @ pose[:3, :3].T
        face, _ = mesh.cast(np.broadcast_to(pose[:3, 3], turned.shape), turned)
        hits, asked = hits + int((face >= 0).sum()), asked + len(turned)
    return hits / max(asked, 1)
