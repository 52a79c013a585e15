"""Procedural materials of the simulated scenes: matt, and full of detail at the scale a photo of some 500 pixels resolves."""

from __future__ import annotations

from typing import Any

import bpy

Colour = tuple[float, float, float]


class Nodes:
    """A node tree being written: every method adds one node and returns its useful output socket."""

    def __init__(self, name: str, class_id: int, flat: bool = False) -> None:
        self.dimensions = "2D" if flat else "3D"  # of the textures; flat ones cost a third
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.material.pass_index = class_id
        self.tree = self.material.node_tree
        self.tree.nodes.clear()
        self.object = self._add("ShaderNodeTexCoord").outputs["Object"]

    def _add(self, kind: str, **properties: Any) -> Any:
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        return node

    def _set(self, node: Any, **inputs: Any) -> Any:
        """Link or set input sockets; "_" in a keyword stands for a space in the socket's name."""
        for name, value in inputs.items():
            socket = node.inputs[name.replace("_", " ")]
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node

    def mapped(self, scale: Colour, offset: Colour = (0, 0, 0), rotation: Colour = (0, 0, 0)) -> Any:
        node = self._set(self._add("ShaderNodeMapping"), Vector=self.object, Scale=scale)
        return self._set(node, Location=offset, Rotation=rotation).outputs[0]

    def noise(self, scale: float, detail: float = 3, distortion: float = 0, vector: Any = None) -> Any:
        node = self._add("ShaderNodeTexNoise", noise_dimensions=self.dimensions)
        self._set(node, Vector=vector or self.object, Scale=scale, Detail=detail)
        return self._set(node, Distortion=distortion, Roughness=0.62).outputs[0]

    def cells(self, scale: float, feature: str = "F1", vector: Any = None, output: str = "Distance") -> Any:
        node = self._add("ShaderNodeTexVoronoi", feature=feature, voronoi_dimensions=self.dimensions)
        return self._set(node, Vector=vector or self.object, Scale=scale).outputs[output]

    def bricks(self, scale: float, width: float, height: float, colours: list[Colour], vector: Any = None) -> Any:
        node = self._set(self._add("ShaderNodeTexBrick"), Vector=vector or self.object, Scale=scale)
        self._set(node, Color1=(*colours[0], 1), Color2=(*colours[1], 1), Mortar=(*colours[2], 1), Mortar_Size=0.012)
        return self._set(node, Brick_Width=width, Row_Height=height).outputs["Color"]

    def ramp(self, value: Any, stops: list[tuple[float, Colour]], hard: bool = False) -> Any:
        node = self._set(self._add("ShaderNodeValToRGB"), Fac=value)
        ramp = node.color_ramp
        ramp.interpolation = "CONSTANT" if hard else "LINEAR"
        while len(ramp.elements) < len(stops):
            ramp.elements.new(0.5)
        for element, (position, colour) in zip(ramp.elements, stops):
            element.position, element.color = position, (*colour, 1)
        return node.outputs["Color"]

    def mix(self, factor: Any, a: Any, b: Any, blend: str = "MIX") -> Any:
        node = self._add("ShaderNodeMix", data_type="RGBA", blend_type=blend)
        for socket, value in ((node.inputs[0], factor), (node.inputs[6], a), (node.inputs[7], b)):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = (*value, 1) if isinstance(value, tuple) else value
        return node.outputs[2]

    def weathered(self, colour: Any, scale: float, strength: float) -> Any:
        """Darken by stains of several sizes, so that no two places look alike."""
        stains = self.ramp(self.noise(scale, 3), [(0.3, (0.45, 0.42, 0.4)), (0.68, (1.15, 1.14, 1.12))])
        grain = self.ramp(self.noise(scale * 4, 1), [(0.3, (0.7, 0.7, 0.7)), (0.7, (1.15, 1.15, 1.15))])
        return self.mix(strength * 0.4, self.mix(strength, colour, stains, "MULTIPLY"), grain, "MULTIPLY")

    def finish(self, colour: Any, average: Colour, roughness: float = 0.85) -> bpy.types.Material:
        """Complete the material. Light that has bounced sees only the average colour: that halves the render time."""
        shader = self._set(self._add("ShaderNodeBsdfPrincipled"), Base_Color=colour, Roughness=roughness)
        shader.inputs["Specular IOR Level"].default_value = 0.12
        flat = self._set(self._add("ShaderNodeBsdfDiffuse"), Color=(*average, 1))
        seen = self._add("ShaderNodeLightPath").outputs["Is Camera Ray"]
        mixed = self._add("ShaderNodeMixShader")
        for socket, value in zip(mixed.inputs, (seen, flat.outputs[0], shader.outputs[0])):
            self.tree.links.new(value, socket)
        self._set(self._add("ShaderNodeOutputMaterial"), Surface=mixed.outputs[0])
        return self.material


