"""The suite `surface`: of each trained field the textured mesh that a user would ask for, and what it is worth.

The mesh is compared with the true surface of the simulated scene (`surface_figures.py`) at the size it is delivered.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.similarity import transform_points
from ..mesh.build import build
from ..mesh.painted import training_photos
from ..mesh.parts import texture_of
from ..mesh.region import on_sides
from ..mesh.surface import Surface, to_world
from ..mesh.turntable import write_turntable
from ..mesh.verb import paint
from ..params import MeshParams
from ..progress import Reporter
from ..project.store import load_project
from ..render.run import load_trained, scene_as_trained
from .jobs import Job
from .machine import peak_memory
from .surface_exposure import exposure_cost
from .surface_figures import Truth, surface_figures

FACES = 200_000
THIN = {"fence": 1}  # class of the plate whose two sides are looked for, by scene
BODIES = {"vase": ((1, 2), (3,))}  # classes of the closed bodies whose volumes are compared, by scene


class StageClock(Reporter):
    """Passes on what it hears, and adds up the processor seconds of each stage, those of ended child processes included."""

    def __init__(self, outer: Reporter) -> None:
        super().__init__()
        self.outer, self.seconds = outer, dict[str, float]()
        self._name, self._begin = "Preparing", processor_seconds()

    def stage(self, name: str) -> None:
        self.stop()
        self._name = name
        self.outer.stage(name)

    def stop(self) -> None:
        now = processor_seconds()
        self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._begin
        self._begin = now

    def progress(self, fraction: float, message: str = "") -> None:
        self.outer.progress(fraction, message)

    def warn(self, message: str) -> None:
        self.outer.warn(message)

    def check(self) -> None:
        self.outer.check()


def processor_seconds() -> float:
    """Of this process and its ended children so far."""
    return sum(os.times()[:4])


def truth_folder(root: Path, scene: str) -> Path:
    """Where `simulate` left the truth of a scene that `scenes.prepare` made in the folder of a benchmark."""
    return root / "captures" / scene / "ground_truth"


def read_truth(root: Path, scene: str) -> Truth:
    """The true surface of a scene.

    Raises:
        InputError: it is not known: the scene was not simulated here.
    """
    path = truth_folder(root, scene) / "mesh.npz"
    if not path.is_file():
        raise InputError(
            f"The true surface of {scene} is not known: {path} is not there.",
            "Choose scenes that `fieldwork simulate` makes; remove the scene's folder in projects to make it again.",
        )
    with np.load(path, allow_pickle=False) as truth:
        return Truth(truth["vertices"].astype(np.float64), truth["faces"], truth["face_class"])


def measure(job: Job, project: Path, report: Reporter, root: Path) -> dict[str, Any]:
    """Make the mesh of a job's field and compare it with the truth in the benchmark's folder `root`: the keys of
    `surface_table.FIGURES` but "psnr", and "stages" {name: processor seconds}. Pictures of it from all around are left in
    root/surface/pictures.

    Raises:
        InputError: the true surface is not known. TrainingError: there is no surface.
    """
    truth = read_truth(root, job.scene)
    clock, begin = StageClock(report), time.monotonic()
    known, trained = load_project(project), load_trained(project, job.name)
    scene, box = scene_as_trained(project, job.name, trained.info), trained.info.box(known)
    params = MeshParams(project=project, run=job.name, faces=FACES, texture="auto")
    built = build(trained, known, scene, params, clock)
    photos = training_photos(scene, box.box_from_world)
    painted = paint(trained, built, photos, params, scene.ignore_id, clock)
    clock.stop()
    duration = time.monotonic() - begin
    report.stage("Measuring the surface")
    classes, region = painted.classes, built.region
    made = Surface(built.vertices, built.faces, built.normals, built.colors, classes.class_id, classes.face_class)
    surface = to_world(made, box.world_from_box)
    figures = surface_figures(surface, painted, truth, scene, THIN.get(job.scene), BODIES.get(job.scene, ()))
    pictures = root / "surface" / "pictures" / job.name
    assert painted.uv is not None
    assert painted.image is not None
    figures["exposure_cost"] = exposure_cost(
        built.vertices,
        built.faces,
        photos,
        painted,
        (lambda points: transform_points(box.world_from_box, points), [scene.views[i] for i in scene.test]),
        report,
    )
    texture = texture_of(built.faces, painted.uv.corners, painted.image)
    class_map = painted.maps.ids if painted.maps else None
    write_turntable(pictures, surface, texture, {c.id: c.color for c in scene.classes}, report, class_map)
    figures |= {
        "border_faces": int(on_sides(built.vertices, built.faces, region, region.voxel / 2).sum()),
        "faces": len(built.faces),
        "texture": len(painted.image),
        "mesh_seconds": duration,
        "mesh_processor": sum(clock.seconds.values()),
        "memory_mb": peak_memory(),
    }
    return {**figures, "stages": {name: round(seconds, 1) for name, seconds in clock.seconds.items()}}
