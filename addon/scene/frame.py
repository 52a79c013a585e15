"""Where the capture's own frame (metres, z up) lies in a scene: its parent may be moved, turned and scaled."""

from __future__ import annotations

import bpy
from mathutils import Matrix

from ..roles import ROLE, Owner, is_local


def root_of(scene: bpy.types.Scene, owner: Owner | None) -> bpy.types.Object | None:
    """The empty under which everything of a project hangs in a scene, rather one that is not linked from another file; None
    where nothing was imported."""
    if owner is None:
        return None
    roots = [item for item in scene.objects if item.get(ROLE) == "root" and owner.owns(item)]
    return next((root for root in roots if is_local(root)), roots[0] if roots else None)


def scene_from_capture(scene: bpy.types.Scene, owner: Owner | None) -> Matrix:
    """The matrix (4×4) from the capture's frame to the scene; only the units' factor where nothing was imported."""
    root = root_of(scene, owner)
    return world_of(root) if root is not None else Matrix.Scale(units_per_metre(scene), 4)


def world_of(item: bpy.types.Object) -> Matrix:
    """An object's matrix (4×4) to the world. Blender neither stores `matrix_world` nor computes it for what is excluded from
    the view layer or disabled in viewports: it is made of the object's own values, unless a constraint or a path places it."""
    parent = item.parent
    follows = parent is not None and parent.type == "CURVE" and parent.data.use_path
    if len(item.constraints) or follows or (parent is not None and item.parent_type != "OBJECT"):
        return item.matrix_world.copy()
    if parent is None:
        return item.matrix_basis.copy()
    return world_of(parent) @ item.matrix_parent_inverse @ item.matrix_basis


def units_per_metre(scene: bpy.types.Scene) -> float:
    """How many of the scene's units are a metre."""
    return 1.0 / (scene.unit_settings.scale_length or 1.0)
