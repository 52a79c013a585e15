"""Arrays of a surface as Blender stores them, prepared away from Blender's main thread; numpy only, no bpy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from .package import Package

VOID_COLOR = [0.15, 0.15, 0.15]


class MeshData(NamedTuple):
    """One mesh of V vertices, E edges and F triangles.

    `vertices` (V, 3) float32; `edges` (E, 2) vertex indices; `corners`, `corner_edges` (3F,) vertex and edge of each
    corner, the edge leading to the next corner; `colors` (V, 4), `face_colors` (F, 4) float32 sRGB of the photos and of the
    classes; `vertex_class` (V,), `face_class` (F,) class ids; `face_instance` (F,), 0 for none; `confidence` (V,) float32 of
    the classes; `material` (F,) slot; `uv` (3F, 2) float32 or None; `unseen` (F,) bool of faces that close what no photo
    shows, or None. Indices and ids are int32.
    """

    vertices: np.ndarray
    edges: np.ndarray
    corners: np.ndarray
    corner_edges: np.ndarray
    colors: np.ndarray
    face_colors: np.ndarray
    vertex_class: np.ndarray
    face_class: np.ndarray
    face_instance: np.ndarray
    confidence: np.ndarray
    material: np.ndarray
    uv: np.ndarray | None
    unseen: np.ndarray | None


@dataclass(frozen=True)
class Part:
    """One object of the surface: its role in the scene (see build.py), its name and its mesh; `group`: the class whose
    collection it stands in, empty for none; `measured`: what was measured of it, see `Package.measures`."""

    role: str
    name: str
    data: MeshData
    group: str = ""
    measured: dict[str, Any] = field(default_factory=dict)


def slot_classes(package: Package) -> list[dict]:
    """The classes in the order of the material slots; void first. An id that occurs twice keeps its first slot."""
    return [{"id": package.ignore_id, "name": "void", "color": VOID_COLOR}, *package.classes]


def parts(package: Package, split: str) -> list[Part]:
    """The surface of a package as one mesh ("none"), or as one for each class or instance that occurs; empty without a
    mesh. Faces of no instance are together by class."""
    arrays = package.mesh
    if arrays is None:
        return []
    slots, colors = class_slots(package)
    if split == "none":
        return [Part("mesh", "Surface", mesh_data(arrays, slots, colors))]
    classes, instances = arrays["face_class"].astype(np.int64), np.zeros(len(arrays["faces"]), np.int64)
    if split == "instances" and "face_instance" in arrays:
        instances = arrays["face_instance"].astype(np.int64)
    called = {entry["id"]: entry["name"] for entry in package.instances}
    pairs, index = np.unique(np.stack([classes, instances], 1), axis=0, return_inverse=True)
    made = []
    for number, (class_id, instance) in enumerate(pairs.tolist()):
        group = class_name(package, class_id)
        name = called.get(instance, f"{group}.{instance:03d}") if instance else group
        data = mesh_data(part_of(arrays, index.reshape(-1) == number), slots, colors)
        role = f"instance:{instance}" if instance else f"class:{class_id}"
        measured = measured_of(package, "instances" if instance else "classes", instance or class_id)
        # What is left of a class beside its instances was not measured.
        whole = instance or not (instances[classes == class_id] > 0).any()
        made.append(Part(role, name, data, group, measured if whole else {}))
    return made


def class_slots(package: Package) -> tuple[dict[int, int], np.ndarray]:
    """Material slot of each class id, and colour (S, 4) sRGB of each slot."""
    entries = slot_classes(package)
    slots: dict[int, int] = {}
    for index, entry in enumerate(entries):
        slots.setdefault(entry["id"], index)
    return slots, np.array([[*entry["color"], 1.0] for entry in entries], np.float32)


def class_name(package: Package, class_id: int) -> str:
    names = {entry["id"]: entry["name"] for entry in package.classes}
    return names.get(class_id, "void" if class_id == package.ignore_id else f"class {class_id}")


def measured_of(package: Package, kind: str, number: int) -> dict[str, Any]:
    """What was measured of a class or instance ("classes", "instances"); empty where nothing was."""
    return next((row for row in package.measures.get(kind, []) if row["id"] == number), {})


def part_of(arrays: dict[str, np.ndarray], chosen: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of a mesh (see `Package.mesh`) for a mask (F,) of its faces, with the vertices these use."""
    used, corners = np.unique(arrays["faces"][chosen], return_inverse=True)
    per_face = {
        name: arrays[name][chosen] for name in ("face_class", "face_instance", "uv", "unseen") if name in arrays
    }
    per_vertex = {
        name: arrays[name][used] for name in ("vertices", "colors", "class_id", "confidence") if name in arrays
    }
    return {"faces": corners.reshape(-1, 3).astype(np.int32), **per_face, **per_vertex}


def mesh_data(arrays: dict[str, np.ndarray], slots: dict[int, int], colors: np.ndarray) -> MeshData:
    """A mesh (see `Package.mesh`) as Blender stores it; `slots`, `colors`: see `class_slots`; unknown classes get slot 0."""
    faces = arrays["faces"].astype(np.int32)
    count = len(arrays["vertices"])
    per_face = {
        "class": arrays["face_class"].astype(np.int32),
        "instance": np.asarray(arrays.get("face_instance", np.zeros(len(faces)))).astype(np.int32),
        "uv": arrays.get("uv"),
        "unseen": arrays.get("unseen"),
    }
    # A triangle with two equal corners has no area, and Blender has no edge for it.
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    if not whole.all():
        faces = faces[whole]
        per_face = {name: values if values is None else values[whole] for name, values in per_face.items()}
    classes, uv = per_face["class"], per_face["uv"]
    edges, corner_edges = edges_of(faces)
    slot_of = np.zeros(max(int(classes.max(initial=0)), *slots) + 1, np.int32)
    for number, slot in slots.items():
        slot_of[number] = slot
    material = slot_of[np.maximum(classes, 0)]
    return MeshData(
        vertices=np.ascontiguousarray(arrays["vertices"], np.float32),
        edges=edges,
        corners=faces.reshape(-1),
        corner_edges=corner_edges,
        colors=rgba(arrays["colors"]),
        face_colors=colors[material],
        vertex_class=arrays["class_id"].astype(np.int32),
        face_class=classes,
        face_instance=per_face["instance"],
        confidence=np.ascontiguousarray(arrays.get("confidence", np.zeros(count)), np.float32),
        material=material,
        uv=np.ascontiguousarray(uv, np.float32).reshape(-1, 2) if uv is not None else None,
        unseen=per_face["unseen"],
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
