"""A baked field on disk, `runs/<name>/voxels`, and pictures from it without the field.

| file | holds |
| --- | --- |
| meta.json | what it was baked from, and what the numbers mean (`Meta`) |
| index.npy | (B, B, B) int32, z first: see `VoxelField` |
| T0.npy, T1.npy | (9 Z, 9 Y, 9 X, 4) uint8: texels of all blocks side by side, as 3D textures want them |
| T2.npy … T4.npy | (5 Z, 5 Y, 5 X, 4) uint8: changes of their colours |
| environment.npy | (H, 2H, 4) uint8, where the run has one: see `panorama.py` |
| lut.npy | (256, 4) uint8: colour and opacity of each class index, which viewers change |

What texels mean stands in `kernels/voxel_field.py`.
"""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..errors import ProjectError
from ..field.environment import EnvironmentRays
from ..files import UNREADABLE_ARRAYS, disk_errors, write_json
from ..kernels.device import use_device
from ..kernels.traversal import MarchSettings
from ..kernels.voxel_field import CELLS, COARSE, VERTICES, VoxelField, VoxelRays, cell_length, occupied_blocks
from ..kernels.voxel_march import march
from ..project.runs import VOXELS, checkpoint_id, run_folder
from .panorama import HEIGHT, Panorama
from .run import RunInfo

META, INDEX, LUT, ENVIRONMENT = "meta.json", "index.npy", "lut.npy", "environment.npy"
FINE, COARSER = ("T0.npy", "T1.npy"), ("T2.npy", "T3.npy", "T4.npy")
MOST_ACROSS = 28  # blocks along a side of the textures: 252 texels, 256 being what every GPU takes
MOST_BLOCKS = MOST_ACROSS**3
BLOCK_BYTES = 4 * (VERTICES**3 * len(FINE) + COARSE**3 * len(COARSER))
STEP = 1.0  # length of a step in cells: docs/experiments.md, “How fine must a baked field be?”


