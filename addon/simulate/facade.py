"""The built-in scene "facade": a weathered piece of a church front in the open, as surveyed for a map of its damage.

Metres, z up, the ground at z = 0, the wall in the plane y = 0 facing −y. Moss, black crust, cracks and lost stone are
painted on the same surfaces as the stone, the ironwork of the door on the door.
"""

from __future__ import annotations

import math

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..photograph.orbit import arc
from . import masonry, materials, shapes
from .masonry import Opening, Wall, along_x, around, outline, solid, turned

CLASSES = {1: "stone", 2: "moss", 3: "black crust", 4: "crack", 5: "loss", 6: "wood", 7: "metal", 8: "ground"}
COLORS = {  # sRGB, 0 to 255
    1: (214, 194, 150),
    2: (88, 160, 60),
    3: (46, 40, 52),
    4: (230, 30, 150),
    5: (214, 84, 44),
    6: (128, 71, 31),
    7: (41, 107, 209),
    8: (120, 130, 120),
}
TARGET = np.array([-0.05, 0.0, 1.25])
LEVELS = [(0.34, 3.9, 1.6), (0.33, 3.1, 0.75), (0.33, 3.4, 2.35)]
OVERVIEW = [(1.0, 6.0, 3.0)]
SPREAD, WANDER = 150.0, (0.3, 0.0, 0.14)

DOOR = Opening(-0.6, 0.3, 1.4, 0.46)
NICHE = Opening(1.12, 0.84, 1.42, 0.33)
WALL = Wall(
    half=2.2,
    courses=[0, 0.28, 0.57, 0.84, 1.15, 1.42, 1.7, 1.93, 2.13, 2.32, 2.6, 2.84],
    top=[(-2.2, 1.6), (-1.95, 2.0), (-1.6, 2.5), (-0.8, 2.9), (0.3, 2.75), (0.9, 2.5), (1.5, 2.35), (2.2, 1.75)],
    openings=[DOOR, NICHE],
    ledges=[(2.14, -1.6, 1.5), (0.74, 0.68, 1.56), (0.3, -2.2, -2.0)],
    cracks=[
        [(-0.42, 1.95), (-0.28, 2.2), (-0.4, 2.45), (-0.2, 2.8)],
        [(1.66, 2.3), (1.72, 1.75), (1.58, 1.2), (1.72, 0.75), (1.62, 0.4)],
        [(0.74, 0.3), (0.66, 0.8), (0.5, 1.2), (0.56, 1.6)],
    ],
    losses=[(-1.82, 1.2, 0.26), (0.45, 0.52, 0.2), (1.86, 1.0, 0.22), (0.62, 1.86, 0.2), (-1.2, 2.42, 0.2)],
)


def build(seed: int) -> bpy.types.Scene:
    """Replace everything in this Blender by the scene; `seed` moves the textures, the blocks and the damage."""
    scene = shapes.new_scene()
    random = np.random.default_rng(seed)
    shift = random.uniform(-20, 20, 3)
    stone = [
        materials.sandstone(1),
        materials.moss(2),
        materials.black_crust(3),
        materials.crack(4),
        materials.brick(5),
    ]
    iron = materials.iron(7)
    light(scene)
    _ground(materials.paving(8), materials.meadow(8), shift)
    masonry.build_wall(WALL, stone, shift, random)
    _ledges(stone, shift, random)
    _surrounds(stone, shift, random)
    _columns(stone, shift)
    _niche(stone, shift)
    _statue(stone, shift)
    _door(materials.oak(6), iron, random)
    _ironwork(iron)
    return scene


def poses(views: int, seed: int) -> list[np.ndarray]:
    """Camera-to-world (4, 4), OpenGL axes, of a photographer's walks to and fro before the facade."""
    return arc(views, LEVELS, TARGET, SPREAD, WANDER, seed)


def overviews(views: int, seed: int) -> list[np.ndarray]:
    """The same, of photos of the whole from farther away."""
    return arc(views, OVERVIEW, TARGET, SPREAD, WANDER, seed + 1)


def light(scene: bpy.types.Scene) -> None:
    """Sun and clouds."""
    world = bpy.data.worlds.new("sky")
    materials.sky(world, 0.75)
    scene.world = world
    data = bpy.data.lights.new("sun", "SUN")
    data.energy, data.angle, data.color = 3.4, math.radians(2), (1.0, 0.92, 0.8)
    sun = bpy.data.objects.new("sun", data)
    sun.rotation_euler = Vector((0.62, 0.62, -0.72)).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(sun)


