"""Words of the interface, and their translations.

All of Fieldwork's words have one context of their own, so that "Train" or "Priority" is never taken for Blender's word
of another meaning. Operators, panels and menus get it when they are registered, properties from props.py, and all other
text by `t`. A translation is an entry in `TRANSLATIONS`: {locale: {(CONTEXT, English text): text}}.
"""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface

CONTEXT = "Fieldwork"
TRANSLATIONS: dict[str, dict[tuple[str, str], str]] = {}
_NAME = __package__


def t(message: str, *values: object, **named: object) -> str:
    """The text in the user's language, with the values at the places of its braces."""
    text = pgettext_iface(message, CONTEXT)
    return text.format(*values, **named) if values or named else text


def register() -> None:
    bpy.app.translations.register(_NAME, TRANSLATIONS)


def unregister() -> None:
    bpy.app.translations.unregister(_NAME)
