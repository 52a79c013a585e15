"""The verb `label prepare`: what labelling needs of a trained field, made once and read from disk.

runs/RUN/surfels/   prepared.json (what it was made from), and arrays as .npy files, read memory-mapped:
    position, normal, lab, texture, planarity, field, height, pixels   see Surfels
    neighbours (N, K) int32     nearest surfels
    features (N, F)             columns by which surfels are told apart, see graph.py
    photo_features (N, G)       more of them, of the photos: see photo_features.py
    cell, edges_…, coarse_…     see Graph; of a matrix its data, indices and indptr
    parts (N, 2) int32          see parts.py
    part_features (P, F + G)    mean columns of the fine parts, and part_edges_…, the weights between them
    pixel_surfel (P,) int32     surfel that each pixel of each photo's map shows, −1 for none; maps one after the other
    pixel_edge (P,) bool        pixels at depth edges, whose marks are dropped
"""

from __future__ import annotations

import json
import shutil
import time
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import skimage
import torch

from ..data.box import Box, box_poses
from ..data.load import load_scene
from ..data.photo import photo_of
from ..data.pixels import training_size
from ..data.scene import Scene, View
from ..errors import InputError, TrainingError
from ..files import disk_errors, write_json
from ..geometry.contraction import grid_position, uncontract
from ..geometry.similarity import similarity_scale, transform_points
from ..images.picture import over, resized
from ..images.working import nearest, read_image
from ..params import LabelPrepareParams
from ..progress import Reporter
from ..project.fingerprints import digest, rounded
from ..project.runs import geometry_id, run_folder
from ..project.store import load_project, world_from_sfm
from ..render.run import Trained, load_info, load_trained, refined_poses
from ..render.sparse_rays import sparse_rays
from .graph import Graph, feature_columns, joined, make_graph, unlikeness
from .likeness import likeness
from .lookup import RECORD, UNREADABLE, part_of, photo_maps
from .lookup import SURFELS as FOLDER
from .models import load
from .parts import surface_parts
from .photo_features import identity, photo_features
from .rays import Hits, hits_of
from .surfels import (
    AROUND,
    Surfels,
    by_colour,
    cell_of,
    field_features,
    means,
    most_alike,
    nearest_neighbours,
    nearest_surfel,
    shape_at,
)
from .tokens import TokenModel

COUNT = 200_000
CPU_SIDE, GPU_SIDE = 480, 1600  # longest side of a map
CPU_PIXELS, GPU_PIXELS = 4e6, 1e8  # of all maps together
CPU_SHARE = 0.5  # of a map's side that rays are rendered for on a CPU
LEAST_SURFELS = 64
PIXELS_EACH = 4  # at least, in the mean: what a surfel of one pixel looks like is noise
TELLING = 7  # pixels of a surfel, in the mean, from which on its colour says where it ends
VERSION = 9  # of what is made; another one makes it again
MATRIX = ("data", "indices", "indptr")


