"""A surface cut into the meshes that a file holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .features import Features
from .surface import Surface


@dataclass(frozen=True)
class Unwrapped:
    """A mesh whose vertices were split at UV seams: `source` (V,) original vertex, faces (F, 3), uv (V, 2) in [0, 1],
    v upwards."""

    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray


@dataclass(frozen=True)
class Texture:
    """A texture: image (S, S, 3) uint8 sRGB, and the mesh it belongs to."""

    image: np.ndarray
    unwrapped: Unwrapped


@dataclass(frozen=True)
class Part:
    """Some faces of a surface with the vertices they use.

    vertices, normals (V, 3) float32; faces (F, 3); colors (V, 3) uint8 sRGB; class_id (V,); feature (V,), and
    face_feature (F,), rows of a `Features`; uv (V, 2), v upwards, None without a texture. Where `make_part` did not
    split vertices between features, `feature` is that of some face of theirs.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    class_id: np.ndarray
    feature: np.ndarray
    face_feature: np.ndarray
    uv: np.ndarray | None = None


def texture_of(faces: np.ndarray, corner_uv: np.ndarray, image: np.ndarray) -> Texture:
    """The texture of a mesh by the UV (F, 3, 2) of its faces' (F, 3) corners: corners that agree share a vertex."""
    vertex = faces.reshape(-1).astype(np.int64)
    uv = np.ascontiguousarray(corner_uv.reshape(-1, 2), np.float32) + 0.0  # -0 becomes 0
    place = uv.view(np.uint64)[:, 0]  # both numbers at once, as they are only compared
    order = np.lexsort((place, vertex))
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(vertex[order]) != 0) | (place[order][1:] != place[order][:-1])
    index = np.empty(len(order), np.int32)
    index[order] = np.cumsum(new) - 1
    first = order[new]
    return Texture(image, Unwrapped(vertex[first], index.reshape(-1, 3), uv[first]))


def make_part(
    surface: Surface, features: Features, texture: Texture | None, chosen: np.ndarray, split_features: bool
) -> Part:
    """The faces `chosen` (indices); `split_features`: vertices on the border of two features are there twice, so that
    all corners of a face have its feature."""
    faces = (surface.faces if texture is None else texture.unwrapped.faces)[chosen].astype(np.int64)
    face_feature = features.face[chosen]
    count = len(features.rows) if split_features else 1
    key = faces * count + (face_feature[:, None] if split_features else 0)
    used, corners = np.unique(key, return_inverse=True)
    corners = corners.reshape(-1, 3)
    vertex = used // count
    source = vertex if texture is None else texture.unwrapped.source[vertex]
    feature = np.zeros(len(used), np.int64)
    feature[corners] = face_feature[:, None]
    return Part(
        surface.vertices[source],
        surface.normals[source],
        corners,
        surface.colors[source],
        surface.class_id[source],
        feature,
        face_feature,
        None if texture is None else texture.unwrapped.uv[vertex],
    )
