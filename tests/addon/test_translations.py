"""Every word of the interface can be translated, under one context."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from fieldwork import nerfcore

ROOT = Path(nerfcore.__file__).parents[1]
FILES = [
    *sorted((ROOT / "panels").glob("*.py")),
    *sorted((ROOT / "operators").glob("*.py")),
    ROOT / "addon/preferences.py",
]
# Spellings that Blender's interface, which is American, has otherwise.
BRITISH = re.compile(
    r"colour|metre|labell|modell|travell|cancelling|\bgrey|\bcentre|neighbour|behaviour|favour|licence|catalogue|analyse"
    r"|(normal|optim|organ|recogn|visual|initial)is(e|ing|ation)",
    re.IGNORECASE,
)


def literal(node: ast.expr) -> str:
    """Words of a string that is written down in the code; empty when there are none."""
    if isinstance(node, ast.IfExp):
        return literal(node.body) + literal(node.orelse)
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    texts = [part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)]
    return "".join(character for text in texts for character in text if character.isalpha())


def shown(node: ast.Call) -> list[ast.expr]:
    """What of a call a user reads."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    texts = [keyword.value for keyword in node.keywords if keyword.arg == "text"]
    if name in ("report", "draw_state", "draw_wrapped"):
        texts += node.args[1:2]
    if name in ("poll_message_set", "ValueError"):
        texts += node.args[:1]
    return texts


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_every_text_goes_through_t(path):
    calls = [node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call)]
    bare = [f"line {text.lineno}: {ast.unparse(text)}" for call in calls for text in shown(call) if literal(text)]
    assert bare == []


def test_all_that_is_registered_has_the_context(bpy_script):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon import registration
from fieldwork.addon.text import CONTEXT
lacking, count = [], 0
for module in registration._registered:
    for cls in getattr(module, "CLASSES", ()):
        rna = cls.bl_rna
        if issubclass(cls, registration.WITH_CONTEXT):
            count += 1
            if rna.translation_context != CONTEXT:
                lacking.append(cls.__name__)
        inherited = {p.identifier for base in cls.__bases__ if hasattr(base, "bl_rna") for p in base.bl_rna.properties}
        for prop in rna.properties:
            if prop.identifier in inherited or prop.type in ("POINTER", "COLLECTION"):
                continue
            count += 1
            if prop.translation_context != CONTEXT and prop.identifier not in ("rna_type", "remove_name", "remove_active"):
                lacking.append(f"{cls.__name__}.{prop.identifier}: {prop.translation_context}")
answer({"lacking": lacking, "count": count})
"""
    )
    assert facts["lacking"] == []
    assert facts["count"] > 90


def test_words_are_spelled_as_blender_spells_them(bpy_script):
    words = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon import registration
from fieldwork.addon.scene.look import SWITCH, set_switch
words = []
for module in registration._registered:
    for cls in getattr(module, "CLASSES", ()):
        words += [cls.bl_rna.name, cls.bl_rna.description]
        if issubclass(cls, bpy.types.Operator):
            words.append(cls.__doc__ or "")  # its tooltip
        for prop in cls.bl_rna.properties:
            words += [prop.name] if prop.name != prop.identifier else []
            words.append(prop.description)
            words += [text for item in getattr(prop, "enum_items", ()) for text in (item.name, item.description)]
root = bpy.data.objects.new("root", None)
set_switch(root)
words.append(root.id_properties_ui(SWITCH).as_dict()["description"])
answer(words)
"""
    )
    for path in sorted(path for folder in ("addon", "operators", "panels") for path in (ROOT / folder).rglob("*.py")):
        calls = [node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call)]
        texts = [argument for call in calls if getattr(call.func, "id", "") == "t" for argument in call.args]
        parts = [part.value for text in texts for part in ast.walk(text) if isinstance(part, ast.Constant)]
        words += [part for part in parts if isinstance(part, str)]
    assert len(words) > 1000
    assert [text for text in words if BRITISH.search(text)] == []


def test_a_translation_is_shown_and_taken_back(bpy_script):
    facts = bpy_script(
        """
import fieldwork
from fieldwork.addon import text
text.TRANSLATIONS["de_DE"] = {
    (text.CONTEXT, "Estimate Poses"): "Posen schätzen",
    (text.CONTEXT, "{} of {} photos placed"): "{} von {} Fotos verortet",
}
fieldwork.register()
view = bpy.context.preferences.view
can = bpy.app.build_options.international
if can:
    view.language = "de_DE"
    view.use_translate_interface = True
label = bpy.types.FIELDWORK_OT_poses.bl_label
look = lambda: [bpy.app.translations.pgettext_iface(label, text.CONTEXT), text.t("{} of {} photos placed", 3, 4)]
during = look()
fieldwork.unregister()
answer({"can": can, "during": during, "after": look()})
"""
    )
    assert facts["after"] == ["Estimate Poses", "3 of 4 photos placed"]
    if not facts["can"]:
        pytest.skip("this bpy is built without translations; tests/gui looks at them in a window")
    assert facts["during"] == ["Posen schätzen", "3 von 4 Fotos verortet"]
