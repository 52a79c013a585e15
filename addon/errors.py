"""Errors of the Blender side that are written for the user."""


class SceneError(Exception):
    """A scene or a package cannot be used as asked; the message is a sentence that says why."""

    for_user = True
