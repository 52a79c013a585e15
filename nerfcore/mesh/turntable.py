"""Pictures of a mesh from all around, to look at: its colours and its classes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..files import atomic_path, require_writable, staged
from ..geometry.cameras import Camera, pixel_centers, rays
from ..geometry.orbit import orbit_angles
from ..images.encode import write_picture
from ..images.picture import linear_to_srgb, to_bytes
from ..kernels.raycast import FrontFaces
from ..params import TurntableParams
from ..progress import Reporter
from ..project.store import load_project, record_step
from .parts import Texture
from .stored import load_class_map, load_surface, mesh_folder
from .surface import Surface
from .surface_picture import TexturedMesh
from .triangles import areas, cross

VIEWS, SIDE = 8, 640
ELEVATION = np.radians(30)
DIRECTIONS, LEAST_FRONT = 72, 0.4  # angles that are asked, and share of the most front seen from any, for a view
LENS = 1.4  # focal length over the picture's side
FAR_OFF = 0.01  # share of the area at either end of an axis that may be out of sight,
MUCH = 0.75  # where what is between has less than this share of the size,
ROOM = 0.1  # and so much of its own size in sight around it
MARGIN = 0.03  # of the picture's side, left free around the mesh
BACKGROUND = 70
UNKNOWN = (0.15, 0.15, 0.15)  # of a class without a colour
CLAY = (0.75, 0.75, 0.75)  # of everything where there are no classes: only the shape is to be seen
LIGHT = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])


def outwards(angle: np.ndarray) -> np.ndarray:
    """Unit vectors (…, 3) towards cameras at angles (…) about the z axis."""
    flat = np.cos(ELEVATION)
    return np.stack([np.cos(angle) * flat, np.sin(angle) * flat, np.full(np.shape(angle), np.sin(ELEVATION))], -1)


def front_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Angles (N,) about the z axis from which much of a mesh shows its front, and not the back of what stands before it."""
    angles = np.linspace(-np.pi, np.pi, DIRECTIONS, endpoint=False)
    normals = cross(vertices, faces)
    # One angle after the other: all at once would take a gigabyte for a million triangles.
    facing = np.array([np.maximum(normals @ outward, 0).sum() for outward in outwards(angles)])
    return angles[facing >= LEAST_FRONT * facing.max()]


