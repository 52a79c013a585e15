"""The mesh of all blocks on disk, in the world: exports/blocks of the whole capture's project."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data.load import load_scene
from ..files import atomic_path
from ..geometry.similarity import similarity_scale
from ..mesh.features import features_of
from ..mesh.instances import GAP, find_instances, write_instances
from ..mesh.stored import MESH
from ..mesh.surface import class_table, to_world
from ..mesh.turntable import write_turntable
from ..progress import Reporter
from ..project.runs import read_metrics, run_folder
from .join import joined, open_at_seams
from .plan import Plan, block_folder
from .surface import RUN, load_part

NAME = "blocks"  # folder in exports


def write_whole(folder: Path, plan: Plan, out: Path | None, turntable: Path | None, report: Reporter) -> dict[str, Any]:
    """Join the surfaces of all blocks, number the instances over all of them, and write the mesh.

    Args:
        out: mesh file to write besides. turntable: folder for pictures.
    Returns:
        {"blocks": [{"name", "photos", "psnr_train", "faces"}], "vertices", "faces", "open_at_seams": edges, "voxel",
        "classes", "instances", "files"}
    Raises:
        ProjectError, SettingError, DiskError.
    """
    from ..mesh.files import write_surface  # with its libraries, a quarter of a second

    report.stage("Joining the blocks")
    parts = [load_part(folder, block) for block in plan.blocks]
    common = joined(parts)
    scene, voxel = load_scene(folder, 0), parts[0].voxel * similarity_scale(plan.world_from_common)
    surface = to_world(common, plan.world_from_common)
    names = {scene.ignore_id: "void"} | {c.id: c.name for c in scene.classes}
    numbers, instances = find_instances(
        surface.vertices, surface.faces, surface.face_class, names, scene.ignore_id, GAP * voxel
    )
    surface = replace(surface, face_instance=numbers)
    report.stage("Writing")
    target = folder / "exports" / NAME
    with atomic_path(target / MESH) as temporary, open(temporary, "wb") as file:
        np.savez(file, **vars(surface))
    files = [target / MESH, write_instances(target, instances)]
    features = features_of(surface, scene.classes, scene.ignore_id, instances)
    for path in [target / "mesh.ply", *([out] if out is not None else [])]:
        files += write_surface(path, surface, features, "none")
    if turntable is not None:
        report.stage("Looking at it")
        files += write_turntable(turntable, surface, None, {c.id: c.color for c in scene.classes}, report)
    return {
        "blocks": [_row(folder, plan, number, len(part.surface.faces)) for number, part in enumerate(parts)],
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "open_at_seams": open_at_seams(common, parts),
        "voxel": voxel,
        "classes": class_table(surface, names),
        "instances": len(instances),
        "files": [str(path) for path in files],
    }


def _row(folder: Path, plan: Plan, number: int, faces: int) -> dict[str, Any]:
    block = plan.blocks[number]
    trained = read_metrics(run_folder(block_folder(folder, block), RUN)).get("train", {})
    return {
        "name": block.name,
        "photos": len(block.images),
        "psnr_train": trained.get("psnr_train"),
        "faces": faces,
    }