def _ground(paving: bpy.types.Material, meadow: bpy.types.Material, shift: np.ndarray) -> None:
    shapes.add("paving", shapes.from_bmesh("paving", shapes.grid(9, 7, 1, 1, lambda x, y: (x, y - 1.2, 0.0))), paving)
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 97), np.geomspace(1, 70, 40))
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius], 2)
    hills = masonry.smooth(radius, 14, 60) * (3.2 + 3 * masonry.noise_at(place, 0.06, shift))
    place[..., 2] = hills - 0.02
    vertices, quads = shapes.sheet(place[::-1])
    shapes.painted("meadow", vertices, quads, [meadow], np.zeros(len(quads)))


def _ledges(stone: list[bpy.types.Material], shift: np.ndarray, random: np.random.Generator) -> None:
    """The base of the wall, the cornice, the sill of the niche and the steps before the door."""
    base = outline([(0.05, 0), (-0.09, 0), (-0.09, 0.22), (-0.03, 0.3), (0.05, 0.3)])
    cornice = outline(
        [(0.1, 2.13), (-0.04, 2.13), (-0.07, 2.18), (-0.15, 2.22), (-0.15, 2.27), (-0.04, 2.32), (0.1, 2.32)]
    )
    sill = outline([(0.1, 0.73), (-0.06, 0.73), (-0.13, 0.78), (-0.13, 0.84), (0.3, 0.84), (0.3, 0.8)])
    for name, profile, start, end in (
        ("base left", base, -2.22, DOOR.x - 0.4),
        ("base right", base, DOOR.x + 0.4, 2.2),
        ("cornice", cornice, -1.62, 1.5),
        ("sill", sill, NICHE.x - 0.45, NICHE.x + 0.45),
    ):
        rings = along_x(profile, start, end)
        joints = np.floor((rings[:, 0, 0] - start) / 0.55).astype(int)
        tint = random.uniform(0.1, 0.9, joints[-1] + 1)[joints]
        solid(name, rings, stone, shift, tint=tint, rough=0.022, shelter=0.15)
    for number, (front, height, half) in enumerate([(-1.15, 0.1, 1.16), (-0.87, 0.2, 1.02), (-0.6, 0.3, 0.9)]):
        rings = along_x(outline([(0.3, 0), (front, 0), (front, height), (0.3, height)]), DOOR.x - half, DOOR.x + half)
        worn = 0.014 * np.exp(-(((rings[..., 0] - DOOR.x) / 0.35) ** 2)) * (rings[..., 2] > height - 0.02)
        rings[..., 2] -= worn
        solid(f"step {number}", rings, stone, shift + number, tint=np.full(len(rings), 0.25 + 0.25 * number))


def _surrounds(stone: list[bpy.types.Material], shift: np.ndarray, random: np.random.Generator) -> None:
    for name, opening, block, back in (("portal", DOOR, 0.23, 0.34), ("niche surround", NICHE, 0.19, 0.06)):
        profile = outline(
            [
                (0, back),
                (0, -0.02),
                (0.03, -0.055),
                (0.11, -0.055),
                (0.13, -0.03),
                (0.17, -0.03),
                (0.17, 0.04),
                (0.06, back),
            ]
        )
        rings, tint = around(opening, profile, block, random)
        solid(name, rings, stone, shift, tint=tint, rough=0.01, shelter=0.1)


def _columns(stone: list[bpy.types.Material], shift: np.ndarray) -> None:
    for side in (-1, 1):
        x, y = DOOR.x + side * 0.76, -0.12
        plinth = outline([(x - 0.14, y - 0.14), (x + 0.14, y - 0.14), (x + 0.14, y + 0.14), (x - 0.14, y + 0.14)])
        for low, high in ((0.28, 0.44), (2.04, 2.14)):
            heights = np.linspace(low, high, 8)
            rings = np.stack([np.concatenate([plinth, np.full((len(plinth), 1), h)], 1) for h in heights])
            solid("plinth", rings, stone, shift + side, rough=0.015)
        shaft = [(0.13, 0.43), (0.13, 0.47), (0.105, 0.5), (0.12, 0.53), (0.09, 0.56), (0.095, 0.9), (0.085, 1.72)]
        capital = [(0.11, 1.74), (0.085, 1.77), (0.085, 1.82), (0.1, 1.88), (0.135, 1.98), (0.13, 2.06)]
        rings = turned([*shaft, *capital], x, y)
        angle = np.arctan2(rings[..., 1] - y, rings[..., 0] - x)
        leaves = 0.16 * np.cos(8 * angle) * np.exp(-(((rings[..., 2] - 1.92) / 0.07) ** 2))
        twist = 0.06 * np.cos(3 * angle + side * 14 * rings[..., 2]) * ((rings[..., 2] > 0.58) & (rings[..., 2] < 1.7))
        rings[..., :2] = (x, y) + (rings[..., :2] - (x, y)) * (1 + leaves + twist)[..., None]
        solid("column", rings, stone, shift + side, rough=0.01, shelter=0.1)


