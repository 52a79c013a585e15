"""Projects with a mesh that was never extracted: as the verbs `train` and `mesh` would have left them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from fieldwork.nerfcore.config import RunConfig
from fieldwork.nerfcore.mesh.instances import GAP, find_instances, write_instances
from fieldwork.nerfcore.mesh.stored import COARSE, MESH, mesh_folder
from fieldwork.nerfcore.mesh.surface import Surface, vertex_normals
from fieldwork.nerfcore.project.fingerprints import alignment, write_made
from fieldwork.nerfcore.project.runs import INFO, MESH_RECORD, run_folder
from fieldwork.nerfcore.project.schema import Project, SemanticClass, step
from fieldwork.nerfcore.project.store import edit_project, load_project, save_project
from fieldwork.nerfcore.render.run import RunInfo

CLASSES = [
    SemanticClass(id=1, name="floor", color=(0.6, 0.6, 0.55)),
    SemanticClass(id=2, name="wall", color=(0.9, 0.62, 0.0)),
    SemanticClass(id=3, name="plinth", color=(0.34, 0.71, 0.91)),
]


def store_mesh(
    folder: Path,
    mesh: trimesh.Trimesh,
    face_class: np.ndarray,
    coarse: trimesh.Trimesh,
    voxel: float,
    colors: np.ndarray | None = None,
    metric: bool = True,
) -> None:
    """Put a run "main" and its mesh in the world into a project, whose scale is `metric`."""
    with edit_project(folder) as edited:
        edited.frame.scale_known = metric
    target = mesh_folder(folder, "main")
    target.mkdir(parents=True)
    project = load_project(folder)
    info = RunInfo(
        preset="draft",
        config=RunConfig.model_validate({"scene": {"image_size": 48}}),
        class_ids=[c.id for c in project.classes],
        priorities=[1.0] * len(project.classes),
        images=[],
        sfm_from_box=np.eye(4).tolist(),
        contracted=False,
        transparent=True,
    )
    run_folder(folder, "main").mkdir(parents=True)
    (run_folder(folder, "main") / INFO).write_text(info.model_dump_json())
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    names = {c.id: c.name for c in project.classes}
    face_instance, found = find_instances(vertices, faces, face_class, names, project.ignore_id, GAP * voxel)
    write_instances(target, found)
    class_id = np.zeros(len(vertices), int)
    class_id[faces] = face_class[:, None]
    grey = np.full((len(vertices), 3), 128, np.uint8)
    normals = vertex_normals(vertices, faces)
    surface = Surface(vertices, faces, normals, grey if colors is None else colors, class_id, face_class, face_instance)
    np.savez(target / MESH, **vars(surface))
    np.savez(target / COARSE, vertices=coarse.vertices, faces=coarse.faces)
    inputs = {"alignment": alignment(project)}
    write_made(target / MESH_RECORD, step("mesh", {}, {"voxel": voxel}, inputs))


def court(folder: Path, metric: bool = True) -> Path:
    """A project with the mesh of a floor of 4 × 3 m, a wall of 4 × 2.5 m at its back (y = 3) and two plinths on it: one of
    1 × 1 × 1 m at x, y = 0.5 … 1.5, one of 0.5 × 0.5 × 1.5 m at x = 2.75 … 3.25, y = 1 … 1.5."""
    save_project(folder, Project(classes=CLASSES))
    parts = [
        trimesh.creation.box(bounds=[[0, 0, -0.1], [4, 3, 0]]),
        trimesh.creation.box(bounds=[[0, 3, 0], [4, 3.1, 2.5]]),
        trimesh.creation.box(bounds=[[0.5, 0.5, 0.001], [1.5, 1.5, 1]]),
        trimesh.creation.box(bounds=[[2.75, 1, 0.001], [3.25, 1.5, 1.5]]),
    ]
    fine = [part.subdivide_to_size(0.12) for part in parts]
    labels = np.repeat([1, 2, 3, 3], [len(part.faces) for part in fine])
    mesh = trimesh.util.concatenate(fine)
    x, y, z = np.asarray(mesh.vertices).T
    waves = 0.5 + 0.2 * np.stack([np.sin(6 * x + z), np.sin(5 * y + 2 * z), np.cos(4 * x - 3 * z)], 1)
    store_mesh(folder, mesh, labels, trimesh.util.concatenate(parts), 0.02, (waves * 255).astype(np.uint8), metric)
    return folder
