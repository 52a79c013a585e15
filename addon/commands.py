"""`blender -c fieldwork VERB …`: the command line inside Blender."""

from __future__ import annotations

import bpy

_handle: object | None = None


def register() -> None:
    global _handle
    from .cli import main

    _handle = bpy.utils.register_cli_command("fieldwork", main)


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.utils.unregister_cli_command(_handle)
        _handle = None
