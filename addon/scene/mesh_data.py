"""Arrays of a surface as Blender stores them, prepared away from Blender's main thread; numpy only, no bpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .package import Package

VOID_COLOR = [0.15, 0.15, 0.15]


@dataclass(frozen=True)
class MeshData:
    """One mesh of V vertices, E edges and F triangles.

    `vertices` (V, 3) float32; `edges` (E, 2) vertex indices; `corners`, `corner_edges` (3F,) vertex and edge of each
    corner, the edge leading to the next corner; `colors` (V, 4) float32 sRGB; `vertex_class` (V,), `face_class` (F,)
    class ids; `material` (F,) slot; `uv` (3F, 2) float32 or None. Indices and ids are int32.
    """

    vertices: np.ndarray
    edges: np.ndarray
    corners: np.ndarray
    corner_edges: np.ndarray
    colors: np.ndarray
    vertex_class: np.ndarray
    face_class: np.ndarray
    material: np.ndarray
    uv: np.ndarray | None


@dataclass(frozen=True)
class Part:
    """One object of the surface: its role in the scene (see build.py), its name and its mesh."""

    role: str
    name: str
    data: MeshData


def slot_classes(package: Package) -> list[dict]:
    """The classes in the order of the material slots; void first. An id that occurs twice keeps its first slot."""
    return [{"id": package.ignore_id, "name": "void", "color": VOID_COLOR}, *package.classes]


def parts(package: Package, split: bool) -> list[Part]:
    """The surface of a package as one mesh, or as one for each class that occurs; empty without a mesh."""
    arrays = package.mesh
    if arrays is None:
        return []
    slots: dict[int, int] = {}
    for index, entry in enumerate(slot_classes(package)):
        slots.setdefault(entry["id"], index)
    if not split:
        return [Part("mesh", "Surface", mesh_data(arrays, slots))]
    names = {entry["id"]: entry["name"] for entry in package.classes}
    made = []
    for number in np.unique(arrays["face_class"]).tolist():
        name = names.get(number, "void" if number == package.ignore_id else f"class {number}")
        part = part_of(arrays, arrays["face_class"] == number)
        made.append(Part(f"class:{number}", f"Surface · {name}", mesh_data(part, slots)))
    return made


def part_of(arrays: dict[str, np.ndarray], chosen: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of a mesh (see `Package.mesh`) for a mask (F,) of its faces, with the vertices these use."""
    used, corners = np.unique(arrays["faces"][chosen], return_inverse=True)
    per_face = {name: arrays[name][chosen] for name in ("face_class", "uv") if name in arrays}
    per_vertex = {name: arrays[name][used] for name in ("vertices", "colors", "class_id")}
    return {"faces": corners.reshape(-1, 3).astype(np.int32), **per_face, **per_vertex}


def mesh_data(arrays: dict[str, np.ndarray], slots: dict[int, int]) -> MeshData:
    """A mesh (see `Package.mesh`) as Blender stores it; `slots`: material slot of each class id, others get slot 0."""
    faces = arrays["faces"].astype(np.int32)
    classes = arrays["face_class"].astype(np.int32)
    uv = arrays.get("uv")
    # A triangle with two equal corners has no area, and Blender has no edge for it.
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    if not whole.all():
        faces, classes = faces[whole], classes[whole]
        uv = uv[whole] if uv is not None else None
    edges, corner_edges = edges_of(faces)
    slot_of = np.zeros(max(int(classes.max(initial=0)), *slots) + 1, np.int32)
    for number, slot in slots.items():
        slot_of[number] = slot
    return MeshData(
        vertices=np.ascontiguousarray(arrays["vertices"], np.float32),
        edges=edges,
        corners=faces.reshape(-1),
        corner_edges=corner_edges,
        colors=rgba(arrays["colors"]),
        vertex_class=arrays["class_id"].astype(np.int32),
        face_class=classes,
        material=slot_of[np.maximum(classes, 0)],
        uv=np.ascontiguousarray(uv, np.float32).reshape(-1, 2) if uv is not None else None,
    )


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2) of triangles (F, 3), each once, and the edge (3F,) from each corner to the next."""
    if not len(faces):
        return np.zeros((0, 2), np.int32), np.zeros(0, np.int32)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2).astype(np.int64)
    ends.sort(axis=1)
    stride = int(faces.max()) + 1
    keys, index = np.unique(ends[:, 0] * stride + ends[:, 1], return_inverse=True)
    return np.stack([keys // stride, keys % stride], -1).astype(np.int32), index.reshape(-1).astype(np.int32)


def rgba(rgb: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 as (N, 4) float32 in [0, 1], opaque."""
    out = np.ones((len(rgb), 4), np.float32)
    out[:, :3] = rgb.astype(np.float32) / 255
    return out
