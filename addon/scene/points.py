"""The sparse points: loose vertices, and a node group that draws each as a tiny coloured ball, in the viewport only."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from .edited import WRITTEN, Steps, mesh_fingerprint
from .look import shader_group
from .materials import make_material
from .mesh_data import rgba
from .owned import Owned
from .package import Package
from .slices import Held
from .surface import set_colors, set_values

NAME = "Fieldwork Points"
RADIUS = "fieldwork_radius"  # of the balls, as it was written: the user may choose another


def sparse_points(owned: Owned, package: Package) -> Steps:
    """The object of the package's points; beside one whose points the user edited. Returns it."""
    # Vertices with a colour attribute work in every version, in every exporter, and stay in the file.
    held = Held(bpy.data.meshes, bpy.data.meshes.new("Sparse points"))
    fill_points(held(), package.xyz, rgba(package.rgb))
    fingerprint = yield from mesh_fingerprint(held)
    held()[WRITTEN] = fingerprint
    item = yield from owned.with_mesh("points", "Sparse points", held)
    centers = np.array([np.array(c["camera_to_world"])[:3, 3] for c in package.cameras]).reshape(-1, 3)
    group = shader_group(owned.owner, "points", owned.root)
    material = make_material(owned.owner, "points", [0.8, 0.8, 0.8], group, is_class=False)
    show_points(item, float(np.ptp(centers, axis=0).max(initial=0.0)) / 600 or 0.005, material)
    return item


def fill_points(mesh: bpy.types.Mesh, xyz: np.ndarray, colors: np.ndarray) -> None:
    """Fill an empty mesh with loose vertices (N, 3) in colours (N, 4), sRGB in [0, 1]."""
    mesh.vertices.add(len(xyz))
    set_values(mesh, "position", "vector", np.ascontiguousarray(xyz, np.float32))
    set_colors(mesh, colors)
    mesh.update()


def show_points(item: bpy.types.Object, radius: float, material: bpy.types.Material) -> None:
    """Give a mesh of vertices balls of `radius` (its own units) with the vertices' attributes, if it has none yet.

    The object's data stay plain vertices with a colour attribute.
    """
    modifier = next((m for m in item.modifiers if m.type == "NODES" and m.name.startswith(NAME)), None)
    if modifier is None:
        modifier = item.modifiers.new(NAME, "NODES")
        modifier.show_render = False
    modifier.node_group = _group(item.name, radius, material, modifier.node_group)


def _group(name: str, radius: float, material: bpy.types.Material, tree: Any) -> Any:
    if tree is None:
        tree = bpy.data.node_groups.new(f"{NAME} · {name}", "GeometryNodeTree")
        tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
        tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
        kinds = ("NodeGroupInput", "GeometryNodeInstanceOnPoints", "GeometryNodeJoinGeometry")
        kinds += ("GeometryNodeRealizeInstances", "GeometryNodeSetMaterial", "NodeGroupOutput")
        nodes = [tree.nodes.new(kind) for kind in kinds]
        for column, (node, following) in enumerate(zip(nodes, [*nodes[1:], None])):
            node.location = (200 * column, 0)
            if following is not None:
                tree.links.new(node.outputs[0], following.inputs[0])
        # The vertices themselves go along: from them the result learns which colour attribute is the active one.
        tree.links.new(nodes[0].outputs[0], nodes[2].inputs[0])
        ball = tree.nodes.new("GeometryNodeMeshIcoSphere")
        ball.location = (0, -200)
        tree.links.new(ball.outputs[0], nodes[1].inputs["Instance"])
    for node in tree.nodes:
        if node.type == "MESH_PRIMITIVE_ICO_SPHERE":
            if (
                abs(node.inputs["Radius"].default_value - tree.get(RADIUS, radius)) < 1e-5 * radius
                or RADIUS not in tree
            ):
                node.inputs["Radius"].default_value = radius
                tree[RADIUS] = radius
        elif node.type == "SET_MATERIAL":
            node.inputs["Material"].default_value = material
    return tree
