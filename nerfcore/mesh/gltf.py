"""Binary glTF 2.0 with a matt material, and what each face is.

`_FEATURE_ID_0` of each vertex is a row of a property table with the class, its colour and the instance
(extensions EXT_mesh_features and EXT_structural_metadata, as 3D Tiles 1.1 uses them).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from ..files import atomic_path
from ..images.picture import srgb_to_linear
from ..project.label_revision import label_facts
from .features import Feature, Features
from .parts import Part

# Exporters keep attributes with a leading underscore; this one becomes glTF's COLOR_0.
LINEAR_COLOR = "_linear_color"
FEATURE_ID = "_FEATURE_ID_0"
SCHEMA_CLASS = "feature"
UNSIGNED_SHORT = 5123
PROPERTIES = {
    "class_id": {"type": "SCALAR", "componentType": "UINT32", "description": "class of the label maps"},
    "class_name": {"type": "STRING"},
    "color": {
        "type": "VEC3",
        "componentType": "UINT8",
        "normalized": True,
        "description": "colour of the class, sRGB",
    },
    "instance": {"type": "SCALAR", "componentType": "UINT32", "description": "0: no instances are told apart"},
    "instance_name": {"type": "STRING"},
}


def write_glb(
    path: Path, parts: dict[str, Part], features: Features, png: bytes | None, check: Callable[[], None]
) -> None:
    """Write parts, y up, as one GLB of a named mesh each; `Part.feature` counts the rows of `features`; `png`: the
    file of the texture, if they have one.

    Raises:
        DiskError: the file cannot be written. What `check` raises, between steps.
    """
    rows = features.rows
    arrays = _columns(rows)
    first: list[int] = []  # number of the first buffer view of the table, known once those of the meshes are

    def add_table(items: Any, tree: dict[str, Any]) -> None:
        check()
        for image in tree["images"]:
            assert png is not None
            items[list(items)[image["bufferView"]]] = png + b"\0" * (-len(png) % 4)
        # The table's views start at multiples of eight bytes.
        last = list(items)[-1]
        items[last] += b"\0" * (-sum(map(len, items.values())) % 8)
        first.append(len(items))
        for name, data in arrays.items():
            items[name] = data + b"\0" * (-len(data) % 8)

    def finish(tree: dict[str, Any]) -> None:
        for mesh in tree["meshes"]:
            mesh.pop("extras", None)
            _name_attributes(tree, mesh["primitives"][0], len(rows))
        views = {name: first[0] + number for number, name in enumerate(arrays)}
        for name, view in views.items():
            tree["bufferViews"][view]["byteLength"] = len(arrays[name])
        tree["extensions"] = {"EXT_structural_metadata": _metadata(views, len(rows))}
        tree["asset"] |= extras(features.label_revision)
        tree["extensionsUsed"] = ["EXT_mesh_features", "EXT_structural_metadata"]

    scene = trimesh.Scene({name: _mesh(part) for name, part in parts.items()})
    check()
    content = export_glb(scene, include_normals=True, buffer_postprocessor=add_table, tree_postprocessor=finish)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def extras(label_revision: int | None) -> dict[str, Any]:
    """What `asset` of a file says beside glTF's own words; nothing where there is nothing to say."""
    facts = label_facts(label_revision)
    return {"extras": facts} if facts else {}


def _mesh(part: Part) -> trimesh.Trimesh:
    """A part as trimesh has it; texture or vertex colour alone decide how it looks."""
    matt: dict[str, Any] = {"baseColorFactor": [255, 255, 255, 255], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    # 16 bits: 8 bits of linear light would make dark colours alike.
    attributes: dict[str, Any] = {
        FEATURE_ID: part.feature.astype(np.uint16 if part.feature.max(initial=0) < 65536 else np.float32)
    }
    if part.uv is not None:
        stands_in = Image.new("RGB", (1, 1))  # for the texture, whose file takes its place
        look = TextureVisuals(uv=part.uv, material=PBRMaterial(baseColorTexture=stands_in, **matt))
    else:
        color = srgb_to_linear(part.colors / 255)
        attributes[LINEAR_COLOR] = (np.pad(color, ((0, 0), (0, 1)), constant_values=1) * 65535 + 0.5).astype(np.uint16)
        look = TextureVisuals(material=PBRMaterial(**matt))
    return trimesh.Trimesh(
        part.vertices,
        part.faces,
        vertex_normals=part.normals,
        vertex_attributes=attributes,
        visual=look,
        process=False,
    )


def _name_attributes(tree: dict[str, Any], primitive: dict[str, Any], count: int) -> None:
    """Make our linear vertex colours glTF's, and our feature ids scalars, which trimesh writes with a column of padding;
    tell what they are."""
    attributes = primitive["attributes"]
    if LINEAR_COLOR in attributes:
        accessor = attributes["COLOR_0"] = attributes.pop(LINEAR_COLOR)
        tree["accessors"][accessor]["normalized"] = True
    accessor = tree["accessors"][attributes[FEATURE_ID]]
    if accessor["componentType"] == UNSIGNED_SHORT:
        accessor["type"] = "SCALAR"
        accessor["min"], accessor["max"] = accessor["min"][:1], accessor["max"][:1]
        tree["bufferViews"][accessor["bufferView"]]["byteStride"] = 4
    features = [{"featureCount": count, "attribute": 0, "propertyTable": 0, "label": "surface"}]
    primitive["extensions"] = {"EXT_mesh_features": {"featureIds": features}}


def _columns(rows: list[Feature]) -> dict[str, bytes]:
    """The bytes of the table's columns; strings are one after the other, ":offsets" says where each begins."""
    columns = {
        "class_id": np.array([row.class_id for row in rows], "<u4").tobytes(),
        "color": (np.array([row.color for row in rows]).reshape(-1, 3) * 255 + 0.5).astype(np.uint8).tobytes(),
        "instance": np.array([row.instance for row in rows], "<u4").tobytes(),
    }
    for name in ("class_name", "instance_name"):
        texts = [getattr(row, name).encode() for row in rows]
        columns[name] = b"".join(texts) or b"\0"  # a buffer view has at least one byte
        columns[f"{name}:offsets"] = np.cumsum([0, *map(len, texts)]).astype("<u4").tobytes()
    return columns


def _metadata(views: dict[str, int], count: int) -> dict[str, Any]:
    """The value of EXT_structural_metadata for columns in these buffer views."""
    values: dict[str, Any] = {name: {"values": views[name]} for name in PROPERTIES}
    for name in PROPERTIES:
        if f"{name}:offsets" in views:
            values[name] |= {"stringOffsets": views[f"{name}:offsets"], "stringOffsetType": "UINT32"}
    return {
        "schema": {
            "id": "fieldwork_surface",
            "classes": {SCHEMA_CLASS: {"name": "Surface feature", "properties": PROPERTIES}},
        },
        "propertyTables": [{"name": "features", "class": SCHEMA_CLASS, "count": count, "properties": values}],
    }
