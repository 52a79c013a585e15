"""Errors of the Blender side that are written for the user."""


class SceneError(Exception):
    """A scene or a package cannot be used as asked; the message is a sentence that says why."""

    for_user = True


class SceneChanged(SceneError):
    """What was being worked on in the scene is gone."""


class EngineError(Exception):
    """What the engine answered instead of a result.

    `kind`: "cancelled", "died", "missing", or the engine's own code ("poses", "input", "internal", …);
    `message` and `hint` are sentences for the user; `detail` is text for a report.
    """

    def __init__(self, kind: str, message: str, hint: str = "", detail: str = "") -> None:
        super().__init__(f"{message} {hint}".strip())
        self.kind, self.message, self.hint, self.detail = kind, message, hint, detail
