"""Meshes of the simulated scenes, and the empty scene they are put into. Metres."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import bmesh
import bpy
import numpy as np
from mathutils import Matrix

Point = tuple[float, float, float]


def new_scene() -> bpy.types.Scene:
    """Replace everything in this Blender by an empty scene that renders fast: one diffuse bounce, no caustics."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)  # unlike factory settings, keeps extensions
    scene = bpy.context.scene
    scene.view_settings.view_transform = "Standard"
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 2, 1, 0
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    return scene


def add(name: str, mesh: bpy.types.Mesh, *slots: bpy.types.Material) -> bpy.types.Object:
    for material in slots:
        mesh.materials.append(material)
    item = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(item)
    return item


def from_bmesh(name: str, bm: bmesh.types.BMesh, smooth: bool = False) -> bpy.types.Mesh:
    for face in bm.faces:
        face.smooth = smooth
    bmesh.ops.recalc_face_normals(bm, faces=bm.faces)
    mesh = bpy.data.meshes.new(name)
    bm.to_mesh(mesh)
    bm.free()
    return mesh


def boxes(
    name: str, boxes: list[tuple[tuple[float, float, float], tuple[float, float, float]]], bevel: float
) -> bpy.types.Mesh:
    """Bevelled boxes, each given by its centre and its size."""
    bm = bmesh.new()
    for center, size in boxes:
        bmesh.ops.create_cube(bm, matrix=Matrix.Translation(center) @ Matrix.Diagonal((*size, 1)))
    bmesh.ops.bevel(bm, geom=bm.edges[:], offset=bevel, segments=2, affect="EDGES", profile=0.5)
    return from_bmesh(name, bm)


def grid(
    width: float, depth: float, nx: int, ny: int, place: Callable[[float, float], tuple[float, float, float]]
) -> bmesh.types.BMesh:
    """A grid of quads; `place(x, y)` gives the position of the vertex at x, y around the origin."""
    bm = bmesh.new()
    rows = [
        [bm.verts.new(place(width * (i / nx - 0.5), depth * (j / ny - 0.5))) for i in range(nx + 1)]
        for j in range(ny + 1)
    ]
    for below, above in itertools.pairwise(rows):
        for i in range(nx):
            bm.faces.new((below[i], below[i + 1], above[i + 1], above[i]))
    return bm


def lathe(profile: list[tuple[float, float]], steps: int = 64) -> bmesh.types.BMesh:
    """A profile of (radius, height) pairs turned around the z axis, closed at both ends."""
    bm = bmesh.new()
    rows = [
        [bm.verts.new((r * math.cos(a), r * math.sin(a), z)) for a in (2 * math.pi * i / steps for i in range(steps))]
        for r, z in profile
    ]
    for below, above in itertools.pairwise(rows):
        for i in range(steps):
            bm.faces.new((below[i], below[(i + 1) % steps], above[(i + 1) % steps], above[i]))
    bm.faces.new(reversed(rows[0]))
    bm.faces.new(rows[-1])
    return bm


def metaballs(lumps: Sequence[tuple[Point, Point, bool]], resolution: float) -> bmesh.types.BMesh:
    """The triangulated surface around ellipsoids, each (centre, half axes, whether it is cut out); metres."""
    data = bpy.data.metaballs.new("lumps")
    data.resolution = data.render_resolution = resolution
    data.threshold = 0.3
    for center, size, negative in lumps:
        element = data.elements.new(type="ELLIPSOID")
        element.co, element.radius, element.stiffness = center, 1.0, 2.0
        element.size_x, element.size_y, element.size_z = size
        element.use_negative = negative
    ball = bpy.data.objects.new("lumps", data)
    bpy.context.scene.collection.objects.link(ball)
    bpy.context.view_layer.update()
    mesh = bpy.data.meshes.new_from_object(ball.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    bpy.data.objects.remove(ball)
    bm = bmesh.new()
    bm.from_mesh(mesh)
    bpy.data.meshes.remove(mesh)
    bmesh.ops.triangulate(bm, faces=bm.faces[:])
    return bm


def sheet(points: np.ndarray, wrap: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n * m, 3) and quads (F, 4) of a grid of points (n, m, 3); `wrap` closes it along m."""
    n, m = points.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    if wrap:
        index = np.concatenate([index, index[:, :1]], 1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1)
    return points.reshape(-1, 3), quads.reshape(-1, 4)


def centers_normals(vertices: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (F, 3) and unit normals (F, 3) of quads (F, 4)."""
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    normals = np.cross(c - a, d - b)
    return (a + b + c + d) / 4, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def per_face(quads: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means (F,) over each of the quads (F, 4) of the values of the vertices, in any shape."""
    return values.reshape(-1)[quads].mean(1)


def painted(
    name: str,
    vertices: np.ndarray,
    faces: Sequence[Sequence[int]] | np.ndarray,
    slots: Sequence[bpy.types.Material],
    slot: np.ndarray,
    tint: np.ndarray | None = None,
    smooth: bool = True,
) -> bpy.types.Object:
    """A mesh whose faces have each their own material, so that classes share one surface.

    Args:
        vertices: (V, 3) metres.
        faces: (F,) corners of each face.
        slot: (F,) index into `slots` per face.
        tint: (F,) in 0 to 1, read by materials as the attribute "tint".
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], np.asarray(faces).tolist())
    item = add(name, mesh, *slots)
    mesh.polygons.foreach_set("material_index", np.asarray(slot, np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(mesh.polygons), smooth))
    if tint is not None:
        mesh.attributes.new("tint", "FLOAT", "FACE").data.foreach_set("value", np.asarray(tint, np.float32))
    mesh.update()
    return item