def _niche(stone: list[bpy.types.Material], shift: np.ndarray) -> None:
    """The hollow: half of an upright cylinder below a quarter of a sphere."""
    height = np.linspace(NICHE.sill - 0.02, NICHE.spring + NICHE.radius, 80)
    width = np.sqrt(np.maximum(NICHE.radius**2 - np.maximum(height - NICHE.spring, 0) ** 2, 1e-6))[:, None] * 1.04
    turn = np.linspace(-np.pi / 2, np.pi / 2, 70)
    points = np.stack(
        [NICHE.x + width * np.sin(turn), 0.03 + 0.85 * width * np.cos(turn), height[:, None] + 0 * turn], 2
    )
    points[..., 1] += 0.012 * masonry.noise_at(points, 6, shift)
    vertices, quads = shapes.sheet(points)
    centers, normals = shapes.centers_normals(vertices, quads)
    shelter = 0.25 + 0.45 * masonry.smooth(centers[:, 2], 1.3, 1.75)
    slot = masonry.weather(centers, normals, shift, shelter=shelter)
    shapes.painted("niche", vertices, quads, stone, slot, np.full(len(quads), 0.3))


def _statue(stone: list[bpy.types.Material], shift: np.ndarray) -> None:
    lumps = [
        ((0, 0, 0.06), (0.19, 0.16, 0.1), False),
        ((0, 0, 0.2), (0.17, 0.14, 0.2), False),
        ((0, 0, 0.36), (0.15, 0.13, 0.18), False),
        ((0, 0, 0.52), (0.2, 0.13, 0.13), False),  # shoulders
        ((0, 0, 0.61), (0.07, 0.07, 0.1), False),
        ((0, -0.005, 0.71), (0.1, 0.115, 0.125), False),  # head
        ((0, -0.1, 0.69), (0.025, 0.04, 0.04), False),
        ((0.03, -0.12, 0.725), (0.028, 0.04, 0.025), True),  # eyes
        ((-0.03, -0.12, 0.725), (0.028, 0.04, 0.025), True),
        ((0, 0.03, 0.72), (0.12, 0.11, 0.14), False),  # hood
        ((0.13, -0.05, 0.42), (0.07, 0.1, 0.12), False),  # arms
        ((-0.13, -0.05, 0.42), (0.07, 0.1, 0.12), False),
        ((0.05, -0.14, 0.4), (0.11, 0.06, 0.055), False),
        ((-0.05, -0.14, 0.45), (0.11, 0.06, 0.055), False),
        ((0.0, -0.16, 0.36), (0.09, 0.05, 0.08), False),  # book
    ]
    bm = shapes.metaballs(lumps, 0.014)
    bm.normal_update()
    vertices = np.array([vertex.co for vertex in bm.verts])
    outward = np.array([vertex.normal for vertex in bm.verts])
    faces = np.array([[vertex.index for vertex in face.verts] for face in bm.faces])
    bm.free()
    x, y, z = vertices.T
    robe = (1 - masonry.smooth(z, 0.3, 0.42)) * np.sin(9 * np.arctan2(y, x) + 3 * masonry.noise_at(vertices, 4, shift))
    cloak = masonry.smooth(z, 0.42, 0.5) * (1 - masonry.smooth(z, 0.56, 0.62)) * np.sin(70 * (np.abs(x) * 0.7 + z))
    worn = masonry.noise_at(vertices, 14, shift)
    vertices = (
        vertices + outward * (0.013 * robe + 0.006 * cloak + 0.006 * worn)[:, None] + (NICHE.x, 0.06, NICHE.sill - 0.01)
    )
    centers, normals = shapes.centers_normals(vertices, faces[:, [0, 1, 2, 2]])
    slot = masonry.weather(centers, normals, shift + 2, damp=0.25, shelter=0.25)
    shapes.painted("statue", vertices, faces, stone, slot, np.full(len(faces), 0.55))