class Meta(BaseModel):
    """What meta.json says. Lengths are in normalised units, `sfm_from_box` (4, 4) carries the cube [−1, 1]³ into the
    SfM frame."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[2] = 2
    checkpoint: str  # which field it was baked from
    side: int = Field(ge=1, le=1024)  # blocks along a side of the grid
    blocks: int = Field(ge=0, le=MOST_BLOCKS)  # that are occupied
    across: tuple[int, int, int]  # blocks along the x, y and z axes of the textures
    cells: Literal[8] = CELLS
    contracted: bool
    near: float
    far: float
    empty_distance: float
    harmonic_range: float
    class_ids: list[int]
    class_names: list[str]
    sfm_from_box: list[list[float]]
    environment: bool = False  # whether there is one behind it
    label_revision: int | None = None  # of the marks that classes are from, if they are from any


def texture_shape(blocks: int) -> tuple[int, int, int]:
    """Blocks along x, y and z of the textures that hold so many: nearly a cube, with as little as possible left over."""
    across = min(MOST_ACROSS, max(1, math.ceil(blocks ** (1 / 3))))
    return across, across, max(1, math.ceil(blocks / across**2))


def texture_bytes(blocks: int, side: int) -> int:
    """Graphics memory of the textures, with the index as float32."""
    return math.prod(texture_shape(blocks)) * BLOCK_BYTES + 4 * side**3 + 4 * 256


def most_blocks(memory: float, side: int) -> int:
    """The most blocks whose textures take no more than so many bytes; 0 where not even the index fits."""
    most = min(MOST_BLOCKS, int((memory - 4 * side**3) / BLOCK_BYTES))
    while most > 0 and texture_bytes(most, side) > memory:
        most -= 1
    return max(most, 0)


def to_texture(texels: np.ndarray) -> np.ndarray:
    """Texels (S, n, n, n, 4) of blocks, z first, side by side: (n Z, n Y, n X, 4)."""
    (x, y, z), n = texture_shape(len(texels)), texels.shape[1]
    full = np.zeros((z * y * x, *texels.shape[1:]), np.uint8)
    full[: len(texels)] = texels
    cube = full.reshape(z, y, x, n, n, n, 4).transpose(0, 3, 1, 4, 2, 5, 6)
    return cube.reshape(z * n, y * n, x * n, 4)


def from_texture(texture: np.ndarray, blocks: int, n: int = VERTICES) -> np.ndarray:
    """The texels (S, n, n, n, 4) of the first S blocks of a texture (n Z, n Y, n X, 4)."""
    z, y, x = (side // n for side in texture.shape[:3])
    cube = texture.reshape(z, n, y, n, x, n, 4).transpose(0, 2, 4, 1, 3, 5, 6)
    return cube.reshape(-1, n, n, n, 4)[:blocks]


def voxels_folder(project: Path, run: str) -> Path:
    """Where the baked field of a run is."""
    return run_folder(project, run) / VOXELS


def save_baked(
    folder: Path,
    meta: Meta,
    index: np.ndarray,
    texels: np.ndarray,
    changes: np.ndarray,
    lut: np.ndarray,
    environment: np.ndarray | None = None,
) -> list[Path]:
    """Write a baked field in the place of an earlier one and return its files.

    It is written beside its place and moved there when it is whole: killed at any moment, it leaves the earlier one, or
    none, never a part.

    Args:
        index: (B³,) int32, x fastest. texels: (S · 9³, 2, 4) and changes (S · 5³, 3, 4) uint8, x fastest. lut: (256, 4)
            uint8. environment: (H, 2H, 4) uint8, or None.
    Raises:
        DiskError: the disk is full, the folder is not writable, or the earlier field is open elsewhere (Windows).
    """
    fresh, old = folder.with_name(f".{VOXELS}.new"), folder.with_name(f".{VOXELS}.old")
    with disk_errors(folder):
        for rest in (fresh, old):
            shutil.rmtree(rest, ignore_errors=True)
        try:
            fresh.mkdir(parents=True)
            _write(fresh / INDEX, index.reshape(meta.side, meta.side, meta.side))
            _write(fresh / LUT, lut)
            if environment is not None:
                _write(fresh / ENVIRONMENT, environment)
            for names, n, values in ((FINE, VERTICES, texels), (COARSER, COARSE, changes)):
                by_block = values.reshape(-1, n, n, n, len(names), 4)
                for number, name in enumerate(names):
                    _write(fresh / name, to_texture(by_block[..., number, :]))
            write_json(fresh / META, meta.model_dump(mode="json"))
            if folder.exists():
                folder.rename(old)
            fresh.rename(folder)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    behind = [] if environment is None else [ENVIRONMENT]
    return [folder / name for name in (META, INDEX, LUT, *FINE, *COARSER, *behind)]


def _write(path: Path, values: np.ndarray) -> None:
    with open(path, "wb") as file:
        np.save(file, values)
        file.flush()
        os.fsync(file.fileno())


@dataclass(frozen=True)
class BakedRays(VoxelRays):
    """The same with what is behind the baked field."""

    environment: EnvironmentRays | None


class BakedField:
    """A baked field that renders rays of the normalised frame; takes a trained field's place in `render_view`."""

    rays = 1 << 18  # rendered at once

    def __init__(self, field: VoxelField, settings: MarchSettings, environment: Panorama | None = None) -> None:
        self.field, self.settings, self.environment = field, settings, environment

    @property
    def device(self) -> torch.device:
        return self.field.index.device

    @property
    def classes(self) -> int:
        return self.field.classes

    def __call__(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        samples_per_ray: int = 0,
        ends: torch.Tensor | None = None,
    ) -> BakedRays:
        """Render rays (R, 3); their samples are as many as the cells they meet, whatever `samples_per_ray` says; `ends`
        (R,): distances at which they end."""
        rays = march(origins, directions, self.field, self.settings, ends)
        behind = None if self.environment is None else self.environment.behind(directions, rays)
        return BakedRays(**vars(rays), environment=behind)


