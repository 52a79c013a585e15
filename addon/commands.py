"""`blender -c fieldwork VERB …`: the command line inside Blender."""

from __future__ import annotations

import bpy

_handle: object | None = None


def run(arguments: list[str]) -> int:
    """Run a verb; returns its exit status."""
    from .cli import main  # not at the top: enabling the extension must be quick

    return main(arguments)


def register() -> None:
    global _handle
    _handle = bpy.utils.register_cli_command("fieldwork", run)


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.utils.unregister_cli_command(_handle)
        _handle = None
