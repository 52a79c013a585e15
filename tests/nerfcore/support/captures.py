"""Ingesting and posing real captures, and comparing them with the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from fieldwork.nerfcore.capture.ingest import new
from fieldwork.nerfcore.data.importer import read_dataset
from fieldwork.nerfcore.data.similarity import fit_similarity, transform_points
from fieldwork.nerfcore.params import NewParams, PosesParams
from fieldwork.nerfcore.poses.estimate import estimate_poses
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project import load_poses

Data = Callable[[str], Path]


def ingest(photos: Path, project: Path, **settings: object) -> Path:
    new(NewParams(photos=photos, project=project, **settings), Reporter())  # type: ignore[arg-type]
    return project


def poses(project: Path, preset: str = "fast", **settings: object) -> dict:
    return estimate_poses(PosesParams(project=project, preset=preset, **settings), Reporter())  # type: ignore[arg-type]


def centre_errors(project: Path, dataset: Path) -> np.ndarray:
    """Errors of camera centres after the best similarity, in per cent of the extent of the true ones."""
    truth = {view.name: view.camera_to_world[:3, 3] for view in read_dataset(dataset).views}
    found = {image.name: np.array(image.camera_to_world)[:3, 3] for image in load_poses(project).images}
    a, b = np.stack([found[name] for name in sorted(found)]), np.stack([truth[name] for name in sorted(found)])
    misfit = np.linalg.norm(transform_points(fit_similarity(a, b), a) - b, axis=1)
    return 100 * misfit / np.linalg.norm(np.ptp(b, axis=0))
