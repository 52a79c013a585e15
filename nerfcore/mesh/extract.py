"""The surface of a trained field: marching cubes on its density, colours and classes at the vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace

import fast_simplification
import numpy as np
import torch
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes

from ..data.pixels import training_size
from ..errors import TrainingError
from ..field.encoding import spherical_harmonics
from ..geometry.cameras import Camera, project
from ..progress import Reporter
from ..render.image import render_view
from ..render.model import Model

CHUNK = 1 << 16
VISIBILITY_PIXELS = 160  # longest side of the depth images that decide what is visible


@dataclass(frozen=True)
class Surface:
    """A triangle mesh with attributes.

    vertices (V, 3), faces (F, 3), normals (V, 3) unit, outward; colors (V, 3) uint8 sRGB; class_id (V,) and
    face_class (F,) class ids.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    class_id: np.ndarray
    face_class: np.ndarray


def grid_from_normalised(points: torch.Tensor, contracted: bool) -> torch.Tensor:
    """Normalised positions inside the cube → grid coordinates in [0, 1]³ (the contraction is linear there)."""
    return points * (0.25 if contracted else 0.5) + 0.5


@torch.no_grad()
def density_volume(
    model: Model, resolution: int, low: np.ndarray, high: np.ndarray, report: Reporter
) -> tuple[np.ndarray, float]:
    """Density at the nodes of a regular grid between two corners of the normalised cube.

    Closed cells of the occupancy grid count as empty and are not evaluated.

    Returns:
        (x, y, z) volume and the spacing; the longest side has `resolution` cells.
    """
    device = model.priorities.device
    spacing = float((high - low).max()) / resolution
    counts = np.maximum(np.ceil((high - low) / spacing).astype(int) + 1, 2)
    axes = [torch.arange(n, device=device, dtype=torch.float32) * spacing + float(a) for n, a in zip(counts, low)]
    n = model.occupancy.config.resolution
    # An occupied cell occupies its neighbours: the surface may lie on its border.
    occupied = model.occupancy.cells[:, 0].view(1, 1, n, n, n) > 0
    occupied = torch.nn.functional.max_pool3d(occupied.float(), 3, 1, 1).reshape(-1) > 0
    volume = np.zeros(counts, np.float32)
    for index, x in enumerate(axes[0]):
        report.progress(index / counts[0])
        yz = torch.stack(torch.meshgrid(axes[1], axes[2], indexing="ij"), -1).reshape(-1, 2)
        points = torch.cat([torch.full_like(yz[:, :1], float(x)), yz], 1)
        u = grid_from_normalised(points, model.contracted).clamp(0, 1)
        cell = (u * n).long().clamp(max=n - 1)
        inside = occupied[(cell[:, 2] * n + cell[:, 1]) * n + cell[:, 0]].nonzero()[:, 0]
        plane = torch.zeros(len(points), device=device)
        for part in inside.split(CHUNK):
            plane[part] = model.field.density(u[part].contiguous())
        volume[index] = plane.view(counts[1], counts[2]).cpu().numpy()
    return volume, spacing


def surface_level(spacing: float) -> float:
    """Density at which a stretch of two cells is half opaque: ln 2 / (2 · spacing)."""
    return float(np.log(2) / (2 * spacing))


def extract(
    model: Model,
    resolution: int,
    low: np.ndarray,
    high: np.ndarray,
    class_ids: list[int],
    report: Reporter,
    views: list[tuple[Camera, np.ndarray]],
    faces: int | None = None,
) -> tuple[Surface, float]:
    """Surface in the normalised frame, and the spacing of the grid it was found on.

    Args:
        low, high: corners (3,) of the region within [−1, 1]³.
        class_ids: class id of each class index; empty without semantics (all vertices are then class 0).
        views: cameras and camera-to-box poses; connected parts that none of them sees (cavities) are dropped.
        faces: target number of triangles; None keeps all.
    Raises:
        TrainingError: the field has no surface there.
    """
    report.stage("Reading the density")
    volume, spacing = density_volume(model, resolution, low, high, report)
    report.stage("Extracting the surface")
    # The density rises by orders of magnitude at a surface; in the logarithm it is smooth enough to interpolate.
    smooth = ndimage.gaussian_filter(np.log(volume + 1e-2), 0.7)
    level = float(np.log(surface_level(spacing)))
    # A border of empty nodes closes the mesh where it meets the box.
    padded = np.pad(smooth, 1, constant_values=float(np.log(1e-2)))
    if not (padded > level).any():
        raise TrainingError("The field has no surface in the region of interest.", "Train longer, or check the box.")
    vertices, triangles, _, _ = marching_cubes(padded, level)
    vertices = (vertices - 1) * spacing + low
    mesh = trimesh.Trimesh(vertices, triangles[:, ::-1], process=False)
    report.stage("Cleaning the surface")
    mesh = drop_parts(mesh, visible_faces(model, mesh, views, 3 * spacing, report))
    if faces is not None and len(mesh.faces) > faces:
        report.stage("Simplifying")
        points, kept, *_ = fast_simplification.simplify(
            np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32), target_count=faces
        )
        mesh = trimesh.Trimesh(points, kept, process=False)
    if mesh.volume < 0:
        mesh.invert()
    report.stage("Reading colours and classes")
    colors, classes = shade(model, mesh.vertices, mesh.vertex_normals, class_ids, spacing, report)
    surface = with_face_classes(
        Surface(
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.int32),
            np.asarray(mesh.vertex_normals, np.float32),
            colors,
            classes,
            np.zeros(len(mesh.faces), np.int32),
        )
    )
    return surface, spacing


