"""Nothing of the user's is touched under his hands, replaced or deleted by what comes into the scene."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest
from fieldwork.tests.addon.support import SETUP
from fieldwork.tests.addon.test_mesh_import import make_package

IMPORT = (
    SETUP
    + """
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
bpy.context.preferences.filepaths.save_version = 0
def update(split="none"):
    return import_package(bpy.context.scene, read_package(package), split=split)
def names():
    return {o.name for o in bpy.data.objects}
made = update()
before = names()
"""
)


@pytest.fixture
def package(tmp_path):
    return make_package(tmp_path / "package", 9, cameras=4, points=30)


def test_what_was_only_looked_at_is_brought_up_to_date_in_place(bpy_script, package, tmp_path):
    """Edit Mode, Sculpt Mode and back, saved and read again: nothing piles up."""
    facts = bpy_script(
        IMPORT
        + """
for item in (made.mesh, made.points):
    bpy.context.view_layer.objects.active = item
    for mode in ("EDIT", "SCULPT", "OBJECT"):
        bpy.ops.object.mode_set(mode=mode)
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend", relative_remap=True)
bpy.ops.wm.open_mainfile(filepath=folder + "/scene.blend")
images = len(bpy.data.images)
again = update()
answer([again.warnings, names() == before, len(bpy.data.images) - images, len(bpy.data.meshes)])
""",
        package=package,
        folder=tmp_path,
    )
    assert facts == [[], True, 0, 3]  # surface, points, and the default cube


def test_a_class_that_is_renamed_is_called_so_in_the_scene_but_for_what_the_user_called_otherwise(bpy_script, package):
    facts = bpy_script(
        IMPORT
        + """
import json
def outliner(split):
    made = update(split)
    return sorted([o.name, o.data.name, o.users_collection[0].name] for o in made.meshes)
def rename(*names):
    value = json.loads((Path(package) / "package.json").read_text())
    for entry, name in zip(value["classes"], names):
        entry["name"] = name
    (Path(package) / "package.json").write_text(json.dumps(value))
rename("class 1", "class 2")
seen = [outliner("classes")]
bpy.data.objects["class 2"].name = "crown"
bpy.data.collections["class 2"].name = "jewels"
rename("stone", "gold")
seen += [outliner("classes")]
rename("gold", "stone")
seen += [outliner("classes")]
answer(seen)
""",
        package=package,
    )
    assert facts[0] == [["class 1"] * 3, ["class 2"] * 3]
    assert facts[1] == [["crown", "class 2", "jewels"], ["stone"] * 3]
    assert [names[:2] for names in facts[2]] == [["crown", "class 2"], ["gold", "gold"]]


def test_settings_that_the_user_chose_are_not_reset(bpy_script, package):
    facts = bpy_script(
        IMPORT
        + """
scene.camera = made.cameras[2]
scene.render.resolution_x, made.root.scale, made.root.empty_display_size = 1234, (3, 3, 3), 5
made.mesh.location.z = 4
camera = made.cameras[1].data
own = bpy.data.images.new("own", 4, 4)
slot = camera.background_images.new()
slot.image = own
camera.background_images[0].alpha, camera.display_size, camera.clip_end = 0.5, 9, 77
camera.show_background_images = False
empty = made.cameras[3].data  # the user took the photo away and put his own picture there
empty.background_images.clear()
empty.background_images.new().image = own
ball = lambda: next(n for n in made.points.modifiers[0].node_group.nodes if n.type == "MESH_PRIMITIVE_ICO_SPHERE")
ball().inputs["Radius"].default_value = 0.25
tree = next(t for t in bpy.data.node_groups if t.name.startswith("Fieldwork Surface"))
tree.nodes.new("ShaderNodeHueSaturation")
nodes = len(tree.nodes)
stone = made.mesh.data.materials[1]
stone.node_tree.nodes.clear()
made = update()
answer({
    "scene": [scene.camera.name, scene.render.resolution_x, made.root.scale[0], made.root.empty_display_size],
    "surface": made.mesh.location.z,
    "slots": [s.image.name for s in camera.background_images], "alpha": camera.background_images[0].alpha,
    "camera": [camera.display_size, camera.clip_end, camera.show_background_images],
    "empty": [s.image.name for s in empty.background_images],
    "radius": ball().inputs["Radius"].default_value,
    "nodes": [len(tree.nodes) - nodes, len(stone.node_tree.nodes)], "warnings": made.warnings,
})
""",
        package=package,
    )
    assert facts["scene"] == ["view_002", 1234, 3, 5]
    assert facts["surface"] == 4
    assert facts["slots"] == ["view_001.png", "own"]
    assert facts["alpha"] == 0.5
    assert facts["camera"] == [9, 77, False]
    assert facts["empty"] == ["own", "view_003.png"]
    assert facts["radius"] == 0.25
    assert facts["nodes"] == [0, 0]
    assert facts["warnings"] == []


def test_packed_photos_follow_their_files_and_painted_ones_stay(bpy_script, package, tmp_path):
    facts = bpy_script(
        IMPORT
        + """
