"""The built-in scene "vase": a lidded vase and a stone ball on a cloth on a table, closed bodies whose volume is known.

Metres, z up, the ground at z = 0.
"""

from __future__ import annotations

import math

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector, noise

from ..photograph.orbit import rings
from . import facade, materials, shapes

CLASSES = {1: "ceramic", 2: "gilding", 3: "stone", 4: "textile", 5: "wood"}
COLORS = {  # sRGB, 0 to 255
    1: (41, 107, 209),
    2: (242, 184, 31),
    3: (184, 176, 163),
    4: (199, 31, 51),
    5: (128, 71, 31),
}
TARGET = np.array([0.0, 0.0, 0.62])
RINGS = [(0.38, 1.5, 8.0), (0.37, 1.55, 26.0), (0.25, 1.5, 50.0)]
OVERVIEW = [(1.0, 2.6, 35.0)]
TABLE = 0.4  # height of its top
# (radius, height) from the foot to the knob of the lid, which is one body with the vase.
PROFILE = [(0.1, 0), (0.11, 0.02), (0.085, 0.05), (0.12, 0.12), (0.18, 0.23), (0.195, 0.32), (0.17, 0.4), (0.11, 0.45)]
PROFILE += [(0.115, 0.465), (0.08, 0.5), (0.03, 0.525), (0.02, 0.54), (0.035, 0.56), (0.02, 0.585), (0.004, 0.59)]


def build(seed: int) -> bpy.types.Scene:
    """Replace everything in this Blender by the scene; `seed` moves the textures and the folds of the cloth."""
    scene = shapes.new_scene()
    noise.seed_set(seed + 1)
    shift = Vector(np.random.default_rng(seed).uniform(-20, 20, 3).tolist())
    facade.light(scene)
    legs = [((x, y, TABLE / 2 - 0.03), (0.08, 0.08, TABLE - 0.06)) for x in (-0.5, 0.5) for y in (-0.35, 0.35)]
    top = ((0, 0, TABLE - 0.03), (1.2, 0.9, 0.06))
    shapes.add("table", shapes.boxes("table", [top, *legs], 0.008), materials.wood(5))
    _cloth(materials.textile(4), shift)
    _vase(materials.ceramic(1), materials.gilding(2), shift)
    bm = bmesh.new()
    bmesh.ops.create_icosphere(bm, subdivisions=5, radius=0.09, matrix=Matrix.Translation((0.36, -0.2, TABLE + 0.1)))
    shapes.add("ball", shapes.from_bmesh("ball", bm, smooth=True), materials.stone(3))
    return scene


def poses(views: int, seed: int) -> list[np.ndarray]:
    """Camera-to-world (4, 4), OpenGL axes, of a walk around the table."""
    return rings(views, RINGS, TARGET, seed)


def overviews(views: int, seed: int) -> list[np.ndarray]:
    """The same, of photos of the whole from farther away."""
    return rings(views, OVERVIEW, TARGET, seed + 1)


def _cloth(textile: bpy.types.Material, shift: Vector) -> None:
    def place(x: float, y: float) -> tuple[float, float, float]:
        return x, y, TABLE + 0.008 + 0.004 * noise.noise(Vector((x * 5, y * 5, 0)) + shift)

    cloth = shapes.from_bmesh("cloth", shapes.grid(0.96, 0.66, 60, 44, place), smooth=True)
    shapes.add("cloth", cloth, textile).rotation_euler = (0, 0, math.radians(6))


def _vase(ceramic: bpy.types.Material, gold: bpy.types.Material, shift: Vector) -> None:
    points = np.array(PROFILE)
    knots, fine = np.arange(len(points)), np.linspace(0, len(points) - 1, 120)
    profile = [(float(np.interp(t, knots, points[:, 0])), float(np.interp(t, knots, points[:, 1]))) for t in fine]
    bm = shapes.lathe(profile)
    for face in bm.faces:
        z = face.calc_center_median().z
        face.material_index = int(0.3 < z < 0.34 or 0.45 < z < 0.47 or z > 0.54)
    vase = shapes.add("vase", shapes.from_bmesh("vase", bm, smooth=True), ceramic, gold)
    vase.location, vase.rotation_euler = (-0.08, 0.02, TABLE + 0.012), (0, 0, shift.x)
