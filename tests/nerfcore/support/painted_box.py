"""A box of three classes and two instances whose faces have a colour each, in a texture and, more coarsely, at its
vertices: what mesh files must keep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fieldwork.nerfcore.data.scene import ClassInfo, View
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.features import Features, features_of
from fieldwork.nerfcore.mesh.instances import Instance
from fieldwork.nerfcore.mesh.parts import Texture, texture_of
from fieldwork.nerfcore.mesh.surface import Surface, vertex_normals
from fieldwork.tests.nerfcore.support.flat import box_mesh, looking

CLASSES = [ClassInfo(3, "Säule 1", (0.9, 0.2, 0.1)), ClassInfo(7, "gold", (0.8, 0.7, 0.0))]
INSTANCES = [Instance(1, "gold.001", 7, 1.0, (0, 0, 0)), Instance(2, "gold.002", 7, 1.0, (0, 0, 0))]
FACE_CLASS = np.array([3, 3, 3, 3, 7, 7, 7, 7, 0, 0, 3, 3], np.int32)
FACE_INSTANCE = np.array([0, 0, 0, 0, 1, 1, 2, 2, 0, 0, 0, 0], np.uint32)
SIZE = 16  # of the texture
VIEW = View(
    "IMG 1",
    Camera(width=320, height=200, fx=260, fy=250, cx=150, cy=110),
    looking((0.2, 0.1, 0.3), (4.0, -3.0, 2.5)),
    Path("IMG 1.jpg"),
)


def surface() -> Surface:
    """A box of 1 × 2 × 3, off the origin, so that every axis shows."""
    vertices, faces = box_mesh()
    vertices = (vertices * [1, 2, 3] + [0.25, 0.5, 1.0]).astype(np.float32)
    colors = np.random.default_rng(4).integers(0, 256, (len(vertices), 3)).astype(np.uint8)
    ids = np.zeros(len(vertices), np.int32)
    ids[faces] = FACE_CLASS[:, None]
    normals = vertex_normals(vertices, faces).astype(np.float32)
    return Surface(vertices, faces.astype(np.int32), normals, colors, ids, FACE_CLASS, FACE_INSTANCE)


def face_colors() -> np.ndarray:
    """The colour (12, 3) uint8 sRGB of each face in the texture, dark ones among them."""
    return np.random.default_rng(5).integers(0, 256, (12, 3)).astype(np.uint8) // np.array([[1], [8]] * 6, np.uint8)


def texture() -> Texture:
    """Each face lies in a texel of its own."""
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    number = np.arange(12)
    row, column = number // 4 * 4, number % 4 * 3
    image[row, column] = face_colors()
    middle = np.stack([(column + 0.5) / SIZE, 1 - (row + 0.5) / SIZE], 1)
    spread = np.array([[-0.2, -0.2], [0.2, -0.2], [0.0, 0.2]]) / SIZE
    return texture_of(surface().faces, (middle[:, None] + spread).astype(np.float32), image)


def features() -> Features:
    return features_of(surface(), CLASSES, 0, INSTANCES)
