"""Procedural materials of the simulated scenes: matt, and full of detail at the scale a photo of some 500 pixels resolves."""

from __future__ import annotations

from typing import Any

import bpy

Colour = tuple[float, float, float]


class Nodes:
    """A node tree being written: every method adds one node and returns its useful output socket."""

    def __init__(self, owner: bpy.types.Material | bpy.types.World, flat: bool = False) -> None:
        self.dimensions = "2D" if flat else "3D"  # of the textures; flat ones cost a third
        owner.use_nodes = True
        self.tree = owner.node_tree
        self.tree.nodes.clear()
        place = self._add("ShaderNodeTexCoord").outputs
        # Where textures are looked up: in a material the place on the object, in a world the direction.
        self.object = place["Object" if isinstance(owner, bpy.types.Material) else "Generated"]

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

    def attribute(self, name: str) -> Any:
        """A number painted on the faces of the mesh; 0 where the mesh has none."""
        return self._add("ShaderNodeAttribute", attribute_name=name).outputs["Fac"]

    def axis(self, name: str) -> Any:
        """One coordinate ("X", "Y" or "Z") of the place."""
        return self._set(self._add("ShaderNodeSeparateXYZ"), Vector=self.object).outputs[name]

    def weathered(self, colour: Any, scale: float, strength: float) -> Any:
        """Darken by stains of several sizes, so that no two places look alike."""
        stains = self.ramp(self.noise(scale, 3), [(0.3, (0.45, 0.42, 0.4)), (0.68, (1.15, 1.14, 1.12))])
        grain = self.ramp(self.noise(scale * 4, 1), [(0.3, (0.7, 0.7, 0.7)), (0.7, (1.15, 1.15, 1.15))])
        return self.mix(strength * 0.4, self.mix(strength, colour, stains, "MULTIPLY"), grain, "MULTIPLY")

    def for_camera(self, output: str, shader: Any, otherwise: Any) -> None:
        """Complete the tree: the camera sees `shader`, light that has bounced sees `otherwise`."""
        seen = self._add("ShaderNodeLightPath").outputs["Is Camera Ray"]
        mixed = self._add("ShaderNodeMixShader")
        for socket, value in zip(mixed.inputs, (seen, otherwise, shader)):
            self.tree.links.new(value, socket)
        self._set(self._add(output), Surface=mixed.outputs[0])


class Surface(Nodes):
    """The nodes of a material of a class."""

    def __init__(self, name: str, class_id: int, flat: bool = False) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.pass_index = class_id
        super().__init__(self.material, flat)

    def finish(self, colour: Any, average: Colour, roughness: float = 0.85) -> bpy.types.Material:
        """Complete the material. Light that has bounced sees only the average colour: that halves the render time."""
        shader = self._set(self._add("ShaderNodeBsdfPrincipled"), Base_Color=colour, Roughness=roughness)
        shader.inputs["Specular IOR Level"].default_value = 0.12
        flat = self._set(self._add("ShaderNodeBsdfDiffuse"), Color=(*average, 1))
        self.for_camera("ShaderNodeOutputMaterial", shader.outputs[0], flat.outputs[0])
        return self.material


def stone(class_id: int) -> bpy.types.Material:
    n = Surface("stone", class_id)
    base = n.ramp(n.noise(3.2, 4), [(0.3, (0.36, 0.31, 0.26)), (0.5, (0.62, 0.57, 0.5)), (0.7, (0.8, 0.76, 0.7))])
    veins = n.ramp(n.noise(4.5, 4, 2.5), [(0.47, (1, 1, 1)), (0.5, (0.42, 0.36, 0.33)), (0.53, (1, 1, 1))])
    base = n.mix(0.85, base, veins, "MULTIPLY")
    fossils = n.ramp(n.cells(20), [(0.16, (0.38, 0.32, 0.27)), (0.24, (1, 1, 1))])
    return n.finish(n.weathered(n.mix(0.45, base, fossils, "MULTIPLY"), 9, 0.75), (0.45, 0.41, 0.36))


def gilding(class_id: int) -> bpy.types.Material:
    n = Surface("gilding", class_id)
    base = n.ramp(n.noise(11, 3), [(0.32, (0.5, 0.24, 0.03)), (0.5, (0.86, 0.52, 0.08)), (0.72, (1.0, 0.78, 0.25))])
    leaf = n.ramp(n.cells(16, "DISTANCE_TO_EDGE"), [(0.03, (0.34, 0.1, 0.04)), (0.09, (1, 1, 1))])
    return n.finish(n.weathered(n.mix(0.5, base, leaf, "MULTIPLY"), 16, 0.5), (0.6, 0.35, 0.06), 0.6)