photos = [c.data.background_images[0].image for c in made.cameras[:3]]
photos[0].pack()
photos[1].pixels[:4] = [0, 0, 1, 1]
photos[1].update()
photos[2].pixels[:4] = [0, 0, 1, 1]
photos[2].update()
photos[2].pack()
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend", relative_remap=True)
for number in range(3):
    image = bpy.data.images.new("new", 48, 32)
    image.generated_color = (1, 1, 1, 1)
    image.filepath_raw, image.file_format = f"{package}/images/view_{number:03}.png", "PNG"
    image.save()
    bpy.data.images.remove(image)
seen = []
for _ in range(2):
    made = update()
    now = [c.data.background_images[0].image for c in made.cameras[:3]]
    seen.append([[round(image.pixels[0], 2) for image in now], [round(image.pixels[0], 2) for image in photos],
                 len(bpy.data.images), photos[0] == now[0]])
answer(seen)
""",
        package=package,
        folder=tmp_path,
    )
    first, second = facts
    assert first[0] == [1, 1, 1], "the photos are those of the project"
    assert first[1][1:] == [0, 0], "what was painted is still there"
    assert first[3], "a packed photo that nobody painted on is the same image"
    assert second == first, "nothing piles up"


def test_pictures_are_read_again_only_when_their_files_changed(bpy_script, package):
    facts = bpy_script(
        IMPORT
        + """
image = made.cameras[0].data.background_images[0].image
seen = []
for change in (False, True):
    if change:
        os.utime(f"{package}/images/view_000.png", (1, 1))
    image.pixels[0]
    update()
    seen.append(image.has_data)
answer(seen)
""",
        package=package,
    )
    assert facts == [True, False]


def test_the_scene_is_left_alone_until_object_mode(bpy_script, package, tmp_path):
    facts = bpy_script(
        """
import time
import fieldwork
fieldwork.register()
from fieldwork.addon.jobs import queue as module
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.jobs.timer import tick
from fieldwork.operators.scene import import_result
module.SLICE = 0  # one step a tick, on a fast machine too
Path(project, "project.json").write_text(json.dumps({"format": "fieldwork-project"}))
bpy.context.scene.fieldwork.project = project
def finished():
    job = queue.make("package", {"project": project}, lambda job: import_result(job, "both", "Scene"))
    job.state = "running"
    queue.finish(job, {"folder": package}, None)
    return job
def ticks(count):
    for _ in range(count):
        tick(queue)
        time.sleep(0.01)
count = lambda: len(bpy.data.objects)
bpy.ops.object.mode_set(mode="EDIT")
first, second = finished(), finished()
ticks(20)
waiting = [count(), first.state, first.message, queue.current is first]
bpy.ops.object.mode_set(mode="OBJECT")
ticks(3)
bpy.ops.object.mode_set(mode="SCULPT")
part = count()
ticks(5)
held = [count() - part, first.message]
bpy.ops.object.mode_set(mode="OBJECT")
# Everything that came is deleted in the middle of it, without a step of undo.
third = finished()
for _ in range(400):
    tick(queue)
    if third.message == "view_002":
        break
middle = [first.state, second.state, third.state, third.message]
for item in [o for o in bpy.data.objects if "fieldwork_role" in o]:
    bpy.data.objects.remove(item)
for _ in range(1000):
    tick(queue)
    if queue.current is None:
        break
    time.sleep(0.005)
answer({"waiting": waiting, "held": held, "middle": middle, "states": [first.state, second.state, third.state],
        "error": str(third.error), "objects": count()})
