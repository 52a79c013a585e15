"""A large capture cut into blocks that overlap: which part of the world each has, and which photos see it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from ..config import SceneConfig
from ..data.box import FEWEST_POINTS, choose_box
from ..data.scene import Scene
from ..errors import ProjectError, SettingError
from ..files import write_json
from ..geometry.cameras import project
from ..geometry.similarity import make_similarity, transform_points

FOLDER, PLAN = "blocks", "plan.json"
RUN = "main"  # of a block's project
MAPS, SIGHTS, PART = "depth_maps.npz", "sights.npz", "part.npz"  # in the run's folder
OVERLAP = 0.2  # of a block's width, that its region reaches beyond each side that it shares
LEAST_SEEN = 0.1  # share of what a photo shows that lies in a block, from which on it is one of the block's photos
FEWEST_PHOTOS = 2  # to train a block on
SAMPLES = 12  # points along each side of the region where there are no sparse ones
# Not tuned, none of them.


class BlockPlan(BaseModel):
    """One block: the corners of its core in the world, and the names of its photos."""

    model_config = ConfigDict(extra="forbid")

    name: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    images: list[str]


class Plan(BaseModel):
    """All blocks; their cores fill the box from `low` to `high` of the world. Sides on its outside are open: a block has
    whatever lies beyond them too."""

    model_config = ConfigDict(extra="forbid")

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    blocks: list[BlockPlan]

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (3,) of all blocks together in the world."""
        return np.array(self.low), np.array(self.high)

    @property
    def world_from_common(self) -> np.ndarray:
        """Similarity (4, 4) from the frame in which all blocks are fused: the cube [−1, 1]³ around the whole region."""
        low, high = self.whole
        return make_similarity(float((high - low).max()) / 2, np.eye(3), (low + high) / 2)

    def core(self, block: BlockPlan) -> tuple[np.ndarray, np.ndarray]:
        """Corners (3,) of a block's part of the world, infinite where it is open."""
        low, high = np.array(block.low), np.array(block.high)
        return np.where(low <= np.array(self.low), -np.inf, low), np.where(high >= np.array(self.high), np.inf, high)

    def region(self, block: BlockPlan) -> tuple[np.ndarray, np.ndarray]:
        """Corners (3,) of what a block is trained on: its core, and the overlap with its neighbours."""
        low, high = np.array(block.low), np.array(block.high)
        room = OVERLAP * (high - low)
        return np.maximum(low - room, self.low), np.minimum(high + room, self.high)

    def reach(self, block: BlockPlan) -> tuple[np.ndarray, np.ndarray]:
        """`region` with its open sides at infinity: where what a block's photos show is taken from it."""
        (low, high), (core_low, core_high) = self.region(block), self.core(block)
        return np.where(np.isinf(core_low), core_low, low), np.where(np.isinf(core_high), core_high, high)


def cut(scene: Scene, count: int) -> Plan:
    """Cut a posed capture into `count` blocks by where its photos were taken.

    The block with the most photos is cut in two, across the direction of the ground plane in which its cameras lie the
    widest apart, where half of them are on each side. A photo belongs to every block that it sees.

    Raises:
        SettingError: a block would have too few photos.
    """
    low, high = whole_region(scene)
    centers = np.stack([view.camera_to_world[:3, 3] for view in scene.views])
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = [(low, high, np.arange(len(centers)))]
    while len(parts) < count:
        widest = max(range(len(parts)), key=lambda number: len(parts[number][2]))
        first, last, own = parts.pop(widest)
        parts[widest:widest] = _halves(first, last, own, centers)
    plan = Plan(low=_triple(low), high=_triple(high), blocks=[])
    sights = _sights(scene, low, high)
    for number, (first, last, _) in enumerate(parts, 1):
        block = BlockPlan(name=str(number), low=_triple(first), high=_triple(last), images=[])
        inner, outer = plan.reach(block)
        seen = [len(p) > 0 and ((p >= inner) & (p <= outer)).all(1).mean() >= LEAST_SEEN for p in sights]
        block.images = [view.name for view, sees in zip(scene.views, seen) if sees]
        trained = len({scene.views[i].name for i in scene.train} & set(block.images))
        if trained < FEWEST_PHOTOS:
            raise SettingError(
                f"Block {number} of {count} would have {trained} photos to be trained on.", "Cut into fewer blocks."
            )
        plan.blocks.append(block)
    return plan


def whole_region(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of the box of the world that blocks divide: the region of interest, or what a run would be trained on,
    without what is beyond all sparse points."""
    if scene.bounds is not None:
        return np.array(scene.bounds[0], np.float64), np.array(scene.bounds[1], np.float64)
    matrix = choose_box(scene, SceneConfig(), False).world_from_box
    low, high = transform_points(matrix, -np.ones(3)), transform_points(matrix, np.ones(3))
    if len(scene.points) >= FEWEST_POINTS:
        inner = np.percentile(scene.points.xyz, [1, 99], axis=0)
        room = OVERLAP * (inner[1] - inner[0])
        low, high = np.maximum(low, inner[0] - room), np.minimum(high, inner[1] + room)
    return low, high


def save_plan(folder: Path, plan: Plan) -> None:
    """Write the plan into a project. Raises DiskError."""
    write_json(folder / FOLDER / PLAN, plan.model_dump(mode="json"))


def load_plan(folder: Path) -> Plan:
    """The plan of a project's blocks. Raises ProjectError: there is none, or it is damaged."""
    path = folder / FOLDER / PLAN
    try:
        return Plan.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise ProjectError(f"{folder} has not been cut into blocks.", "Run `fieldwork blocks`.") from error
    except (OSError, ValueError, ValidationError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Remove it and run `fieldwork blocks` again.") from error


def block_folder(folder: Path, block: BlockPlan) -> Path:
    """The project of a block."""
    return folder / FOLDER / block.name


def _halves(
    low: np.ndarray, high: np.ndarray, own: np.ndarray, centers: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """A box in two, with the photos that were taken on each side."""
    inside = centers[own]
    axis = int(np.argmax(np.ptp(inside[:, :2], axis=0))) if len(own) else int(np.argmax((high - low)[:2]))
    at = float(np.median(inside[:, axis])) if len(own) else np.nan
    width = high[axis] - low[axis]
    if not low[axis] + OVERLAP * width <= at <= high[axis] - OVERLAP * width:
        at = float(low[axis] + high[axis]) / 2
    first, last = high.copy(), low.copy()
    first[axis] = last[axis] = at
    before = centers[own, axis] < at
    return [(low, first, own[before]), (last, high, own[~before])]


def _sights(scene: Scene, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """What each photo may show, (N, 3) of the world: the sparse points in its picture; where there are none, points
    throughout the region. What hides what is not asked."""
    points = scene.points.xyz
    if len(points) < FEWEST_POINTS:
        axes = [np.linspace(a, b, SAMPLES) for a, b in zip(low, high)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    found = []
    for view in scene.views:
        local = (points - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
        with np.errstate(invalid="ignore", divide="ignore"):
            pixel = project(view.camera, local)
            inside = (pixel >= 0).all(1) & (pixel <= [view.camera.width, view.camera.height]).all(1)
        found.append(points[inside])
    return found


def _triple(point: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point)
    return x, y, z
