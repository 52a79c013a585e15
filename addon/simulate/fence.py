"""The built-in scene "fence": a corner of a garden with what is hard for surfaces because it is thin: an enamelled sign
a centimetre thick, a fence of wire, leaves.

Metres, z up, the ground at z = 0, fence and sign in planes of constant y.
"""

from __future__ import annotations

import math

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..photograph.orbit import rings
from . import facade, materials, shapes

CLASSES = {1: "enamel", 2: "metal", 3: "leaf", 4: "wood", 5: "ground"}
COLORS = {  # sRGB, 0 to 255
    1: (41, 107, 209),
    2: (150, 40, 60),
    3: (88, 160, 60),
    4: (128, 71, 31),
    5: (120, 130, 120),
}
TARGET = np.array([0.0, 0.0, 0.42])
RINGS = [(0.38, 1.7, 10.0), (0.37, 1.75, 28.0), (0.25, 1.65, 52.0)]
OVERVIEW = [(1.0, 2.8, 35.0)]
HALF, TOP, GAP = 0.75, 0.82, 0.13  # of the fence: half its length, its height, between its wires
WIRE = 0.006  # radius
SIGN = (0.56, 0.010, 0.36)  # two voxels thick where 512 span the scene
LEAVES = 46


def build(seed: int) -> bpy.types.Scene:
    """Replace everything in this Blender by the scene; `seed` moves the leaves and the textures."""
    scene = shapes.new_scene()
    random = np.random.default_rng(seed)
    facade.light(scene)
    ground = shapes.from_bmesh("ground", shapes.grid(2.6, 2.6, 1, 1, lambda x, y: (x, y, 0.0)))
    shapes.add("ground", ground, materials.paving(5))
    metal, wood = materials.iron(2), materials.wood(4)
    _fence(metal, wood)
    sign = shapes.add("sign", shapes.boxes("sign", [((0, 0, 0), SIGN)], 0.002), materials.ceramic(1))
    sign.location = (-0.1, -0.36, 0.45)
    post = shapes.add("sign post", shapes.boxes("sign post", [((0, 0, 0.14), (0.05, 0.05, 0.28))], 0.004), wood)
    post.location = (-0.1, -0.36, 0)
    _shrub(materials.moss(3), wood, random)
    return scene


def poses(views: int, seed: int) -> list[np.ndarray]:
    """Camera-to-world (4, 4), OpenGL axes, of a walk around the fence."""
    return rings(views, RINGS, TARGET, seed)


def overviews(views: int, seed: int) -> list[np.ndarray]:
    """The same, of photos of the whole from farther away."""
    return rings(views, OVERVIEW, TARGET, seed + 1)


def _rod(bm: bmesh.types.BMesh, start: Vector, end: Vector, radius: float) -> None:
    along = end - start
    turn = along.to_track_quat("Z", "Y").to_matrix().to_4x4()
    bmesh.ops.create_cone(
        bm,
        cap_ends=True,
        segments=10,
        radius1=radius,
        radius2=radius,
        depth=along.length,
        matrix=Matrix.Translation((start + end) / 2) @ turn,
    )


def _fence(metal: bpy.types.Material, wood: bpy.types.Material) -> None:
    """Wires across and upright, touching where they cross, between two posts."""
    bm = bmesh.new()
    for z in np.arange(GAP, TOP, GAP):
        _rod(bm, Vector((-HALF, WIRE, z)), Vector((HALF, WIRE, z)), WIRE)
    for x in np.arange(-HALF + GAP, HALF, GAP):
        _rod(bm, Vector((x, -WIRE, 0)), Vector((x, -WIRE, TOP)), WIRE)
    shapes.add("wires", shapes.from_bmesh("wires", bm, smooth=True), metal)
    posts = [((side * HALF, 0, TOP / 2 + 0.03), (0.07, 0.07, TOP + 0.06)) for side in (-1, 1)]
    shapes.add("posts", shapes.boxes("posts", posts, 0.006), wood)


def _shrub(green: bpy.types.Material, wood: bpy.types.Material, random: np.random.Generator) -> None:
    """Bent leaves of four millimetres around three stems."""
    middle, bm = Vector((0.28, 0.42, 0)), bmesh.new()
    for k in range(3):
        angle = 2.1 * k + 0.4
        _rod(bm, middle, middle + Vector((0.12 * math.cos(angle), 0.12 * math.sin(angle), 0.6)), 0.012)
    shapes.add("stems", shapes.from_bmesh("stems", bm, smooth=True), wood)
    for k in range(LEAVES):
        length, width = random.uniform(0.14, 0.2), random.uniform(0.07, 0.1)
        bend = random.uniform(0.2, 0.6)

        def place(x: float, y: float, length: float = length, bend: float = bend) -> tuple[float, float, float]:
            pointed = math.sqrt(max(1 - (2 * x / length) ** 2, 0.02))
            return x + length / 2, y * pointed, -bend * (x + length / 2) ** 2 / length

        leaf = shapes.from_bmesh("leaf", shapes.grid(length, width, 12, 6, place), smooth=True)
        item = shapes.add(f"leaf {k}", leaf, green)
        around, height = k * 2.399963, 0.16 + 0.48 * (k + 0.5) / LEAVES  # the golden angle, as leaves stand
        item.location = middle + Vector((0.06 * math.cos(around), 0.06 * math.sin(around), height))
        item.rotation_euler = (random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.2), around)
        item.modifiers.new("thickness", "SOLIDIFY").thickness = 0.004