def load_baked(project: Path, run: str, info: RunInfo) -> BakedField:
    """The baked field of a run, on the device.

    Raises:
        ProjectError: there is none, it is damaged, or it was baked from an earlier training.
    """
    folder, device = voxels_folder(project, run), use_device()
    meta = read_meta(folder)
    if meta.checkpoint != checkpoint_id(project, run) or not np.allclose(meta.sfm_from_box, info.sfm_from_box):
        raise ProjectError(
            f"{folder} was baked from another training of the run “{run}” than is there now.",
            "Run `fieldwork bake` again.",
        )
    index = _read(folder / INDEX, (meta.side,) * 3, np.int32)
    lut = _read(folder / LUT, (256, 4), np.uint8)
    texels, changes = (_read_texels(folder, meta, names, n) for names, n in ((FINE, VERTICES), (COARSER, COARSE)))
    named = occupied_blocks(index.reshape(-1))[1]
    if (len(named) and not 0 <= named.min() <= named.max() < meta.blocks) or int(index.min()) < -meta.side:
        raise _damaged(folder / INDEX, "it names blocks that are not there")
    classes = len(meta.class_ids)
    if classes and meta.blocks and int(texels[..., 1, ::2].max()) >= classes:
        raise _damaged(folder / FINE[1], "it names classes that are not there")
    field = VoxelField(
        blocks=meta.side,
        index=torch.from_numpy(np.array(index)).reshape(-1).to(device),
        vertices=torch.from_numpy(texels.reshape(-1).view(np.int32)).to(device),
        changes=torch.from_numpy(changes.reshape(-1).view(np.int32)).to(device),
        class_opacity=torch.from_numpy(lut[:, 3].astype(np.float32) / 255).to(device),
        harmonic_range=meta.harmonic_range,
        classes=classes,
    )
    environment = None
    if meta.environment:
        picture = _read(folder / ENVIRONMENT, (HEIGHT, 2 * HEIGHT, 4), np.uint8)
        if int(picture[..., 3].max()) > classes:
            raise _damaged(folder / ENVIRONMENT, "it names classes that are not there")
        environment = Panorama(picture, classes, device)
    return BakedField(field, march_settings(meta), environment)


def _read_texels(folder: Path, meta: Meta, names: tuple[str, ...], n: int) -> np.ndarray:
    """Texels (S, n, n, n, names, 4) of some textures."""
    x, y, z = (number * n for number in meta.across)
    texels = np.empty((meta.blocks, n, n, n, len(names), 4), np.uint8)
    for number, name in enumerate(names):
        texels[..., number, :] = from_texture(_read(folder / name, (z, y, x, 4), np.uint8), meta.blocks, n)
    return texels


def march_settings(meta: Meta) -> MarchSettings:
    """How rays march through a baked field."""
    return MarchSettings(
        resolution=meta.side * CELLS,
        step=STEP * cell_length(meta.side, meta.contracted),
        near=meta.near,
        far=meta.far,
        contracted=meta.contracted,
        empty_distance=meta.empty_distance,
    )


def read_meta(folder: Path) -> Meta:
    """meta.json of a baked field. Raises ProjectError when there is none or it is damaged."""
    path = folder / META
    if not path.is_file():
        raise ProjectError(f"{folder.parent} has no baked field.", "Run `fieldwork bake` first.")
    try:
        return Meta.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        raise _damaged(path, "it is not what `fieldwork bake` writes") from error


def _read(path: Path, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """A file's array, mapped into memory. Raises ProjectError when it is missing, truncated or of another shape."""
    try:
        array = np.load(path, mmap_mode="r")
    except UNREADABLE_ARRAYS as error:
        raise _damaged(path, "it cannot be read to its end") from error
    if array.shape != shape or array.dtype != dtype:
        raise _damaged(path, f"it holds {array.dtype} {array.shape}, not {np.dtype(dtype)} {shape}")
    return array


def _damaged(path: Path, why: str) -> ProjectError:
    return ProjectError(f"{path} is damaged: {why}.", "Run `fieldwork bake` again.")