""",
        package=package,
        project=tmp_path,
    )
    assert facts["waiting"] == [3, "done", "Waits for Object Mode", True]
    assert facts["held"] == [0, "Waits for Object Mode"]
    assert facts["middle"] == ["done", "done", "running", "view_002"]
    assert facts["states"] == ["done", "done", "done"], facts["error"]
    assert facts["objects"] == 3 + 8  # parent, four cameras, the animated one, points, surface


def test_the_gate_is_shut_while_something_else_works_on_the_scene(monkeypatch):
    pytest.importorskip("bpy")
    from fieldwork.addon.jobs import gate

    cube = SimpleNamespace(mode="OBJECT")
    window = SimpleNamespace(modal_operators=[], view_layer=SimpleNamespace(objects=SimpleNamespace(active=cube)))
    working: set[str] = set()
    stub = SimpleNamespace(
        app=SimpleNamespace(is_job_running=lambda kind: kind in working),
        context=SimpleNamespace(window_manager=SimpleNamespace(windows=[window])),
    )
    monkeypatch.setattr(gate, "bpy", stub)
    assert gate.closed() is None
    cube.mode = "WEIGHT_PAINT"
    assert "Object Mode" in gate.closed()
    window.view_layer.objects.active = None
    assert gate.closed() is None
    for kind in ("RENDER", "OBJECT_BAKE"):
        working.add(kind)
        assert "render" in gate.closed()
        working.clear()
    window.modal_operators.append(SimpleNamespace(name="Move"))
    assert "Move" in gate.closed()
    window.modal_operators.clear()
    gate.set_loading(True)
    assert "file" in gate.closed()
    gate.set_loading(False)
    assert gate.closed() is None


def test_the_gate_is_shut_while_a_file_loads_and_open_after_it(bpy_script, tmp_path):
    seen = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs import gate
seen = []
bpy.app.handlers.load_pre.append(lambda *_: seen.append(gate.closed()))
bpy.ops.wm.read_homefile(use_factory_startup=True)
seen.append(gate.closed())
Path(folder, "broken.blend").write_bytes(b"BLENDER broken")
try:
    bpy.ops.wm.open_mainfile(filepath=folder + "/broken.blend")
except RuntimeError:
    seen.append(gate.closed())
answer(seen)
""",
        folder=tmp_path,
    )
    # A file that is none at all is refused before Blender begins to load it.
    assert seen == ["Waits until the file is loaded", None, None]


def test_lists_are_brought_up_to_date_in_place(bpy_script, tmp_path):
    """The user may be typing a class's name: its entry must stay where it is."""
    from fieldwork.tests.addon.support import make_project

    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.project import lists
settings.project = project
for entry in (*settings.classes, *settings.images):
    entry["mark"] = 1
lists.refresh(settings)
same = all("mark" in entry for entry in (*settings.classes, *settings.images))
value = json.loads(Path(project, "project.json").read_text())
value["classes"].pop()
Path(project, "project.json").write_text(json.dumps(value))
os.utime(Path(project, "project.json"), (1, 1))
lists.refresh(settings)
answer([same, [c.name for c in settings.classes]])
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == [True, ["stone"]]


def test_pictures_of_every_other_frame_are_held(tmp_path):
    pytest.importorskip("bpy")
    from fieldwork.addon.render.result import EVERY_FRAME, every_frame, frame_number

    def files(*numbers):
        made = [tmp_path / f"frame_{number:04}.png" for number in numbers]
        for number, path in zip(numbers, made):
            path.write_text(str(number))
        return made

    whole = files(1, 2, 3)
    assert every_frame(whole) == whole
    assert every_frame(whole[:1]) == whole[:1]
    held = every_frame(files(5, 8, 11))
    assert [frame_number(path) for path in held] == list(range(5, 14))
    assert [path.read_text() for path in held] == ["5"] * 3 + ["8"] * 3 + ["11"] * 3
    every_frame(files(5, 7))
    assert sorted(os.listdir(tmp_path / EVERY_FRAME)) == [f"frame_{n:04}.png" for n in (5, 6, 7, 8)]
    early = files(-2, -1, 0, 1)
    assert [frame_number(path) for path in early] == [-2, -1, 0, 1]
    held = every_frame(early)
    assert [frame_number(path) for path in held] == [1, 2, 3, 4], "Blender knows no negative numbers of pictures"
    assert [path.read_text() for path in held] == ["-2", "-1", "0", "1"]
    assert every_frame(files(-2)) == files(-2)
