"""Blender's properties with the translation context of Fieldwork."""

from functools import partial

import bpy.props

from .text import CONTEXT

BoolProperty = partial(bpy.props.BoolProperty, translation_context=CONTEXT)
EnumProperty = partial(bpy.props.EnumProperty, translation_context=CONTEXT)
FloatProperty = partial(bpy.props.FloatProperty, translation_context=CONTEXT)
FloatVectorProperty = partial(bpy.props.FloatVectorProperty, translation_context=CONTEXT)
IntProperty = partial(bpy.props.IntProperty, translation_context=CONTEXT)
IntVectorProperty = partial(bpy.props.IntVectorProperty, translation_context=CONTEXT)
StringProperty = partial(bpy.props.StringProperty, translation_context=CONTEXT)
# These have no words of their own.
CollectionProperty = bpy.props.CollectionProperty
PointerProperty = bpy.props.PointerProperty
