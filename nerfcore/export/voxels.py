"""The field on a regular grid of the world, as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..files import atomic_path
from ..geometry.similarity import make_similarity, similarity_scale
from ..mesh.field_values import density_volume, shade, surface_level
from ..progress import Reporter
from ..project.label_revision import label_facts
from ..project.schema import Project
from ..render.run import Trained


def write_voxels(path: Path, trained: Trained, project: Project, resolution: int, report: Reporter) -> None:
    """Write an .npz with the nodes of a grid of `resolution` cells along each side of the field's cube:

    density (X, Y, Z) float32 per world unit; color (X, Y, Z, 3) uint8 sRGB and class_id (X, Y, Z) int32, as seen from
    outside, 0 where it is empty; world_from_voxel (4, 4): indices of nodes to the world; class_ids, class_names;
    label_revision of the marks that they are from, if they are from any.
    """
    report.stage("Reading the density")
    volume, spacing = density_volume(trained.model, resolution, np.full(3, -1.0), np.full(3, 1.0), report)
    world_from_box = trained.info.box(project).world_from_box
    scale = similarity_scale(world_from_box)
    report.stage("Reading colours and classes")
    filled = np.argwhere(volume > 0.1 * surface_level(spacing))
    color = np.zeros((*volume.shape, 3), np.uint8)
    class_id = np.zeros(volume.shape, np.int32)
    if len(filled):
        slope = np.stack(np.gradient(np.log(volume + 1e-2)), -1)[tuple(filled.T)]
        normals = -slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
        places, semantics = filled * spacing - 1.0, trained.model.field.classes > 0
        found, probabilities = shade(trained.model, places, normals, semantics, spacing, report.progress)
        color[tuple(filled.T)] = (found * 255).round()
        if probabilities is not None:
            class_id[tuple(filled.T)] = np.array(trained.info.class_ids, np.int32)[probabilities.argmax(1)]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            density=volume / np.float32(scale),
            color=color,
            class_id=class_id,
            world_from_voxel=world_from_box @ make_similarity(spacing, np.eye(3), np.full(3, -1.0)),
            class_ids=np.array([c.id for c in project.classes], np.int32),
            class_names=np.array([c.name for c in project.classes], np.str_),
            **{fact: np.array(value) for fact, value in label_facts(trained.info.label_revision).items()},
        )
