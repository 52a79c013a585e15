"""The baked field as Gaussian splats, in the PLY layout of Kerbl et al. ("3D Gaussian Splatting", 2023), with classes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
import torch

from ..data.box import Box
from ..errors import ProjectError
from ..files import atomic_path
from ..geometry.contraction import uncontract
from ..geometry.similarity import similarity_scale
from ..kernels.voxel_field import AXES, CELLS, COARSE, TEXELS, VERTICES, occupied_blocks, texels_of
from ..progress import Reporter
from ..project.label_revision import label_facts
from ..render.baked import BakedField
from .gltf_splats import write_gltf_splats

# Spherical harmonics of degree 0 and 1.
C0, C1 = 0.28209479177387814, 0.4886025119029199
# Not tuned: the next three.
LEAST = 0.1  # opacity of a cell's length, below which a vertex gets no splat
SPREAD = 0.6  # standard deviation in cells: neighbours overlap to a closed surface
MOST = 0.99  # opacity of a splat, whose logit is finite


def write_splats(
    path: Path, baked: BakedField, box: Box, class_ids: list[int], label_revision: int | None, report: Reporter
) -> list[Path]:
    """Write a splat for each vertex at the surface of a baked field, and beside it the same as glTF; returns both files.

    A splat is round, in the world, z up: x, y, z; nx, ny, nz (0); f_dc_* and f_rest_* (degree 1, by channel); opacity
    (logit); scale_* (logarithm); rot_* (w first); class_id and class_probability, −1 and 0 without classes.
    A comment of the header names the `label_revision` of the marks that the classes are from, if they are from any.

    Raises:
        ProjectError: the baked field is empty. DiskError.
    """
    report.stage("Reading the baked field")
    field = baked.field
    texels, changes = texels_of(field.vertices, TEXELS), texels_of(field.changes, AXES)
    opacity = (texels[:, 0, 3].astype(np.float32) / 255) ** 2
    rows, places = _surface(field.index.cpu().numpy(), field.blocks, opacity)
    if not len(rows):
        raise ProjectError("The baked field is empty.", "Train longer, and run `fieldwork bake` again.")
    u = torch.from_numpy(places / (field.blocks * CELLS)).double()
    cell = (4.0 if box.contracted else 2.0) / (field.blocks * CELLS)
    position, size = u * 2 - 1, torch.full((len(u),), cell).double()
    if box.contracted:
        # What lies at the end of contracted space has no size that a splat could have.
        near = ((u - 0.5).abs().amax(1) < 0.499).numpy()
        rows, u, size = rows[near], u[near], size[near]
        position = uncontract(u)
        r = position.abs().amax(1).clamp(min=1)
        size = size * r * r.sqrt()
    report.check()
    scale = similarity_scale(box.world_from_box)
    turn = box.world_from_box[:3, :3] / scale
    world = position.numpy() @ box.world_from_box[:3, :3].T + box.world_from_box[:3, 3]
    found = texels[rows].astype(np.float32)
    nearest = changes[_coarse_rows(rows), :, :3].astype(np.float32)
    slope = (nearest - 127.5) * (field.harmonic_range / 127.5)  # (N, xyz, rgb)
    slope = np.einsum("ij,njc->nic", turn, slope)
    alpha = opacity[rows].clip(0, MOST)
    splats = np.zeros(len(rows), _layout())
    for axis, name in enumerate("xyz"):
        splats[name] = world[:, axis]
    for channel in range(3):
        splats[f"f_dc_{channel}"] = (found[:, 0, channel] / 255 - 0.5) / C0
        for number, (axis, sign) in enumerate(((1, -1), (2, 1), (0, -1))):
            splats[f"f_rest_{3 * channel + number}"] = sign * slope[:, axis, channel] / C1
    splats["opacity"] = np.log(alpha / (1 - alpha))
    for axis in range(3):
        splats[f"scale_{axis}"] = np.log(SPREAD * size.numpy() * scale)
    splats["rot_0"] = 1
    if class_ids:
        share = found[:, 1, 1] / 255
        first = share >= 0.5
        index = np.where(first, found[:, 1, 0], found[:, 1, 2]).astype(int)
        splats["class_id"] = np.array(class_ids)[index]
        splats["class_probability"] = np.where(first, share, 1 - share)
    else:
        splats["class_id"] = -1
    report.stage("Writing")
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(_header(splats, label_revision))
        file.write(splats.tobytes())
    # A file of this name without the word is rather the mesh.
    beside = path.with_name(f"{path.stem.removesuffix('-splats')}-splats.glb")
    write_gltf_splats(beside, splats, label_revision)
    return [path, beside]


def _coarse_rows(rows: np.ndarray) -> np.ndarray:
    """Of rows (N,) of vertices, the rows of the vertices nearest to them that have changes."""
    block, local = np.divmod(rows, VERTICES**3)
    z, y, x = ((local // VERTICES**axis % VERTICES + 1) // 2 for axis in (2, 1, 0))
    return ((block * COARSE + z) * COARSE + y) * COARSE + x


def _surface(index: np.ndarray, blocks: int, opacity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the vertices within a cell of empty space, and where they are: (N, 3) in cells; vertices that blocks share
    come once."""
    occupied, order = occupied_blocks(index)
    corner = np.stack([occupied % blocks, occupied // blocks % blocks, occupied // blocks**2], 1) * CELLS
    cubes = opacity.reshape(-1, VERTICES, VERTICES, VERTICES)
    around = scipy.ndimage.minimum_filter(cubes, size=(1, 3, 3, 3), mode="nearest")
    kept = (cubes >= LEAST) & (around < LEAST)
    block, z, y, x = np.nonzero(kept)
    corners = np.zeros((len(cubes), 3), np.int64)
    corners[order] = corner
    places = corners[block] + np.stack([x, y, z], 1)
    side = blocks * CELLS + 1
    _, once = np.unique((places[:, 2] * side + places[:, 1]) * side + places[:, 0], return_index=True)
    rows = ((block * VERTICES + z) * VERTICES + y) * VERTICES + x
    return rows[once], places[once]


def _layout() -> np.dtype:
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{n}" for n in range(3)), *(f"f_rest_{n}" for n in range(9))]
    names += ["opacity", *(f"scale_{n}" for n in range(3)), *(f"rot_{n}" for n in range(4))]
    return np.dtype([*((name, "<f4") for name in names), ("class_id", "<i4"), ("class_probability", "<f4")])


def _header(splats: np.ndarray, label_revision: int | None) -> bytes:
    kinds = {"<f4": "float", "<i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", "comment sRGB, z up"]
    lines += [f"comment {fact} {value}" for fact, value in label_facts(label_revision).items()]
    lines.append(f"element vertex {len(splats)}")
    lines += [f"property {kinds[kind]} {name}" for name, kind in splats.dtype.descr]
    return "\n".join([*lines, "end_header", ""]).encode()