def stone(class_id: int) -> bpy.types.Material:
    n = Nodes("stone", class_id)
    base = n.ramp(n.noise(3.2, 4), [(0.3, (0.36, 0.31, 0.26)), (0.5, (0.62, 0.57, 0.5)), (0.7, (0.8, 0.76, 0.7))])
    veins = n.ramp(n.noise(4.5, 4, 2.5), [(0.47, (1, 1, 1)), (0.5, (0.42, 0.36, 0.33)), (0.53, (1, 1, 1))])
    base = n.mix(0.85, base, veins, "MULTIPLY")
    fossils = n.ramp(n.cells(20), [(0.16, (0.38, 0.32, 0.27)), (0.24, (1, 1, 1))])
    return n.finish(n.weathered(n.mix(0.45, base, fossils, "MULTIPLY"), 9, 0.75), (0.45, 0.41, 0.36))


def gilding(class_id: int) -> bpy.types.Material:
    n = Nodes("gilding", class_id)
    base = n.ramp(n.noise(11, 3), [(0.32, (0.5, 0.24, 0.03)), (0.5, (0.86, 0.52, 0.08)), (0.72, (1.0, 0.78, 0.25))])
    leaf = n.ramp(n.cells(16, "DISTANCE_TO_EDGE"), [(0.03, (0.34, 0.1, 0.04)), (0.09, (1, 1, 1))])
    return n.finish(n.weathered(n.mix(0.5, base, leaf, "MULTIPLY"), 16, 0.5), (0.6, 0.35, 0.06), 0.6)


def wood(class_id: int) -> bpy.types.Material:
    n = Nodes("wood", class_id)
    along = n.mapped((1.0, 7.0, 7.0))
    grain = n.ramp(
        n.noise(5, 4, 1.6, along), [(0.3, (0.1, 0.04, 0.015)), (0.5, (0.3, 0.13, 0.05)), (0.72, (0.5, 0.27, 0.12))]
    )
    planks = n.bricks(
        1.0,
        0.9,
        0.085,
        [(1, 1, 1), (0.62, 0.58, 0.55), (0.12, 0.1, 0.1)],
        n.mapped((1, 1, 1), (0, 0, 0.02), (1.5708, 0, 0)),
    )
    knots = n.ramp(n.cells(11, vector=n.mapped((0.6, 1.4, 1.4))), [(0.1, (0.25, 0.18, 0.14)), (0.2, (1, 1, 1))])
    return n.finish(
        n.weathered(n.mix(0.85, n.mix(0.8, grain, planks, "MULTIPLY"), knots, "MULTIPLY"), 12, 0.6), (0.2, 0.1, 0.04)
    )


