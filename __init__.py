"""Fieldwork: photos to a semantic radiance field, and the field into labelled meshes and renders, in Blender.

This folder is at once the Blender extension (`bl_ext.<repository>.fieldwork`) and the Python package `fieldwork` of
the command line and the engine, so importing it must not need `bpy`.
"""


def register() -> None:
    from .addon import registration

    registration.register(__package__)


def unregister() -> None:
    from .addon import registration

    registration.unregister()
