"""The built-in scene "museum": a gilded stone bust on its plinth among a chest, a vase, a carpet and a banner.

Metres, z up, the floor at z = 0. The gilding is painted on the same surfaces as the stone.
"""

from __future__ import annotations

import math

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector, noise

from ..photograph.orbit import rings
from . import materials, shapes

CLASSES = {1: "stone", 2: "gilding", 3: "wood", 4: "textile", 5: "ceramic", 6: "floor", 7: "wall"}
COLORS = {  # sRGB, 0 to 255
    1: (184, 176, 163),
    2: (242, 184, 31),
    3: (128, 71, 31),
    4: (199, 31, 51),
    5: (41, 107, 209),
    6: (92, 97, 102),
    7: (115, 158, 107),
}
HALF, HEIGHT = 2.1, 1.35  # of the room's walls, metres
TARGET = np.array([0.0, 0.0, 0.56])
RINGS = [(0.38, 1.75, 16.0), (0.37, 1.8, 33.0), (0.25, 1.7, 56.0)]
OVERVIEW = [(1.0, 3.1, 37.0)]  # over the walls, which are low: what stands before them is seen from behind


def build(seed: int) -> bpy.types.Scene:
    """Replace everything in this Blender by the scene; `seed` moves the textures and the ornament."""
    scene = shapes.new_scene()
    noise.seed_set(seed + 1)
    shift = Vector(np.random.default_rng(seed).uniform(-20, 20, 3).tolist())
    stone, gold = materials.stone(1), materials.gilding(2)
    carpet, banner = materials.textile(4), materials.textile(4, "banner", (math.pi / 2, 0, 0))
    _light(scene)
    _room(materials.floor(6), materials.wall(7))
    _bust(stone, gold, shift)
    _plinth(stone, gold)
    _chest(materials.wood(3))
    _vase(materials.ceramic(5), shift)
    _carpet(carpet, shift)
    _banner(banner)
    return scene


def poses(views: int, seed: int) -> list[np.ndarray]:
    """Camera-to-world (4, 4), OpenGL axes, of a photographer's walk around the bust."""
    return rings(views, RINGS, TARGET, seed)


def overviews(views: int, seed: int) -> list[np.ndarray]:
    """The same, of photos of the whole from farther away."""
    return rings(views, OVERVIEW, TARGET, seed + 1)


def _light(scene: bpy.types.Scene) -> None:
    world = bpy.data.worlds.new("overcast")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs[0].default_value = (0.62, 0.68, 0.76, 1)
    background.inputs[1].default_value = 0.75
    scene.world = world
    for name, position, size, power, colour in (
        ("key", (1.6, -1.9, 3.4), 2.6, 95, (1.0, 0.94, 0.85)),
        ("fill", (-2.2, 1.2, 3.2), 3.0, 45, (0.85, 0.92, 1.0)),
    ):
        data = bpy.data.lights.new(name, "AREA")
        data.size, data.energy, data.color = size, power, colour
        light = bpy.data.objects.new(name, data)
        light.location = position
        light.rotation_euler = (Vector((0, 0, 0.4)) - light.location).to_track_quat("-Z", "Y").to_euler()
        scene.collection.objects.link(light)


def _room(floor: bpy.types.Material, wall: bpy.types.Material) -> None:
    shapes.add(
        "floor", shapes.from_bmesh("floor", shapes.grid(2 * HALF, 2 * HALF, 1, 1, lambda x, y: (x, y, 0.0))), floor
    )
    thick = 0.12
    far, length = HALF + thick / 2, 2 * HALF + 2 * thick
    boxes = [((s * far, 0, HEIGHT / 2), (thick, length, HEIGHT)) for s in (-1, 1)]
    boxes += [((0, s * far, HEIGHT / 2), (length, thick, HEIGHT)) for s in (-1, 1)]
    boxes += [((s * (HALF - 0.03), 0, 0.05), (0.06, 2 * HALF, 0.1)) for s in (-1, 1)]
    boxes += [((0, s * (HALF - 0.03), 0.05), (2 * HALF, 0.06, 0.1)) for s in (-1, 1)]
    shapes.add("wall", shapes.boxes("wall", boxes, 0.008), wall)