def wood(class_id: int) -> bpy.types.Material:
    n = Surface("wood", class_id)
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
    n = Surface(name, class_id, flat=True)
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
    n = Surface("ceramic", class_id)
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
    n = Surface("floor", class_id, flat=True)
    tiles = n.bricks(1.0, 0.52, 0.34, [(0.3, 0.22, 0.17), (0.52, 0.46, 0.38), (0.1, 0.09, 0.08)])
    terrazzo = n.ramp(
        n.cells(12, output="Color"), [(0.2, (0.35, 0.3, 0.28)), (0.5, (1, 1, 1)), (0.8, (0.75, 0.55, 0.45))]
    )
    return n.finish(n.weathered(n.mix(0.35, tiles, terrazzo, "MULTIPLY"), 4, 0.7), (0.28, 0.23, 0.19))


def wall(class_id: int) -> bpy.types.Material:
    n = Surface("wall", class_id)
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


def sandstone(class_id: int) -> bpy.types.Material:
    """Dressed blocks; the attribute "tint" colours each block, from 0.95 on it is mortar."""
    n = Surface("sandstone", class_id)
    base = n.ramp(n.noise(3, 3), [(0.3, (0.43, 0.33, 0.21)), (0.5, (0.62, 0.5, 0.34)), (0.7, (0.74, 0.63, 0.46))])
    blocks = [
        (0.0, (1, 1, 1)),
        (0.1, (0.62, 0.6, 0.62)),
        (0.4, (1, 0.9, 0.76)),
        (0.65, (1.1, 1.07, 1)),
        (0.9, (0.85, 0.7, 0.55)),
    ]
    base = n.mix(1.0, base, n.ramp(n.attribute("tint"), [*blocks, (0.96, (0.42, 0.4, 0.38))]), "MULTIPLY")
    beds = n.ramp(
        n.noise(7, 2, 1.2, n.mapped((0.35, 0.35, 1.6))), [(0.38, (0.62, 0.55, 0.47)), (0.55, (1.08, 1.06, 1.03))]
    )
    pits = n.ramp(n.cells(13), [(0.14, (0.45, 0.38, 0.3)), (0.26, (1, 1, 1))])
    base = n.mix(0.7, n.mix(0.6, base, beds, "MULTIPLY"), pits, "MULTIPLY")
    return n.finish(n.weathered(base, 5.5, 0.75), (0.5, 0.4, 0.28))


def moss(class_id: int) -> bpy.types.Material:
    n = Surface("moss", class_id)
    base = n.ramp(n.noise(8, 2), [(0.3, (0.05, 0.09, 0.015)), (0.5, (0.15, 0.22, 0.035)), (0.7, (0.34, 0.38, 0.1))])
    cushions = n.ramp(n.cells(16), [(0.2, (1.2, 1.2, 1.1)), (0.6, (0.5, 0.52, 0.45))])
    return n.finish(n.mix(0.8, base, cushions, "MULTIPLY"), (0.15, 0.2, 0.04), 1.0)


def black_crust(class_id: int) -> bpy.types.Material:
    n = Surface("black crust", class_id)
    base = n.ramp(
        n.noise(7, 3), [(0.32, (0.012, 0.012, 0.013)), (0.55, (0.045, 0.042, 0.04)), (0.75, (0.14, 0.125, 0.11))]
    )
    bare = n.ramp(n.cells(14), [(0.1, (3.0, 2.6, 2.1)), (0.2, (1, 1, 1))])
    return n.finish(n.mix(0.6, base, bare, "MULTIPLY"), (0.04, 0.04, 0.04))


def crack(class_id: int) -> bpy.types.Material:
    n = Surface("crack", class_id)
    base = n.ramp(n.noise(9, 2), [(0.35, (0.015, 0.011, 0.008)), (0.7, (0.1, 0.075, 0.05))])
    return n.finish(base, (0.04, 0.03, 0.02), 1.0)


