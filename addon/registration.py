"""Registers what Fieldwork adds to Blender, and takes all of it away again.

A module listed in `MODULES` may have a list `CLASSES` of Blender types and functions `register()` and `unregister()`
for anything else (pointer properties, handlers, timers, menus). Order matters: property groups before what points
at them, panels before their sub-panels. Nothing here may be slow: no file is read and no process started.
"""

from __future__ import annotations

import importlib
from types import ModuleType

import bpy

from .text import CONTEXT

WITH_CONTEXT = (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu)

# Relative to the root package.
MODULES = (
    "addon.text",
    "addon.properties",
    "addon.live.settings",
    "addon.live.engine",
    "addon.live.index",
    "addon.live.hint",
    "addon.live.views",
    "addon.live.in_step",
    "addon.preferences",
    "addon.pictures.thumbnails",
    "addon.jobs.timer",
    "addon.project.file_paths",
    "addon.scene.measured_line",
    "addon.labels.session",
    "addon.labels.draw",
    "addon.labels.surface",
    "addon.commands",
    "operators.engine",
    "operators.job",
    "operators.project",
    "operators.capture",
    "operators.dataset",
    "operators.poses",
    "operators.picking",
    "operators.region",
    "operators.label",
    "operators.label_classes",
    "operators.label_files",
    "operators.label_models",
    "operators.label_tool",
    "operators.label_surface",
    "operators.train",
    "operators.render",
    "operators.live",
    "operators.mesh",
    "operators.measure",
    "operators.things",
    "operators.scene",
    "operators.export",
    "operators.reconstruct",
    "operators.many",
    "panels.main",
    "panels.capture",
    "panels.dataset",
    "panels.poses",
    "panels.classes",
    "panels.train",
    "panels.label",
    "panels.render",
    "panels.live",
    "panels.mesh",
    "panels.measure",
    "panels.things",
    "panels.export",
    "panels.campaign",
    "panels.engine",
    "panels.menus",
)

# The package Blender knows the extension by, "bl_ext.<repository>.fieldwork": `AddonPreferences.bl_idname` and
# `bpy.utils.extension_path_user` need exactly this one. "fieldwork" where it is imported outside an extension.
ROOT_PACKAGE = __package__.rpartition(".")[0]

_registered: list[ModuleType] = []


def register(root_package: str) -> None:
    """Import and register all modules; on an error, what was registered so far is taken back."""
    try:
        for name in MODULES:
            module = importlib.import_module(f"{root_package}.{name}")
            _registered.append(module)
            for cls in getattr(module, "CLASSES", ()):
                if issubclass(cls, WITH_CONTEXT):
                    cls.bl_translation_context = CONTEXT
                bpy.utils.register_class(cls)
            if hasattr(module, "register"):
                module.register()
    except Exception:
        unregister()
        raise


def unregister() -> None:
    """Undo `register`, in reverse order."""
    while _registered:
        module = _registered.pop()
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(getattr(module, "CLASSES", ())):
            if cls.is_registered:
                bpy.utils.unregister_class(cls)