def _plinth(stone: bpy.types.Material, gold: bpy.types.Material) -> None:
    mesh = shapes.boxes(
        "plinth",
        [
            ((0, 0, 0.04), (0.56, 0.56, 0.08)),
            ((0, 0, 0.11), (0.5, 0.5, 0.06)),
            ((0, 0, 0.48), (0.5, 0.5, 0.06)),
            ((0, 0, 0.53), (0.56, 0.56, 0.05)),
        ],
        0.012,
    )
    shapes.add("plinth", mesh, stone)
    # The shaft is finely divided, so that ornament can be gilded face by face on the one stone surface.
    bm, size, height = bmesh.new(), 0.43, 0.32
    bmesh.ops.create_cube(bm, matrix=Matrix.Translation((0, 0, 0.295)) @ Matrix.Diagonal((size, size, height, 1)))
    bmesh.ops.subdivide_edges(bm, edges=bm.edges[:], cuts=63, use_grid_fill=True)
    for face in bm.faces:
        x, y, z = face.calc_center_median()
        u = (y if abs(abs(x) - size / 2) < 1e-4 else x) / (size / 2)
        v = (z - 0.295) / (height / 2)
        lozenge = abs(u) + abs(v)
        rosette = math.hypot(u, v) < 0.3 + 0.06 * math.cos(8 * math.atan2(v, u))
        border = 0.74 < max(abs(u), abs(v)) < 0.9
        face.material_index = int(0.52 < lozenge < 0.7 or rosette or border)
    shapes.add("plinth shaft", shapes.from_bmesh("plinth shaft", bm), stone, gold)


def _bust(stone: bpy.types.Material, gold: bpy.types.Material, shift: Vector) -> None:
    lumps = []

    def lump(center: tuple[float, float, float], size: tuple[float, float, float], negative: bool = False) -> None:
        lumps.append((center, size, negative))

    lump((0, 0, 0.075), (0.15, 0.15, 0.13))  # socle
    lump((0, 0.01, 0.22), (0.33, 0.19, 0.17))  # shoulders
    lump((0, -0.04, 0.17), (0.22, 0.19, 0.18))  # chest
    lump((0, 0.0, 0.36), (0.11, 0.115, 0.18))  # neck
    lump((0, -0.005, 0.54), (0.165, 0.19, 0.215))  # head
    lump((0, -0.07, 0.44), (0.1, 0.1, 0.08))  # chin
    lump((0, -0.185, 0.515), (0.035, 0.06, 0.065))  # nose
    lump((0, -0.15, 0.455), (0.065, 0.05, 0.03))  # mouth
    lump((0, -0.135, 0.585), (0.14, 0.06, 0.035))  # brow
    for side in (-1, 1):
        lump((side * 0.056, -0.2, 0.555), (0.045, 0.07, 0.04), negative=True)
        lump((side * 0.15, 0.02, 0.52), (0.035, 0.06, 0.07))  # ears
    lump((0, 0.13, 0.56), (0.13, 0.13, 0.13))  # bun
    bm = shapes.metaballs(lumps, 0.016)
    bm.normal_update()
    moved = []
    for vertex in bm.verts:
        x, y, z = vertex.co
        hair = min(max((z - 0.6 + 0.5 * y + 0.1) / 0.04, 0), 1) * (z > 0.4)
        curls = 1 - 2 * min(noise.voronoi((vertex.co + shift) * 22)[0][0], 0.5)
        folds = math.sin(34 * (x * 0.5 + abs(x) + z) + 6 * noise.noise(vertex.co * 7 + shift)) * (0.1 < z < 0.29)
        rough = noise.fractal(vertex.co * 24 + shift, 1.0, 2.0, 4)
        moved.append(vertex.co + vertex.normal * (0.022 * hair * curls + 0.007 * folds + 0.0025 * rough))
    for vertex, position in zip(bm.verts, moved):
        vertex.co = position
    for face in bm.faces:
        x, y, z = face.calc_center_median()
        angle = math.atan2(y, x)
        band = z - 0.625 - 0.12 * y
        wreath = abs(band) < 0.03 + 0.013 * math.cos(18 * angle)
        collar = abs(z - 0.305 + 0.05 * math.cos(2 * angle)) < 0.026 and math.hypot(x, y) > 0.085
        medal = math.hypot(x, z - 0.21) < 0.055 and y < 0
        face.material_index = int(wreath or collar or medal)
    bust = shapes.add("bust", shapes.from_bmesh("bust", bm, smooth=True), stone, gold)
    bust.location, bust.scale = (0, 0, 0.54), (0.82, 0.82, 0.82)
    bust.rotation_euler = (0, 0, math.radians(-25))


