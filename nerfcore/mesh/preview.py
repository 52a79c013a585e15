"""A first look at the surface of a run, in seconds: few small views, coarse cells, the field's own colours and classes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import SettingError
from ..files import atomic_path
from ..geometry.similarity import similarity_scale
from ..images.picture import to_bytes
from ..params import MeshParams
from ..progress import Reporter
from ..project.store import load_project
from ..render.run import Trained, load_trained, scene_as_trained
from . import depth_maps as dm
from .build import no_surface, wanted_bounds, wanted_sides
from .clean import drop_scraps
from .extract import extract
from .field_values import shade
from .fusion import fuse_maps
from .region import choose_region
from .surface import Surface, to_world, vertex_normals
from .triangles import compact

FILE = "preview.npz"  # in the exports of a run, with the arrays of mesh.npz
VIEWS, SIDE = 20, 128  # of the depth maps: how many, and pixels along the longest side
CELLS = 96  # along the longest side of the region


def preview(params: MeshParams, report: Reporter) -> dict[str, Any]:
    """Write a sketch of the surface to exports/<run>/preview.npz, in world units; the mesh that is there stays.

    Returns:
        {"vertices", "faces", "voxel": in world units, "preview": its file}
    Raises:
        TrainingError: the views agree on no surface, or there is none in the region. SettingError: files of the mesh were
        asked for, or an impossible region. ProjectError.
    """
    for option in ("out", "turntable"):
        if (path := getattr(params, option)) is not None:
            raise SettingError(
                f"A preview is written to {FILE} alone, and not to {path}.",
                f"Leave `--{option}` or `--preview` away.",
            )
    project, trained = load_project(params.project), load_trained(params.project, params.run)
    scene = scene_as_trained(params.project, params.run, trained.info)
    box = trained.info.box(project)
    bounds = wanted_bounds(params, scene, box)
    report.stage("A first look: depth maps")
    views = dm.spread_views([scene.views[i] for i in scene.train], VIEWS)
    flats = dm.flat_views(views, box.box_from_world, SIDE)
    maps = dm.confirmed_maps(flats, dm.depth_maps(trained.model, flats, report), trained.device, report)
    report.stage("A first look: surface")
    region = choose_region(maps, bounds, min(CELLS, params.resolution or CELLS))
    region = replace(region, sides=wanted_sides(params, scene, box))
    vertices, faces = extract(fuse_maps(maps, region, report), report)
    vertices, faces = compact(vertices, drop_scraps(vertices, faces)) if len(faces) else (vertices, faces)
    if not len(faces):
        raise no_surface(params)
    vertices, faces = vertices.astype(np.float32), faces.astype(np.int32)
    surface, confidence = _shaded(trained, vertices, faces, region.voxel, scene.ignore_id, report)
    surface = to_world(surface, box.world_from_box)
    target = params.project / "exports" / params.run / FILE
    with atomic_path(target) as temporary, open(temporary, "wb") as file:
        arrays = {name: values for name, values in vars(surface).items() if values is not None}
        np.savez(file, **arrays, confidence=confidence)
    voxel = region.voxel * similarity_scale(box.world_from_box)
    return {"vertices": len(vertices), "faces": len(faces), "voxel": voxel, "preview": str(target)}


def _shaded(
    trained: Trained, vertices: np.ndarray, faces: np.ndarray, voxel: float, void: int, report: Reporter
) -> tuple[Surface, np.ndarray]:
    """The surface with the field's colours and classes, and how sure (V,) the classes are."""
    normals = vertex_normals(vertices, faces)
    classes = bool(trained.model.field.classes)
    color, found = shade(trained.model, vertices, normals, classes, voxel, lambda _: report.check())
    ids, confidence = np.full(len(vertices), void, np.int32), np.zeros(len(vertices), np.float32)
    if found is not None:
        ids = np.array(trained.info.class_ids, np.int32)[found.argmax(1)]
        confidence = found.max(1).astype(np.float32)
    # A triangle has the class of two of its corners, or else that of the first.
    corners = ids[faces]
    face_class = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    return Surface(vertices, faces, normals, to_bytes(color), ids, face_class), confidence
