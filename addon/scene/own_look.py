"""Materials of its own for a surface that is the user's now: those of the project change with the next import."""

from __future__ import annotations

import bpy

from ..paths import absolute
from ..render.slot import painted
from ..roles import Owner, is_local
from .edited import release

TEXTURE = "fieldwork_texture"  # marks the images that are textures of a surface


def give_own_look(mesh: bpy.types.Mesh, owner: Owner) -> None:
    """Put copies in the place of a project's materials on a mesh. They look the same, and follow the slider as well."""
    groups: dict[str, bpy.types.NodeTree] = {}
    for slot, material in enumerate(mesh.materials):
        if material is None or not owner.owns(material):
            continue
        own = mesh.materials[slot] = material.copy()
        release(own)
        for node in own.node_tree.nodes if own.node_tree is not None else ():
            if node.type == "GROUP" and node.node_tree is not None and owner.owns(node.node_tree):
                name = node.node_tree.name
                if name not in groups:
                    groups[name] = _own_group(node.node_tree)
                node.node_tree = groups[name]


def remove_unused_textures() -> None:
    """Take away the textures of earlier meshes that nothing shows any more; those that the user painted on stay."""
    for image in [image for image in bpy.data.images if TEXTURE in image and image.users == 0 and is_local(image)]:
        if painted(image):
            image.use_fake_user = True
        else:
            bpy.data.images.remove(image)


def _own_group(tree: bpy.types.NodeTree) -> bpy.types.NodeTree:
    own = tree.copy()
    release(own)
    for node in own.nodes:
        if node.type == "TEX_IMAGE" and node.image is not None and TEXTURE in node.image:
            _pack(node.image)
    return own


def _pack(image: bpy.types.Image) -> None:
    """Put a texture into the .blend: the package keeps those of earlier meshes only for a while."""
    packed = image.packed_file is not None or painted(image)
    if not packed and absolute(image.filepath).is_file():
        image.pack()
