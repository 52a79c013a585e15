"""Fields are looked for among the objects of a file only where something changed that says where there are any."""

from __future__ import annotations

from pathlib import Path

from fieldwork.tests.addon.support import SETUP, make_project
from fieldwork.tests.addon.test_instanced_fields import NESTED

# As in a window: without one nothing is kept.
KEPT = """
from types import SimpleNamespace
from fieldwork.addon.live import index
class Window:
    app = SimpleNamespace(background=False, handlers=bpy.app.handlers)
    def __getattr__(self, name):
        return getattr(bpy, name)
index.bpy = Window()
index.register()
looks = []
looking = index.look
index.look = lambda: (looks.append(1), looking())[1]
layer, space = bpy.context.view_layer, None
def seen():
    layer.update()
    before = len(looks)
    found = index.current()
    shown = fields.parts(found, lambda obj: obj.visible_get(view_layer=layer), lambda item: item.hide_viewport)
    return [len(looks) - before, sorted(part.name for part in shown)]
"""


def test_objects_are_looked_through_only_where_that_may_tell_something_new(bpy_script, tmp_path: Path) -> None:
    facts = bpy_script(
        SETUP
        + NESTED
        + KEPT
        + """
thing = bpy.data.objects.new("thing", bpy.data.meshes.new("thing"))
scene.collection.objects.link(thing)
facts = {"first": seen(), "again": seen()}
thing.location.x = 1
field.location.x = 1
beside.location.x = 1
facts["moved"] = seen()
field.hide_viewport = True
facts["hidden"] = seen()
field.hide_viewport = False
other = empty("Other", scene.collection)
facts["added"] = seen()
other.fieldwork.is_field = True
facts["made a field"] = seen()
beside.instance_type = "NONE"
facts["no instance"] = seen()
bpy.data.objects.remove(other)
facts["removed"] = seen()
scene.collection.objects.unlink(high)
facts["unlinked"] = seen()
facts["crop"] = fields.crop_box(field.fieldwork) == box
drawer.objects.unlink(box)
layer.update()
facts["deleted crop"] = fields.crop_box(field.fieldwork) is None
answer(facts)
""",
        project=make_project(tmp_path / "capture"),
    )
    beside, high = ["Beside\nCopy", "Beside\nField"], ["High\nLow\nCopy", "High\nLow\nField"]
    assert facts["first"] == [1, beside + high]
    assert facts["again"] == facts["moved"] == [0, beside + high]
    assert facts["hidden"][1] == [beside[0], high[0]]
    assert facts["added"][1] == beside + high
    assert facts["made a field"] == [1, [*beside, *high, "Other"]]
    assert facts["no instance"] == [1, [*high, "Other"]]
    assert facts["removed"] == [1, high]
    assert facts["unlinked"] == [1, []]
    assert facts["crop"]
    assert facts["deleted crop"]
