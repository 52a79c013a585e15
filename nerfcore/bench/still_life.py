"""Small captures whose true areas and volumes are known: a block, a drum and a dome on a table, photographed with the
errors that photos have. No two seeds give the same things, cameras or errors.

Photos are rays against triangles: patterned matt surfaces under one light, without shadows, nothing around the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from ..geometry.cameras import Camera, pixel_centers, rays
from ..geometry.points import Points
from ..images.picture import linear_to_srgb, to_bytes
from ..kernels.raycast import FrontFaces
from ..mesh.triangles import areas, cross, unit
from ..project.schema import ImageRecord, PosedImage, Poses, Project, SemanticClass
from ..project.store import save_poses, save_project
from ..render.verb import look_at

PHOTOS, WIDTH, HEIGHT = 24, 160, 120
LENS = 1.25  # focal length over the picture's width
SAMPLES = 2  # rays a pixel, along each side
TABLE = 0.62  # half of its side, in metres
NAMES = ("table", "block", "drum", "dome")
COLORS = np.array([[0.55, 0.45, 0.35], [0.7, 0.25, 0.2], [0.2, 0.45, 0.65], [0.75, 0.65, 0.25]])
LIGHT = np.array([0.4, -0.3, 0.85])
# Standard deviations of the errors.
POSE_PIXELS = 0.2  # of a camera's direction; its place is off by as much of a pixel's footprint
LABEL_PIXELS = 0.5  # of a whole label map against its photo
STOPS = 0.1  # of a photo's exposure
NOISE = 0.006  # of a pixel, of its range
SCALE = 0.005  # of all lengths


@dataclass(frozen=True)
class StillLife:
    """The true surface in metres: vertices (V, 3), faces (F, 3), face_class (F,) numbering `NAMES` from 1; hidden (F,) bool:
    faces on which things stand, and what they stand on; volumes: of each class but the table, in m³."""

    vertices: np.ndarray
    faces: np.ndarray
    face_class: np.ndarray
    hidden: np.ndarray
    volumes: dict[int, float]

    def area(self, number: int) -> float:
        """Area in m² of what can be seen of a class other than the table."""
        shown = (self.face_class == number) & ~self.hidden
        return float(areas(self.vertices, self.faces[shown]).sum())


def still_life(seed: int) -> StillLife:
    """Things of a seed: sizes, places and turns differ."""
    random = np.random.default_rng(seed)
    size = random.uniform(0.85, 1.15, (3, 3))
    bow = np.linspace(0, np.pi / 2, 33)
    bodies = [
        trimesh.creation.box(bounds=[[-0.12, -0.1, 0], [0.12, 0.1, 0.26]]),
        trimesh.creation.cylinder(0.12, segment=[[0, 0, 0], [0, 0, 0.24]], sections=96),
        trimesh.creation.revolve(0.15 * np.stack([np.r_[0, np.cos(bow)], np.r_[0, np.sin(bow)]], 1), sections=96),
    ]
    parts = [trimesh.creation.box(bounds=[[-TABLE, -TABLE, -0.08], [TABLE, TABLE, 0]])]
    start = random.uniform(0, 2 * np.pi)
    for number, (body, factor) in enumerate(zip(bodies, size)):
        angle = start + 2 * np.pi * (number + random.uniform(-0.1, 0.1)) / 3
        body.apply_scale(factor if number == 0 else factor[0])
        body.apply_transform(trimesh.transformations.rotation_matrix(random.uniform(0, 2 * np.pi), [0, 0, 1]))
        body.apply_translation(random.uniform(0.3, 0.36) * np.array([np.cos(angle), np.sin(angle), 0]))
        parts.append(body)
    face_class = np.repeat(np.arange(len(parts)) + 1, [len(part.faces) for part in parts])
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + begin for part, begin in zip(parts, first)])
    hidden = (np.abs(vertices[faces][..., 2]) < 1e-9).all(1) & (face_class > 1)
    volumes = {number: float(part.volume) for number, part in enumerate(parts, 1) if number > 1}
    return StillLife(vertices, faces, face_class, hidden, volumes)


def pattern(points: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Linear colours (N, 3) of points (N, 3) of classes (N,) numbered from 1, with detail of 3 to 15 cm."""
    turn = np.random.default_rng(0).normal(size=(12, 3))
    wave = unit(turn) * np.geomspace(40, 200, 12)[:, None]
    waves = np.sin(points @ wave.T + number[:, None] * np.arange(12)) @ np.ones(12) / 6
    return COLORS[number - 1] * (0.75 + 0.35 * np.clip(waves, -1, 1))[:, None]