def visible_faces(
    model: Model, mesh: trimesh.Trimesh, views: list[tuple[Camera, np.ndarray]], tolerance: float, report: Reporter
) -> np.ndarray:
    """Which faces (F,) lie within `tolerance` of the depth that some view renders; small images are enough."""
    centers = mesh.triangles_center
    seen = np.zeros(len(centers), bool)
    for number, (camera, pose) in enumerate(views):
        report.progress(number / len(views))
        small = camera.resized(*training_size(camera, VISIBILITY_PIXELS))
        depth = render_view(model, small, pose, 0.0, semantics=False, check=report.check).depth
        local = (centers - pose[:3, 3]) @ pose[:3, :3]
        pixel = project(small, local)
        inside = np.isfinite(pixel).all(1) & (pixel >= 0).all(1) & (pixel < [small.width, small.height]).all(1)
        x, y = pixel[inside].astype(int).T
        seen[np.flatnonzero(inside)] |= local[inside, 2] < np.nan_to_num(depth[y, x], nan=-np.inf) + tolerance
    return seen


def drop_parts(mesh: trimesh.Trimesh, visible: np.ndarray, share: float = 0.01) -> trimesh.Trimesh:
    """Remove connected parts with less than `share` of the largest one's triangles (floaters) and parts of which
    less than a twentieth is visible (cavities inside solid things)."""
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    counts = np.bincount(labels)
    visible_enough = np.bincount(labels, visible) >= 0.05 * counts
    good = visible_enough & (counts >= max(share * counts[visible_enough].max(initial=0), 16))
    if good.all() or not good.any():
        return mesh
    used, inverse = np.unique(mesh.faces[good[labels]], return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], inverse.reshape(-1, 3), process=False)


@torch.no_grad()
def shade(
    model: Model, points: np.ndarray, normals: np.ndarray, class_ids: list[int], spacing: float, report: Reporter
) -> tuple[np.ndarray, np.ndarray]:
    """Colour (V, 3) uint8 and class id (V,) of surface points (V, 3) of the normalised frame with normals (V, 3).

    A point is seen from outside along its normal: the values are those of a short ray through the surface, so that
    they are the ones a camera would see.
    """
    device = model.priorities.device
    where = torch.from_numpy(np.array(points, np.float32)).to(device)
    outward = torch.from_numpy(np.array(normals, np.float32)).to(device)
    colors, classes = [], []
    offsets = torch.linspace(1.5, -2.5, 9, device=device) * spacing
    step = float(offsets[0] - offsets[1])
    for index, (p, n) in enumerate(zip(where.split(CHUNK // 8), outward.split(CHUNK // 8))):
        report.progress(min(index * CHUNK / 8 / max(len(where), 1), 1.0))
        positions = p[:, None] + n[:, None] * offsets[:, None]
        u = grid_from_normalised(positions.reshape(-1, 3), model.contracted).clamp(0, 1).contiguous()
        geometry = model.field.geometry(u)
        alpha = 1 - torch.exp(-geometry.density.view(len(p), -1) * step)
        before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1]], 1), 1)
        weight = alpha * before + 1e-6
        weight = (weight / weight.sum(1, keepdim=True))[..., None]
        facing = spherical_harmonics(-n).repeat_interleave(len(offsets), 0)
        color = model.field.color(geometry, facing).view(len(p), -1, 3)
        colors.append((color * weight).sum(1))
        if class_ids:
            probabilities = torch.softmax(model.field.logits(geometry), 1).view(len(p), len(offsets), -1)
            classes.append((probabilities * weight).sum(1).argmax(1))
    rgb = (torch.cat(colors).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    if not class_ids:
        return rgb, np.zeros(len(where), np.int32)
    return rgb, np.array(class_ids, np.int32)[torch.cat(classes).cpu().numpy()]


def with_face_classes(surface: Surface) -> Surface:
    """Give every face the class that most of its corners have (the first corner's when all differ)."""
    a, b, c = surface.class_id[surface.faces].T
    return replace(surface, face_class=np.where(b == c, b, a).astype(np.int32))