def _chest(wood: bpy.types.Material) -> None:
    mesh = shapes.boxes(
        "chest",
        [((0, 0, 0.17), (0.62, 0.36, 0.28)), ((0, 0, 0.035), (0.66, 0.4, 0.05)), ((0, 0, 0.325), (0.65, 0.39, 0.03))]
        + [((x, 0, 0.17), (0.06, 0.385, 0.28)) for x in (-0.24, 0.24)],
        0.01,
    )
    bm = bmesh.new()
    bm.from_mesh(mesh)
    lid = bmesh.ops.create_cone(bm, cap_ends=True, segments=40, radius1=0.18, radius2=0.18, depth=0.62)["verts"]
    bmesh.ops.transform(
        bm,
        verts=lid,
        matrix=Matrix.Translation((0, 0, 0.335))
        @ Matrix.Diagonal((1, 1, 0.62, 1))
        @ Matrix.Rotation(math.pi / 2, 4, "Y"),
    )
    bpy.data.meshes.remove(mesh)
    chest = shapes.add("chest", shapes.from_bmesh("chest", bm), wood)
    chest.location, chest.rotation_euler = (0.72, -0.42, 0), (0, 0, math.radians(28))


def _vase(ceramic: bpy.types.Material, shift: Vector) -> None:
    profile = [(0.1, 0), (0.115, 0.02), (0.085, 0.05), (0.12, 0.13), (0.185, 0.25), (0.205, 0.35), (0.175, 0.45)]
    profile += [(0.1, 0.52), (0.075, 0.57), (0.085, 0.62), (0.125, 0.655), (0.13, 0.67), (0.105, 0.665), (0.06, 0.6)]
    points = np.array(profile)
    knots, fine = np.arange(len(points)), np.linspace(0, len(points) - 1, 70)
    smooth = [(float(np.interp(t, knots, points[:, 0])), float(np.interp(t, knots, points[:, 1]))) for t in fine]
    vase = shapes.add("vase", shapes.from_bmesh("vase", shapes.lathe(smooth), smooth=True), ceramic)
    vase.location, vase.rotation_euler = (-0.72, -0.3, 0.02), (0, 0, shift.x)


def _carpet(textile: bpy.types.Material, shift: Vector) -> None:
    def place(x: float, y: float) -> tuple[float, float, float]:
        return x, y, 0.012 + 0.007 * noise.noise(Vector((x * 3, y * 3, 0)) + shift)

    carpet = shapes.add(
        "carpet", shapes.from_bmesh("carpet", shapes.grid(2.2, 1.5, 80, 60, place), smooth=True), textile
    )
    carpet.rotation_euler = (0, 0, math.radians(8))
    carpet.modifiers.new("thickness", "SOLIDIFY").thickness = -0.01


def _banner(textile: bpy.types.Material) -> None:
    def place(x: float, y: float) -> tuple[float, float, float]:
        return x, 0.035 * math.sin(9 * x + 1.5 * y), y

    banner = shapes.add(
        "banner", shapes.from_bmesh("banner", shapes.grid(1.3, 1.0, 80, 30, place), smooth=True), textile
    )
    banner.location = (-0.3, HALF - 0.1, 0.74)
    banner.modifiers.new("thickness", "SOLIDIFY").thickness = 0.012