def photographed(truth: StillLife, folder: Path, seed: int, photos: int = PHOTOS, width: int = WIDTH) -> Path:
    """Write a project of photos of the true surface, with their label maps, cameras and known scale; each of them is off by
    what the constants above say."""
    random = np.random.default_rng([seed, 1])
    height = width * HEIGHT // WIDTH
    camera = Camera(width=width, height=height, fx=LENS * width, fy=LENS * width, cx=width / 2, cy=height / 2)
    mesh, factor = FrontFaces(truth.vertices, truth.faces), 1 + random.normal(scale=SCALE)
    for kind in ("images", "labels"):
        (folder / kind).mkdir(parents=True)
    images, posed, start = [], [], random.uniform(0, 2 * np.pi)
    for number in range(photos):
        turn = start + 2 * np.pi * (number + random.uniform(-0.3, 0.3)) / photos
        rise = np.radians((22, 42, 62)[number % 3] + random.uniform(-4, 4))
        away = 1.75 * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        pose = look_at(away, np.array([*random.uniform(-0.05, 0.05, 2), 0.06]))
        color, label = _drawn(mesh, truth, camera, pose, random)
        name = f"{number:02d}"
        Image.fromarray(color).save(folder / "images" / f"{name}.png")
        Image.fromarray(label).save(folder / "labels" / f"{name}.png")
        images.append(
            ImageRecord(name=name, file=f"images/{name}.png", label=f"labels/{name}.png", width=width, height=height)
        )
        claimed = _moved(pose, random, POSE_PIXELS / camera.fx, float(np.linalg.norm(away)))
        claimed[:3, 3] *= factor
        posed.append(PosedImage(name=name, camera=0, camera_to_world=claimed.tolist()))
    shades = np.clip(COLORS, 0, 1).tolist()
    classes = [SemanticClass(id=n, name=name, color=tuple(c)) for n, (name, c) in enumerate(zip(NAMES, shades), 1)]
    project = Project(images=images, classes=classes)
    project.frame.scale_known = True
    save_project(folder, project)
    save_poses(folder, Poses(source="simulated", cameras=[camera], images=posed), Points.empty())
    return folder


def _drawn(
    mesh: FrontFaces, truth: StillLife, camera: Camera, pose: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A photo (H, W, 4) uint8 sRGB, transparent around the table, and its label map (H, W) uint8, 0 there."""
    width, height = camera.width, camera.height
    fine = pixel_centers(width * SAMPLES, height * SAMPLES).reshape(-1, 2) / SAMPLES
    normals = unit(cross(truth.vertices, truth.faces))

    def cast(places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        directions = rays(camera, places)[0] @ pose[:3, :3].T
        face, corner = mesh.cast(np.broadcast_to(pose[:3, 3], directions.shape), directions)
        return face, np.concatenate([corner, 1 - corner.sum(1, keepdims=True)], 1), face >= 0

    face, weights, hit = cast(fine)
    points = np.einsum("nk,nkc->nc", weights[hit], truth.vertices[truth.faces[face[hit]]])
    shade = 0.55 + 0.45 * np.maximum(normals[face[hit]] @ LIGHT, 0)
    light = np.zeros((len(fine), 3))
    light[hit] = pattern(points, truth.face_class[face[hit]]) * shade[:, None] * 2 ** random.normal(scale=STOPS)
    shape = (height, SAMPLES, width, SAMPLES)
    share = hit.reshape(shape).mean((1, 3))
    mean = light.reshape(*shape, 3).mean((1, 3)) / np.maximum(share, 1e-9)[..., None]
    color = linear_to_srgb(np.clip(mean, 0, 1)) + random.normal(scale=NOISE, size=mean.shape)
    face, _, hit = cast(pixel_centers(width, height).reshape(-1, 2) + random.normal(scale=LABEL_PIXELS, size=2))
    label = np.where(hit, truth.face_class[np.maximum(face, 0)], 0).astype(np.uint8).reshape(height, width)
    return np.concatenate([to_bytes(color), to_bytes(share)[..., None]], 2), label


def _moved(pose: np.ndarray, random: np.random.Generator, angle: float, distance: float) -> np.ndarray:
    """A camera-to-world pose (4, 4) turned by small angles about each of its axes, and moved by as much of the distance."""
    small, moved = random.normal(scale=angle, size=3), pose.copy()
    moved[:3, :3] = pose[:3, :3] @ trimesh.transformations.euler_matrix(*small)[:3, :3]
    moved[:3, 3] += random.normal(scale=angle * distance, size=3)
    return moved