def framed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The vertices (N, 3) that pictures of a mesh are to show: all, or, where a little of it is far off and would make the rest
    small, those of the rest."""
    area = np.bincount(faces.reshape(-1), np.repeat(areas(vertices, faces), 3), len(vertices))
    low, high = (np.array([_quantile(axis, area, share) for axis in vertices.T]) for share in (FAR_OFF, 1 - FAR_OFF))
    size, whole = (high - low).max(), (vertices.max(0) - vertices.min(0)).max()
    if size >= MUCH * whole:
        return vertices
    return vertices[((vertices >= low - ROOM * size) & (vertices <= high + ROOM * size)).all(1)]


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """The value (N,) below which this share of the weights (N,) lies."""
    order = np.argsort(values)
    return float(
        values[order][np.searchsorted(np.cumsum(weights[order]), share * weights.sum()).clip(max=len(values) - 1)]
    )


def turntable_poses(vertices: np.ndarray, faces: np.ndarray, count: int) -> list[np.ndarray]:
    """Camera-to-world poses (4, 4) in a ring around a mesh with z up, or on an arc before one that has a front alone, as
    near as all of it (`framed`) is in every picture."""
    angles, vertices = front_angles(vertices, faces), framed(vertices, faces)
    middle = (vertices.min(0) + vertices.max(0)) / 2
    turns, distance = [], 0.0
    for angle in orbit_angles(angles, count):
        outward = outwards(angle)
        right = np.array([-np.sin(angle), np.cos(angle), 0])
        turn = np.stack([right, np.cross(-outward, right), -outward], 1)
        x, y, z = ((vertices - middle) @ turn).T
        # LENS · |x| / (distance + z) is at most half the picture's side, less its margin.
        needed = np.maximum(np.abs(x), np.abs(y)) * LENS / (0.5 - MARGIN) - z
        distance = max(distance, float(needed.max()))
        turns.append(turn)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = middle - distance * poses[:, :3, 2]
    return list(poses)


def turntable(params: TurntableParams, report: Reporter) -> dict[str, Any]:
    """Look at the mesh of a run from all around, as `mesh` left it.

    Returns:
        {"files"}
    Raises:
        ProjectError: there is no mesh. DiskError.
    """
    folder = Path(params.project)
    project = load_project(folder)
    target = params.out or mesh_folder(folder, params.run) / "turntable"
    require_writable(target / "color_0.png")
    report.stage("Reading the mesh")
    surface, texture = load_surface(folder, params.run)
    report.stage("Looking at it")
    class_map = None if texture is None else load_class_map(folder, params.run)
    colors = {c.id: c.color for c in project.classes}
    files = write_turntable(target, surface, texture, colors, report, class_map)
    result = {"files": [str(path) for path in files]}
    record_step(folder, "turntable", params.model_dump(mode="json"), result)
    return result


def write_turntable(
    folder: Path,
    surface: Surface,
    texture: Texture | None,
    colors: dict[int, tuple[float, float, float]],
    report: Reporter,
    class_map: np.ndarray | None = None,
) -> list[Path]:
    """Write the pictures of `look_around` as color_0.png … and class_0.png …; all of them, or none where it is stopped.

    Returns:
        the files written.
    """
    pictures = look_around(surface, texture, colors, report, class_map)
    with staged(folder) as place:
        write_pictures(place, pictures, report)
    return [folder / name for name in pictures]


def write_pictures(folder: Path, pictures: dict[str, np.ndarray], report: Reporter) -> list[Path]:
    """Write pictures (H, W, 3) uint8 by the names of their files and return these. Raises DiskError, Cancelled."""
    for name, picture in pictures.items():
        report.check()
        with atomic_path(folder / name) as temporary:
            write_picture(temporary, picture)
    return [folder / name for name in pictures]


def look_around(
    surface: Surface,
    texture: Texture | None,
    colors: dict[int, tuple[float, float, float]],
    report: Reporter,
    class_map: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Eight views (SIDE, SIDE, 3) uint8 of a surface in the world by the names of their files, in its colours and in those
    of its classes, triangles seen from their front only, as one looks into a room without its near walls; of what has a front alone, as a facade, views of that.

    Args:
        texture: of the surface; without one its vertices' colours are shown. class_map: class (S, S) of each texel of the
            texture; without one the faces' are shown. colors: sRGB in [0, 1] of each class id; others are dark, but light where there is none at all.
    """
    mesh = FrontFaces(surface.vertices, surface.faces)
    textured, uv = None, None
    if texture is not None:
        uv = texture.unwrapped.uv[texture.unwrapped.faces]
        textured = TexturedMesh(surface.vertices, surface.faces, uv, texture.image)
    camera = Camera(width=SIDE, height=SIDE, fx=LENS * SIDE, fy=LENS * SIDE, cx=SIDE / 2, cy=SIDE / 2)
    local, _ = rays(camera, pixel_centers(SIDE, SIDE).reshape(-1, 2))
    pictures: dict[str, np.ndarray] = {}
    unknown = UNKNOWN if colors else CLAY
    for number, pose in enumerate(turntable_poses(surface.vertices, surface.faces, VIEWS)):
        report.progress(number / VIEWS)
        face, corner = mesh.cast(np.broadcast_to(pose[:3, 3], local.shape), local @ pose[:3, :3].T)
        hit = face >= 0
        weights = np.concatenate([corner, 1 - corner.sum(1, keepdims=True)], 1)[hit]
        corners = surface.faces[face[hit]]
        color, label = (np.full((SIDE * SIDE, 3), BACKGROUND, np.uint8) for _ in range(2))
        if textured is None:
            color[hit] = _mixed(surface.colors[corners], weights).clip(0, 255)
        else:
            away = np.linalg.norm(_mixed(surface.vertices[corners], weights) - pose[:3, 3], axis=1)
            color[hit] = to_bytes(linear_to_srgb(textured.light(face[hit], weights, away / camera.fx).numpy()))
        light = 0.55 + 0.45 * (_mixed(surface.normals[corners], weights) @ LIGHT)[:, None]
        ids = surface.face_class[face[hit]]
        if class_map is not None and uv is not None:
            size = len(class_map)
            x, y = np.clip((_mixed(uv[face[hit]], weights) * [1, -1] + [0, 1]) * size, 0, size - 1).astype(int).T
            ids = class_map[y, x]
        shown, number_of = np.unique(ids, return_inverse=True)
        shades = np.array([colors.get(int(c), unknown) for c in shown]).reshape(-1, 3) * 255
        label[hit] = (shades[number_of] * light).clip(0, 255)
        for name, picture in (("color", color), ("class", label)):
            pictures[f"{name}_{number}.png"] = picture.reshape(SIDE, SIDE, 3)
    return pictures


def _mixed(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Means (N, C) of the corners' values (N, 3, C) by their weights (N, 3)."""
    return np.einsum("nkc,nk->nc", values, weights)
