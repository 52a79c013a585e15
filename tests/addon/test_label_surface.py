"""Marks on the surface from the viewport: what a ray meets, in which frame a mark is sent, what the panel says of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fieldwork.nerfcore.labels.journal import append_mark, read_marks
from fieldwork.nerfcore.labels.lookup import Labelling
from fieldwork.nerfcore.labels.revisions import save
from fieldwork.nerfcore.labels.stroke import stroke
from fieldwork.nerfcore.params import LabelStrokeParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Frame, Project, SemanticClass
from fieldwork.nerfcore.project.store import save_project
from fieldwork.tests.addon.support import SETUP
from fieldwork.tests.addon.test_labels import LINE, project_with_labels

pytest.importorskip("bpy")

from fieldwork.addon.labels import results
from fieldwork.panels import label_states

TURNED = [[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def test_a_stroke_in_the_viewport_reaches_the_journal_in_the_frame_of_the_poses(bpy_script, tmp_path):
    folder = tmp_path / "capture"
    classes = [SemanticClass(id=1, name="stone", color=(0.5, 0.5, 0.5))]
    save_project(folder, Project(classes=classes, frame=Frame(world_from_sfm=TURNED)))
    facts = bpy_script(
        SETUP
        + """
from mathutils import Matrix, Vector
from fieldwork.addon.labels import session, surface
from fieldwork.addon.labels.trail import Trail
from fieldwork.addon.project import snapshot
from fieldwork.operators import label_surface
settings.project = folder
owner = snapshot.owner(Path(folder))
for item in list(bpy.data.objects):
    bpy.data.objects.remove(item)
def sheet(name, height):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(-9, -9, height), (9, -9, height), (9, 9, height), (-9, 9, height)], [], [(0, 1, 2, 3)])
    item = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(item)
    return item
root = bpy.data.objects.new("root", None)
scene.collection.objects.link(root)
owner.mark(root, "root")
root.matrix_world = Matrix.Translation((0, 0, 5)) @ Matrix.Scale(3, 4)
own, front = sheet("own", 0.0), sheet("lamp", 4.0)
owner.mark(own, "mesh")
bpy.context.view_layer.update()
graph = bpy.context.evaluated_depsgraph_get()
down = Vector((0, 0, -1))
place = surface.under(scene, graph, owner, Vector((3, 6, 9)), down)
beside = surface.under(scene, graph, owner, Vector((30, 6, 9)), down)
settings.class_index = 0
sent = []
session.mark = lambda folder, params, more: sent.append((params, more))
params = {"shape": "line", "width": 12.0, "author": "Ada", "class_id": 1}
shown = [surface.is_shown(items, owner) for items in (scene.objects, [front, root])]
# A stroke that begins beside the sheet, goes over it and ends beside it, seen from above.
trail = Trail(12.0)
for x in (-15, 15):
    trail.go(x, 6, lambda x, y: surface.under(scene, graph, owner, Vector((x, y, 9)), down))
ends = [list(trail.pieces[0][0]), list(trail.pieces[-1][-1])]
label_surface.deliver(scene, params, [[place, place + Vector((3, 0, 0))], [place]], [0.6, 0.3])
class Asked:
    label_tool, label_width, label_author, class_index = "click", 12.0, "", 0
    label_encoder = label_decoder = "model.onnx"
    classes = settings.classes
settings.classes.add().id = 1
tool = label_surface.surface_parameters(Asked, False)
answer({"place": list(place), "beside": beside is None, "sent": sent, "tool": tool, "shown": shown,
        "pieces": len(trail.pieces), "ends": ends})
""",
        folder=folder,
    )
    assert facts["place"] == pytest.approx([3, 6, 0], abs=1e-4)
    assert facts["beside"]
    assert facts["tool"]["shape"] == "part", "models cut out of photos, not of the surface"
    assert "box" not in facts["tool"]
    assert facts["shown"] == [True, False]
    assert facts["pieces"] == 1, "a stroke may begin and end beside the surface"
    for end, x in zip(facts["ends"], (-9, 9)):
        assert abs(end[0]) <= 9
        assert abs(end[0] - x) <= 8, "it is as long as what it meets, but for a step of the mouse"
    assert [more for _, more in facts["sent"]] == [True, False], "its pieces are one step of undo"
    (sent, _), (last, _) = facts["sent"]
    assert last["width"] == pytest.approx(0.1)
    # The capture lies five units up in the scene, three times as large.
    np.testing.assert_allclose(sent["places"], [[1, 2, -5 / 3], [2, 2, -5 / 3]], atol=1e-4)
    assert sent["width"] == pytest.approx(0.2)
    stroke(LabelStrokeParams.model_validate({"project": folder, **sent}), Reporter())
    (mark,) = read_marks(folder)
    # And in the frame of the poses at half the size, turned by a quarter.
    np.testing.assert_allclose(mark.places, [[1, 0, -5 / 6], [1, -0.5, -5 / 6]], atol=1e-4)
    assert mark.width == pytest.approx(0.1)
    assert mark.author == "Ada"


def test_carried_labels_are_dotted_and_told_and_count_as_no_marks(tmp_path):
    folder = project_with_labels(tmp_path / "p")
    (folder / "marks/carried_1.npz").touch()
    append_mark(folder, {"shape": "carried", "file": "marks/carried_1.npz"})
    append_mark(
        folder,
        {**{name: value for name, value in LINE.items() if name not in ("photo", "points")}, "places": [(0, 0, 0)]},
    )
    probability = np.array([[0.9, 0.05], [0.2, 0.6], [0.1, 0.1], [0.55, 0.4]], np.float32)
    told = {"carried": 0.5, "conflicts": [{"revision": 4, "other": 1, "surfels": 3}], "unused": []}
    carried = np.array([True, False, True, False])
    save(folder, "main", Labelling(4, probability, np.array([1, 2], np.int32), "made", told, carried))
    found = results.labelling(folder, "main", 4)
    surfels = np.zeros((12, 12), int)
    surfels[:, 6:] = 1
    seen = results.overlay(found, surfels, {1: (1.0, 0.0, 0.0), 2: (0.0, 0.5, 0.0)}, 0, confidence=False)
    white = (seen[..., :3] == 1).all(-1)
    assert 0.1 < white[:, :6].mean() < 0.5
    assert not white[:, 6:].any()
    known = label_states.Facts(revision=4, newest=4, computed=4, told=found.told)
    assert any("50% is carried" in line for line in label_states.lines(known))
    marks = [json.loads(line) for line in (folder / "marks/journal.jsonl").read_text().splitlines()]
    assert "the surface" in label_states.conflict_text(told["conflicts"][0], marks)