def _door(oak: bpy.types.Material, iron: bpy.types.Material, random: np.random.Generator) -> None:
    """Two leaves of boards with iron straps and nails on the same surface."""
    width, height = 2 * DOOR.radius + 0.04, DOOR.spring + DOOR.radius - DOOR.sill + 0.03
    x, z = np.meshgrid(np.linspace(-width / 2, width / 2, 96), np.linspace(0, height, 160))
    board = x / 0.118
    groove = np.abs(board - np.round(board)) * 0.118
    edge = DOOR.radius - np.abs(x)  # from the hinges inwards
    straps = np.zeros(x.shape, bool)
    for level in (0.2, 0.72, 1.2):
        taper = 0.034 * (1 - 0.45 * edge / 0.36) + 0.03 * np.exp(-(((edge - 0.33) / 0.025) ** 2))
        straps |= (np.abs(z - level) < taper) & (edge < 0.37)
    nails = np.hypot(board - np.floor(board) - 0.5, (z / 0.26 - np.round(z / 0.26)) * 0.26 / 0.118) * 0.118 < 0.017
    lock = np.hypot(x - 0.09, (z - 0.62) * 0.7) < 0.05
    metal = straps | nails | lock
    y = 0.27 + 0.012 * (1 - masonry.smooth(groove, 0.003, 0.014)) + 0.015 * (np.abs(x) < 0.008) - 0.014 * metal
    vertices, quads = shapes.sheet(np.stack([DOOR.x + x, y, DOOR.sill + z], 2))
    tint = random.uniform(0, 0.9, 12)[np.floor(shapes.per_face(quads, board)).astype(int) + 6]
    tint = np.where(shapes.per_face(quads, groove) < 0.008, 1.0, tint)
    shapes.painted("door", vertices, quads, [oak, iron], shapes.per_face(quads, metal.astype(float)) > 0.5, tint)


def _ironwork(iron: bpy.types.Material) -> None:
    """A railing beside the steps, the ring of the door, two wall anchors and a lantern bracket."""
    bm = bmesh.new()
    rail = DOOR.x + 0.86
    foot, head = Vector((rail, -1.05, 0.1)), Vector((rail, -0.2, 0.3))
    up = Vector((0, 0, 0.78))
    bars = [(foot + up, head + up, 0.024), (foot + up * 0.2, head + up * 0.2, 0.014)]
    for share in np.linspace(0, 1, 6):
        place = foot.lerp(head, float(share))
        bars.append((place - up * 0.08, place + up, 0.024 if share in (0, 1) else 0.014))
    for x, z in ((0.42, 1.2), (-1.68, 0.8)):  # anchors
        bars += [
            (Vector((x + s * 0.13, -0.03, z - 0.15)), Vector((x - s * 0.13, -0.03, z + 0.15)), 0.018) for s in (-1, 1)
        ]
    bars += [
        (Vector((0.42, 0, 1.72)), Vector((0.42, -0.36, 1.72)), 0.016),
        (Vector((0.42, 0, 1.5)), Vector((0.42, -0.3, 1.71)), 0.014),
    ]
    for start, end, radius in bars:
        turn = (end - start).to_track_quat("Z", "Y").to_matrix().to_4x4()
        matrix = Matrix.Translation((start + end) / 2) @ turn
        bmesh.ops.create_cone(
            bm, cap_ends=True, segments=10, radius1=radius, radius2=radius, depth=(end - start).length, matrix=matrix
        )
    for place in (foot + up, head + up):
        bmesh.ops.create_uvsphere(
            bm, u_segments=14, v_segments=10, radius=0.042, matrix=Matrix.Translation(place + Vector((0, 0, 0.04)))
        )
    lantern = Matrix.Translation((0.42, -0.33, 1.56)) @ Matrix.Diagonal((0.13, 0.13, 0.2, 1))
    bmesh.ops.create_cube(bm, matrix=lantern)
    bmesh.ops.create_cone(
        bm,
        cap_ends=True,
        segments=4,
        radius1=0.12,
        radius2=0.02,
        depth=0.09,
        matrix=Matrix.Translation((0.42, -0.33, 1.7)) @ Matrix.Rotation(math.pi / 4, 4, "Z"),
    )
    shapes.add("ironwork", shapes.from_bmesh("ironwork", bm), iron)