class Preparation:
    """A prepared run, its arrays memory-mapped; `seconds`: how long it was made."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError, ValueError or KeyError where the folder holds no whole preparation."""
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        self.folder, self.inputs, self.seconds = folder, record["inputs"], float(record["seconds"])
        self.of_photo = photo_maps(record)
        self.photos = list(self.of_photo.values())
        self.surfels = Surfels(**{name: self._array(name) for name in Surfels.__dataclass_fields__})
        self.neighbours, self.features = self._array("neighbours"), self._array("features")
        self.photo_features = self._array("photo_features")
        self.cell, self.parts = self._array("cell"), self._array("parts")
        self.part_features = self._array("part_features")
        self.pixel_surfel, self.pixel_edge = self._array("pixel_surfel"), self._array("pixel_edge")

    def _array(self, name: str) -> np.ndarray:
        return np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)

    def map_of(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Surfel (H, W) int32 of each pixel of a photo's map, −1 for none, and whether it is at a depth edge (H, W).

        Raises:
            InputError: the photo has no pose.
        """
        photo = self.of_photo.get(name)
        if photo is None:
            raise InputError(f"The photo “{name}” has no pose.", "Choose another photo, or run `fieldwork poses`.")
        return part_of(self.pixel_surfel, photo), part_of(self.pixel_edge, photo)

    def columns(self, surfels: np.ndarray | slice) -> torch.Tensor:
        """What some surfels look like (S, F + G): columns of the surface and of the photos."""
        return torch.from_numpy(np.concatenate([self.features[surfels], self.photo_features[surfels]], 1))

    @cached_property
    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 3) and unit normals (N, 3) of the surfels in the world."""
        project, run = self.folder.parents[2], self.folder.parent.name
        box = load_info(project, run).box(load_project(project))
        position = torch.from_numpy(np.array(self.surfels.position, np.float64))
        inside = uncontract(position) if box.contracted else position * 2 - 1
        rotation = box.world_from_box[:3, :3] / similarity_scale(box.world_from_box)
        return transform_points(box.world_from_box, inside.numpy()), np.asarray(self.surfels.normal) @ rotation.T

    @cached_property
    def tree(self) -> scipy.spatial.KDTree:
        """The places of the surfels in the world, to be searched."""
        return scipy.spatial.KDTree(self.world[0])

    @cached_property
    def graph(self) -> Graph:
        """The graph of the surfels."""
        return Graph(self._matrix("edges"), self._matrix("coarse"), np.array(self.cell))

    @property
    def conductance(self) -> float:
        """What the edges of a surfel conduct together, in the mean."""
        return float(self._array("edges_data").sum(dtype=np.float64)) / max(1, len(self.surfels))

    @cached_property
    def likeness(self) -> tuple[scipy.sparse.csr_matrix, float]:
        """Which fine parts look alike, as `likeness.likeness` says it."""
        return self._matrix("likeness"), float(self._array("likeness_scale").item())

    @cached_property
    def part_edges(self) -> scipy.sparse.csr_matrix:
        """Weights (P, P) between the fine parts."""
        return self._matrix("part_edges")

    def _matrix(self, name: str) -> scipy.sparse.csr_matrix:
        parts = [np.array(self._array(f"{name}_{part}")) for part in MATRIX]
        count = len(parts[2]) - 1
        return scipy.sparse.csr_matrix(tuple(parts), (count, count))


def prepare(params: LabelPrepareParams, report: Reporter) -> dict[str, Any]:
    """Prepare a run for labelling, unless that was done since it was trained.

    Returns:
        {"surfels", "photos", "pixels", "seconds", "reused", "folder"}
    Raises:
        ProjectError: there is no trained run. TrainingError: the field shows no surface. InputError: the model of features
        does not fit. DiskError, Cancelled.
    """
    folder, begin = Path(params.project), time.perf_counter()
    ready, reused = ensured(folder, params.run, report, params.surfels, params.features)
    return {
        "surfels": len(ready.surfels),
        "photos": len(ready.photos),
        "pixels": len(ready.pixel_surfel),
        "seconds": round(time.perf_counter() - begin, 2),
        "reused": reused,
        "folder": str(ready.folder),
    }


def ensured(
    folder: Path, run: str, report: Reporter, count: int | None = None, features: Path | None = None
) -> tuple[Preparation, bool]:
    """The preparation of a run, made where there is none of its present field; whether it was there already.

    Args:
        count: number of surfels that is wanted; None: what is there, else the usual number. features: file of a model of
            features; None: the one that the preparation before was made with, if it is still there.
    Raises:
        as `prepare`.
    """
    ready = current(folder, run, count, features)
    if ready is not None:
        return ready, True
    if features is None:
        before = _stored(folder, run)
        used = None if before is None else before.inputs.get("features")
        features = Path(used[0]) if used and Path(used[0]).is_file() else None
    return _made(folder, run, report, count or COUNT, features), False


def current(folder: Path, run: str, count: int | None = None, features: Path | None = None) -> Preparation | None:
    """The preparation of a run's present field; None where there is none, or only one that is stale or damaged.

    `count`: number of surfels that is wanted; None: any. `features`: file of a model of features; None: any or none.
    """
    ready = _stored(folder, run)
    if ready is None:
        return None
    wanted = prepared_inputs(folder, run, ready.inputs.get("surfels") if count is None else count, features)
    if features is None:
        wanted["features"] = ready.inputs.get("features")
    return ready if ready.inputs == wanted else None


def _stored(folder: Path, run: str) -> Preparation | None:
    try:
        return Preparation(run_folder(folder, run) / FOLDER)
    except UNREADABLE:
        return None


def prepared_inputs(folder: Path, run: str, count: int | None, features: Path | None) -> dict[str, Any]:
    """What a preparation is made from: the field but for its classes, the cameras, how the world lies, and a model."""
    project = load_project(folder)
    scene = load_scene(folder)
    cameras = [[v.name, v.camera.model_dump(mode="json"), rounded(v.camera_to_world)] for v in scene.views]
    return {
        "version": VERSION,
        "trained field": geometry_id(folder, run),
        "cameras": digest([rounded(world_from_sfm(project)), cameras]),
        "surfels": count,
        "features": None if features is None else list(identity(features)),
    }


def _made(folder: Path, run: str, report: Reporter, count: int, features: Path | None) -> Preparation:
    begin = time.perf_counter()
    tokens = None if features is None else TokenModel(load(features))  # before the long work: it may not fit
    trained, project = load_trained(folder, run), load_project(folder)
    inputs = prepared_inputs(folder, run, count, features)
    scene, box = load_scene(folder, trained.info.holdout), trained.info.box(project)
    refined = refined_poses(folder, run, trained.info)
    given = box_poses(scene.views, box.box_from_world)
    poses = given.copy()
    for number, view in enumerate(scene.views):
        if view.name in refined:
            poses[number] = refined[view.name]
    sizes = map_sizes(scene, trained.device)
    report.stage("Rendering depth")
    pixels = float(sum(width * height for width, height in sizes))
    cameras = [view.camera.resized(*size) for view, size in zip(scene.views, sizes)]
    trained.model.refine(pixels, report.check, sparse_rays(cameras, poses, trained.device))
    seen = []
    for number, (view, pose, size) in enumerate(zip(scene.views, poses, sizes)):
        report.progress(number / len(sizes), view.name)
        seen.append(_look(view, pose, size, trained, report))
    report.stage("Making surfels")
    arrays = surfel_arrays(seen, poses[:, :3, 3], trained, box, count, report)
    pictures = list(zip(scene.views, maps_of(arrays, sizes), (lab for _, lab in seen)))
    arrays["photo_features"] = photo_features(len(arrays["position"]), pictures, tokens, report)
    columns = np.concatenate([arrays["features"], arrays["photo_features"]], 1)
    arrays["part_features"] = means(arrays["parts"][:, 0], int(arrays["parts"][:, 0].max()) + 1, columns).astype(
        np.float32
    )
    surface = arrays["part_features"][:, : arrays["features"].shape[1]]
    alike, scale = likeness(surface, report.check)
    arrays |= {**stored("likeness", alike), "likeness_scale": np.array(scale)}
    place = run_folder(folder, run) / FOLDER
    firsts = np.cumsum([0, *(width * height for width, height in sizes)])
    photos = [
        {"name": view.name, "width": width, "height": height, "first": int(first)}
        for view, (width, height), first in zip(scene.views, sizes, firsts)
    ]
    _write(place, arrays, {"inputs": inputs, "photos": photos, "seconds": round(time.perf_counter() - begin, 2)})
    return Preparation(place)


def maps_of(arrays: dict[str, np.ndarray], sizes: list[tuple[int, int]]) -> list[np.ndarray]:
    """Of each photo the surfel (H, W) of each pixel that is not at a depth edge, −1 for none."""
    clear = np.where(arrays["pixel_edge"], -1, arrays["pixel_surfel"])
    ends = np.cumsum([width * height for width, height in sizes])[:-1]
    return [own.reshape(height, width) for own, (width, height) in zip(np.split(clear, ends), sizes)]


def map_sizes(scene: Scene, device: torch.device) -> list[tuple[int, int]]:
    """Width and height of each photo's map, so that all together stay affordable."""
    side, most = (CPU_SIDE, CPU_PIXELS) if device.type == "cpu" else (GPU_SIDE, GPU_PIXELS)
    total = sum(w * h for w, h in (training_size(view.camera, side) for view in scene.views))
    longest = max(48, int(side * min(1.0, (most / total) ** 0.5)))
    return [training_size(view.camera, longest) for view in scene.views]


def _look(
    view: View, pose: np.ndarray, size: tuple[int, int], trained: Trained, report: Reporter
) -> tuple[Hits, np.ndarray]:
    """Hits of a photo's pixels, and its colours (H, W, 3) as CIE Lab; masked pixels hit nothing."""
    share = CPU_SHARE if trained.device.type == "cpu" else 1.0
    hits = hits_of(trained.model, view.camera.resized(*size), pose, share, report.check)
    if view.mask is not None:
        inside = nearest(read_image(view.mask)[..., 0], *size) > 127
        hits = Hits(np.where(inside, hits.distance, 0), hits.places, hits.edge & inside)
    color = over(resized(photo_of(view), *size), 1.0).pixels[..., :3]
    return hits, skimage.color.rgb2lab(color).astype(np.float32)


def surfel_arrays(
    seen: list[tuple[Hits, np.ndarray]],
    centers: np.ndarray,
    trained: Trained,
    box: Box,
    count: int,
    report: Reporter,
) -> dict[str, np.ndarray]:
    """The arrays of a preparation, from what each photo shows.

    Args:
        centers: (V, 3) of the photos' cameras in the normalised frame.
    Raises:
        TrainingError: the photos show next to nothing of the field.
    """
    solid = np.concatenate([hits.hit.reshape(-1) for hits, _ in seen])
    edge = np.concatenate([hits.edge.reshape(-1) for hits, _ in seen])
    places = np.concatenate([hits.places.reshape(-1, 3) for hits, _ in seen])
    lab = np.concatenate([color.reshape(-1, 3) for _, color in seen])
    photo = np.repeat(np.arange(len(seen)), [hits.distance.size for hits, _ in seen])
    clear = np.flatnonzero(solid & ~edge)
    grid = grid_position(torch.from_numpy(places), trained.model.contracted).numpy()
    number, surfels = cell_of(grid[clear], max(1, min(count, len(clear) // PIXELS_EACH)), report.check)
    if surfels < LEAST_SURFELS:
        raise TrainingError(
            f"The field shows no surface to label: the photos see {surfels} places of it.",
            "Train it longer (`fieldwork train`).",
        )
    report.progress(0.2)
    telling = len(clear) >= TELLING * surfels
    if telling:
        around = nearest_neighbours(means(number, surfels, grid[clear]), AROUND, report.check)
        number, surfels = by_colour(number, grid[clear], lab[clear], around, report.check)
    report.progress(0.3)
    position = means(number, surfels, grid[clear])
    normalised = means(number, surfels, places[clear])
    report.progress(0.35)
    towards = means(number, surfels, centers[photo[clear]]) - normalised
    report.progress(0.4)
    color = means(number, surfels, lab[clear])
    report.progress(0.45)
    texture = np.sqrt((means(number, surfels, lab[clear][:, :1] ** 2)[:, 0] - color[:, 0] ** 2).clip(0))
    neighbours = nearest_neighbours(position, check=report.check)
    report.progress(0.6)
    normal, planarity = shape_at(normalised, neighbours, towards)
    report.progress(0.7)
    made = Surfels(
        position=position.astype(np.float32),
        normal=normal,
        lab=color.astype(np.float32),
        texture=texture.astype(np.float32),
        planarity=planarity,
        field=field_features(trained.model.field, position),
        height=transform_points(box.world_from_box, normalised)[:, 2].astype(np.float32),
        pixels=np.bincount(number, minlength=surfels).astype(np.int32),
    )
    report.progress(0.8)
    unlike = unlikeness(made, neighbours)
    graph = make_graph(made, neighbours, unlike)
    report.progress(0.9)
    pixel_surfel = np.full(len(solid), -1, np.int32)
    pixel_surfel[clear] = number
    torn = solid & edge
    pixel_surfel[torn] = nearest_surfel(position, grid[torn])
    if telling:
        beside = pixel_surfel[torn]
        pixel_surfel[torn] = most_alike(beside, grid[torn], lab[torn], position, color, neighbours, report.check)
    parts = surface_parts(neighbours, unlike, report.check)
    matrices = {"edges": graph.edges, "coarse": graph.coarse, "part_edges": joined(graph.edges, parts[:, 0])}
    return {
        **vars(made),
        "neighbours": neighbours,
        "features": feature_columns(made, neighbours),
        "cell": graph.cell,
        "parts": parts,
        **{key: values for name, matrix in matrices.items() for key, values in stored(name, matrix).items()},
        "pixel_surfel": pixel_surfel,
        "pixel_edge": edge,
    }


def stored(name: str, matrix: scipy.sparse.csr_matrix) -> dict[str, np.ndarray]:
    """The arrays that a sparse matrix is kept as."""
    return {f"{name}_{part}": getattr(matrix, part) for part in MATRIX}


def _write(place: Path, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> None:
    """Write a preparation beside its place and move it there as a whole. Raises DiskError."""
    fresh = place.with_name(f".{place.name}")
    with disk_errors(place):
        shutil.rmtree(fresh, ignore_errors=True)
        try:
            fresh.mkdir(parents=True)
            for name, values in arrays.items():
                np.save(fresh / f"{name}.npy", np.ascontiguousarray(values), allow_pickle=False)
            write_json(fresh / RECORD, record)
            shutil.rmtree(place, ignore_errors=True)
            fresh.rename(place)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