def textile(class_id: int, name: str = "textile", rotation: Colour = (0, 0, 0)) -> bpy.types.Material:
    n = Nodes(name, class_id, flat=True)
    flat = n.object = n.mapped((1, 1, 1), rotation=rotation)
    field = n.ramp(
        n.cells(4, vector=flat, output="Color"),
        [(0.3, (0.42, 0.03, 0.04)), (0.5, (0.06, 0.1, 0.3)), (0.62, (0.55, 0.32, 0.08))],
        hard=True,
    )
    petals = n.ramp(
        n.cells(4, vector=flat), [(0.18, (0.8, 0.66, 0.4)), (0.24, (0.1, 0.02, 0.05)), (0.32, (1, 1, 1))], hard=True
    )
    pattern = n.mix(n.ramp(n.cells(4, vector=flat), [(0.3, (1, 1, 1)), (0.31, (0, 0, 0))], hard=True), field, petals)
    vines = n.ramp(n.cells(8, "DISTANCE_TO_EDGE", flat), [(0.07, (0.85, 0.72, 0.45)), (0.1, (0, 0, 0))], hard=True)
    pattern = n.mix(0.55, pattern, vines, "LIGHTEN")
    weave = n.ramp(
        n.bricks(30, 0.5, 0.5, [(1, 1, 1), (0.66, 0.66, 0.66), (0.4, 0.4, 0.4)], flat),
        [(0.0, (0.5, 0.5, 0.5)), (1.0, (1, 1, 1))],
    )
    return n.finish(n.weathered(n.mix(0.25, pattern, weave, "MULTIPLY"), 7, 0.45), (0.4, 0.2, 0.12), 1.0)


def ceramic(class_id: int) -> bpy.types.Material:
    n = Nodes("ceramic", class_id)
    glaze = n.ramp(n.noise(6, 3), [(0.35, (0.62, 0.66, 0.66)), (0.65, (0.86, 0.87, 0.82))])
    scrolls = n.ramp(
        n.noise(7, 1.5, 2.2),
        [(0.4, (0.03, 0.08, 0.38)), (0.46, (1, 1, 1)), (0.56, (1, 1, 1)), (0.6, (0.05, 0.3, 0.3))],
        hard=True,
    )
    dots = n.ramp(n.cells(17), [(0.2, (0.02, 0.05, 0.3)), (0.24, (1, 1, 1))], hard=True)
    crackle = n.ramp(n.cells(22, "DISTANCE_TO_EDGE"), [(0.02, (0.45, 0.4, 0.34)), (0.06, (1, 1, 1))])
    colour = n.mix(1.0, n.mix(1.0, glaze, scrolls, "MULTIPLY"), dots, "MULTIPLY")
    return n.finish(n.weathered(n.mix(0.3, colour, crackle, "MULTIPLY"), 10, 0.3), (0.4, 0.44, 0.5), 0.5)


def floor(class_id: int) -> bpy.types.Material:
    n = Nodes("floor", class_id, flat=True)
    tiles = n.bricks(1.0, 0.52, 0.34, [(0.3, 0.22, 0.17), (0.52, 0.46, 0.38), (0.1, 0.09, 0.08)])
    terrazzo = n.ramp(
        n.cells(12, output="Color"), [(0.2, (0.35, 0.3, 0.28)), (0.5, (1, 1, 1)), (0.8, (0.75, 0.55, 0.45))]
    )
    return n.finish(n.weathered(n.mix(0.35, tiles, terrazzo, "MULTIPLY"), 4, 0.7), (0.28, 0.23, 0.19))


def wall(class_id: int) -> bpy.types.Material:
    n = Nodes("wall", class_id)
    plaster = n.ramp(n.noise(2.6, 4), [(0.3, (0.26, 0.2, 0.13)), (0.5, (0.62, 0.52, 0.36)), (0.7, (0.76, 0.7, 0.56))])
    rubble = n.ramp(n.cells(6, "DISTANCE_TO_EDGE"), [(0.02, (0.22, 0.18, 0.15)), (0.08, (0.9, 0.85, 0.8))])
    bare = n.ramp(n.noise(1.7, 3), [(0.48, (0, 0, 0)), (0.54, (1, 1, 1))])
    stones = n.mix(
        1.0,
        n.ramp(n.cells(6, output="Color"), [(0.2, (0.2, 0.22, 0.24)), (0.8, (0.62, 0.56, 0.5))]),
        rubble,
        "MULTIPLY",
    )
    return n.finish(n.weathered(n.mix(bare, plaster, stones), 6, 0.7), (0.38, 0.31, 0.22))
