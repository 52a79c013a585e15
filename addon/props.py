"""Blender's properties with the translation context of Fieldwork."""

from collections.abc import Collection
from functools import partial
from typing import Any

import bpy

from .text import CONTEXT

BoolProperty = partial(bpy.props.BoolProperty, translation_context=CONTEXT)
EnumProperty = partial(bpy.props.EnumProperty, translation_context=CONTEXT)
FloatProperty = partial(bpy.props.FloatProperty, translation_context=CONTEXT)
FloatVectorProperty = partial(bpy.props.FloatVectorProperty, translation_context=CONTEXT)
IntProperty = partial(bpy.props.IntProperty, translation_context=CONTEXT)
IntVectorProperty = partial(bpy.props.IntVectorProperty, translation_context=CONTEXT)
# These have no words of their own.
CollectionProperty = bpy.props.CollectionProperty
PointerProperty = bpy.props.PointerProperty

PATHS = {"DIR_PATH", "FILE_PATH"}


def StringProperty(
    *, subtype: str = "NONE", options: Collection[str] = ("ANIMATABLE",), blend_relative: bool = True, **more: Any
) -> Any:
    """A text; a path may begin with "//", the folder of the open file, unless `blend_relative` is false."""
    if subtype in PATHS and blend_relative and bpy.app.version >= (4, 5, 0):  # all paths may in older ones
        options = {*options, "PATH_SUPPORTS_BLEND_RELATIVE"}
    return bpy.props.StringProperty(subtype=subtype, options=set(options), translation_context=CONTEXT, **more)


def CheckExisting() -> Any:
    """Of an operator that writes the file it has Blender ask for: the file browser warns of one that is there already."""
    return BoolProperty(name="Check Existing", description="Warn of a file that is there already", default=True,
                        options={"HIDDEN", "SKIP_SAVE"})  # fmt: skip