def brick(class_id: int) -> bpy.types.Material:
    """Courses of 7 cm across an upright face, seen where the stone in front is lost."""
    n = Surface("brick", class_id)
    upright = n.mapped((1, 1, 1), rotation=(-1.5708, 0, 0))
    courses = n.bricks(1.0, 0.21, 0.07, [(0.52, 0.14, 0.06), (0.34, 0.1, 0.05), (0.5, 0.45, 0.38)], upright)
    patches = n.ramp(n.noise(6, 2), [(0.35, (0.6, 0.55, 0.5)), (0.65, (1.2, 1.15, 1.1))])
    return n.finish(n.weathered(n.mix(0.9, courses, patches, "MULTIPLY"), 6, 0.5), (0.36, 0.14, 0.08))


def oak(class_id: int) -> bpy.types.Material:
    """Upright boards, grey where the weather has been at them; "tint" colours each board."""
    n = Surface("oak", class_id)
    along = n.mapped((5, 5, 0.7))
    grain = n.ramp(
        n.noise(3.5, 3, 1.2, along), [(0.3, (0.09, 0.05, 0.025)), (0.5, (0.24, 0.14, 0.075)), (0.7, (0.42, 0.29, 0.18))]
    )
    boards = n.ramp(n.attribute("tint"), [(0.0, (0.55, 0.5, 0.46)), (0.9, (1.25, 1.15, 1.05)), (0.96, (0.2, 0.2, 0.2))])
    grey = n.ramp(n.noise(2.2, 2), [(0.42, (0, 0, 0)), (0.65, (0.7, 0.7, 0.7))])
    colour = n.mix(grey, n.mix(1.0, grain, boards, "MULTIPLY"), (0.3, 0.29, 0.27))
    return n.finish(n.weathered(colour, 7, 0.5), (0.2, 0.13, 0.08))


def iron(class_id: int) -> bpy.types.Material:
    n = Surface("iron", class_id)
    rust = n.ramp(
        n.noise(10, 2), [(0.42, (0.05, 0.055, 0.065)), (0.52, (0.14, 0.07, 0.035)), (0.7, (0.34, 0.15, 0.05))]
    )
    return n.finish(rust, (0.1, 0.07, 0.05), 0.6)


def paving(class_id: int) -> bpy.types.Material:
    """Cobbles in earth."""
    n = Surface("paving", class_id, flat=True)
    cobbles = n.ramp(
        n.cells(6.5, output="Color"), [(0.2, (0.17, 0.16, 0.16)), (0.5, (0.36, 0.34, 0.33)), (0.8, (0.42, 0.36, 0.3))]
    )
    earth = n.ramp(n.cells(6.5, "DISTANCE_TO_EDGE"), [(0.04, (0.3, 0.27, 0.22)), (0.14, (1, 1, 1))])
    return n.finish(n.weathered(n.mix(1.0, cobbles, earth, "MULTIPLY"), 3, 0.6), (0.25, 0.23, 0.21))


def meadow(class_id: int) -> bpy.types.Material:
    """Dry grass seen from afar: nothing small, so that it does not flicker from photo to photo."""
    n = Surface("meadow", class_id, flat=True)
    near = n.ramp(n.noise(0.6, 1), [(0.32, (0.13, 0.12, 0.05)), (0.5, (0.26, 0.24, 0.11)), (0.68, (0.42, 0.36, 0.19))])
    far = n.ramp(n.noise(0.13, 2), [(0.35, (0.6, 0.66, 0.6)), (0.65, (1.15, 1.1, 1.0))])
    return n.finish(n.mix(0.9, near, far, "MULTIPLY"), (0.26, 0.24, 0.12))


def sky(world: bpy.types.World, strength: float) -> None:
    """Fair weather clouds for the camera; for the light one colour, which is free of noise."""
    n = Nodes(world)
    height = n.ramp(n.axis("Z"), [(0.0, (0.72, 0.78, 0.84)), (0.12, (0.5, 0.66, 0.86)), (0.6, (0.16, 0.34, 0.68))])
    clouds = n.ramp(n.noise(2.6, 4, 0.4, n.mapped((1, 1, 2.6))), [(0.46, (0, 0, 0)), (0.66, (0.95, 0.95, 0.95))])
    white = n.ramp(n.noise(4.2, 2), [(0.35, (0.66, 0.68, 0.72)), (0.6, (0.95, 0.95, 0.95))])
    seen = n._set(n._add("ShaderNodeBackground"), Color=n.mix(clouds, height, white), Strength=1.0)
    light = n._set(n._add("ShaderNodeBackground"), Color=(0.62, 0.72, 0.9, 1), Strength=strength)
    n.for_camera("ShaderNodeOutputWorld", seen.outputs[0], light.outputs[0])
