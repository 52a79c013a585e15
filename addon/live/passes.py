"""The passes of Fieldwork's render engine, as Blender and the engine call them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import bpy

if TYPE_CHECKING:
    import numpy as np

    from .frames import Sizes


class RenderPass(NamedTuple):
    """`name` is also the engine's; `letters` name the channels, `kind` the socket of the compositor."""

    name: str
    letters: str
    kind: str

    @property
    def channels(self) -> int:
        return len(self.letters)


COMBINED = RenderPass("Combined", "RGBA", "COLOR")
# Names of the passes that are light, in the scene's working space.
LIGHT = ("Combined", "Class Color", "FieldFront", "FieldBehind")
FAR = 1e10  # depth where nothing is
CRYPTOMATTES = (("object", "CryptoObject"), ("material", "CryptoMaterial"), ("asset", "CryptoAsset"))


def wanted(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> list[RenderPass]:
    """The passes that a view layer asks for."""
    own = layer.fieldwork
    found = [COMBINED]
    for asked, made in (
        (layer.use_pass_z, RenderPass("Depth", "Z", "VALUE")),
        (layer.use_pass_position, RenderPass("Position", "XYZ", "VECTOR")),
        (layer.use_pass_normal, RenderPass("Normal", "XYZ", "VECTOR")),
        (own.use_class_index, RenderPass("Class Index", "X", "VALUE")),
        (own.use_class_color, RenderPass("Class Color", "RGBA", "COLOR")),
        (own.use_confidence, RenderPass("Confidence", "X", "VALUE")),
        (scene.fieldwork_live.objects_hide, RenderPass("FieldFront", "RGBA", "COLOR")),
        (scene.fieldwork_live.objects_hide, RenderPass("FieldBehind", "RGBA", "COLOR")),
    ):
        if asked:
            found.append(made)
    for switch, name in CRYPTOMATTES:
        if getattr(layer, f"use_pass_cryptomatte_{switch}"):
            count = (layer.pass_cryptomatte_depth + 1) // 2
            found += [RenderPass(f"{name}{number:02}", "RGBA", "COLOR") for number in range(count)]
    return found


def empty(sizes: Sizes, world: tuple[float, float, float] | None) -> dict[str, np.ndarray]:
    """The passes of a frame in which no field is seen, of Rec.709 primaries. `world`: light behind it; None: it is transparent."""
    import numpy as np

    found = {name: np.zeros((sizes.height, sizes.width, count), np.float32) for name, count in sizes.channels.items()}
    if world is not None:
        found["Combined"][:] = (*world, 1.0)
    if "Depth" in found:
        found["Depth"][:] = FAR
    return found


def working_space(linear: Any, space: str) -> Any:
    """Light (…, 4) of Rec.709 primaries in another working space of the file; one of Blender before 5 has no other."""
    import numpy as np

    matrix = _FROM_REC709.get(space)
    if matrix is None:
        return linear
    return np.concatenate([linear[..., :3] @ np.array(matrix, np.float32).T, linear[..., 3:]], -1)


def rec709(color: tuple[float, float, float], space: str) -> tuple[float, float, float]:
    """A color of a working space of the file, as Blender has the world's, as light of Rec.709 primaries."""
    import numpy as np

    matrix = _FROM_REC709.get(space)
    if matrix is None:
        return color
    red, green, blue = np.linalg.solve(np.array(matrix), color).tolist()
    return red, green, blue


# Linear Rec.709 (D65) into others; ITU-R BT.2087, and for ACEScg with the Bradford adaptation to its white (ACES TB-2014-004).
_FROM_REC709 = {
    "Linear Rec.2020": [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]],
    "ACEScg": [[0.61309740, 0.33952315, 0.04737945], [0.07019372, 0.91635388, 0.01345240], [0.02061559, 0.10956977, 0.86981463]],
}  # fmt: skip


def world_color(world: bpy.types.World | None) -> tuple[float, float, float]:
    """The colour of a world that has one, linear: that of its background node where nothing is linked to it."""
    if world is None:
        return 0.0, 0.0, 0.0
    if world.node_tree is not None and world.use_nodes:
        output = world.node_tree.get_output_node("ALL")
        links = output.inputs["Surface"].links if output is not None else ()
        node = links[0].from_node if links else None
        if node is None or node.type != "BACKGROUND" or node.mute:
            return 0.0, 0.0, 0.0
        color, strength = node.inputs["Color"], node.inputs["Strength"]
        if color.is_linked or strength.is_linked:
            return 0.0, 0.0, 0.0
        red, green, blue = (channel * strength.default_value for channel in color.default_value[:3])
        return red, green, blue
    red, green, blue = world.color
    return red, green, blue
