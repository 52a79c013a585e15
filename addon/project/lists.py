"""The project in the scene's lists."""

from __future__ import annotations

from typing import Any

import bpy

from ..paths import absolute
from ..roles import FOLDER, ROLE
from . import classes, snapshot


def adopt(scene: bpy.types.Scene) -> None:
    """Let a scene that knows no project have the one that its file was made of, if that is where the file says."""
    for root in scene.objects if not scene.fieldwork.project else ():
        if root.get(ROLE) == "root" and FOLDER in root:
            folder = absolute(root[FOLDER])
            if snapshot.has_project(folder) and snapshot.owner(folder).owns(root):
                scene.fieldwork.project = root[FOLDER]
                return


def refresh(settings: Any) -> None:
    """Bring images and classes of the project into the scene's lists; those of a project that is away stay."""
    if snapshot.absence(settings):
        return
    folder = snapshot.folder_of(settings)
    project = snapshot.project(folder)
    settings.project_uuid = snapshot.owner(folder).uuid if folder else ""
    report = snapshot.cached_json(folder / snapshot.POSES_REPORT) if folder else None
    agreement = {image["name"]: image for image in (report or {}).get("images", [])}
    images = (project or {}).get("images", [])
    classes.resize(settings.images, len(images))
    for entry, image in zip(settings.images, images):
        entry.name = image["name"]
        entry.file = image.get("file", "")
        entry.status, entry.reason = image.get("status", "ok"), image.get("reason", "")
        entry.width, entry.height = image.get("width", 0), image.get("height", 0)
        entry.sharpness = image.get("sharpness") or 0.0
        checked = agreement.get(entry.name, {})
        entry.points = checked.get("points") or 0
        entry.error_px = checked.get("error_px") or 0.0
        entry.labelled, entry.masked = bool(image.get("label")), bool(image.get("mask"))
    settings.image_index = min(settings.image_index, max(0, len(settings.images) - 1))
    classes.fill(settings)


def undone(settings: Any) -> None:
    """After an undo or redo the lists may be those of before a job: bring them up to date.

    An edit of the classes that was undone is undone in the project too.
    """
    if snapshot.has_project(snapshot.folder_of(settings)) and not snapshot.absence(settings):
        classes.undone(settings)
        refresh(settings)


def other_project(settings: Any) -> None:
    """Another folder was chosen: what was known of the one before is no more."""
    before, settings.project_uuid = settings.project_uuid, ""
    folder = snapshot.folder_of(settings)
    if folder is None or snapshot.owner(folder).uuid != before:
        with classes.quiet():
            for entry in settings.classes:  # what was hidden are classes of the other project
                entry.visible = True
    refresh(settings)
