"""What the user made of a part of the capture in the scene is his from then on, and no update takes it away."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.test_scene_bridge import IMPORT, package

__all__ = ["package"]

EDITS = {
    "surface": "made.mesh.data.vertices[3].co.x += 0.1",
    "being edited": "bpy.context.view_layer.objects.active = made.mesh; bpy.ops.object.mode_set(mode='EDIT')",
    "cleaned": "import bmesh; b = bmesh.new(); b.from_mesh(made.mesh.data); bmesh.ops.delete(b, geom=b.faces[:9], "
    "context='FACES'); b.to_mesh(made.mesh.data)",
    "own material": "made.mesh.data.materials[1] = bpy.data.materials.new('Marble')",
    "shape key": "made.mesh.shape_key_add(name='Basis')",
    "weights": "made.mesh.vertex_groups.new(name='moss').add(list(range(20)), 0.5, 'REPLACE')",
    "sculpted": "bpy.context.view_layer.objects.active = made.mesh; "
    "levels = made.mesh.modifiers.new('Multires', 'MULTIRES'); bpy.ops.object.multires_subdivide(modifier='Multires')",
    "mask": "made.mesh.data.attributes.new('.sculpt_mask', 'FLOAT', 'POINT').data[3].value = 1",
    "face sets": "made.mesh.data.attributes.new('.sculpt_face_set', 'INT', 'FACE').data[3].value = 2",
    "points": "made.points.data.vertices[3].co.x += 0.1",
    "camera": "made.cameras[1].location.x += 1",
    "lens": "made.cameras[1].data.lens += 1",
    "keys": "made.animated.keyframe_insert('location', frame=77)",
}
CHANGED = {"points": "Sparse points", "camera": "view_001", "lens": "view_001", "keys": "Photographer"}


def test_what_the_user_edited_stays_and_the_new_one_comes_beside_it(bpy_script, package):
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
def names():
    return {o.name for o in bpy.data.objects}
def state(name):
    item = bpy.data.objects[name]
    keys = [k for k in item.keys() if k.startswith("fieldwork_role")]
    vertices = [tuple(v.co) for v in item.data.vertices] if item.type == "MESH" else None
    weights = [[(g.group, g.weight) for g in v.groups] for v in item.data.vertices] if item.type == "MESH" else None
    levels = [m.total_levels for m in item.modifiers if m.type == "MULTIRES"]
    animation = item.animation_data and item.animation_data.action.name
    return [item.data.name, vertices, weights, levels, tuple(item.location), animation], keys
seen = {}
for title, edit in edits.items():
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    update = lambda: import_package(bpy.context.scene, read_package(package))
    made = update()
    before = names()
    name = changed.get(title, "Surface")
    exec(edit)
    was = state(name)[0]
    again = update()
    now, roles = state(name)
    other = [o.name for o in bpy.data.objects if o.name not in before]
    last = update()
    seen[title] = {"same": now == was, "roles": roles, "new": other, "warnings": again.warnings,
                   "again": [last.warnings, len(names()) - len(before)],
                   "now": [o.name for o in (last.mesh, last.points, last.animated, last.cameras[1])]}
answer(seen)
""",
        package=package,
        edits=EDITS,
        changed=CHANGED,
    )
    for title, seen in facts.items():
        name = CHANGED.get(title, "Surface")
        assert seen["same"], title
        assert seen["roles"] == [], title
        assert seen["new"] == [f"{name}.001"], title
        assert name in seen["warnings"][0], title
        assert seen["again"] == [[], 1], f"{title}: the one beside it is brought up to date"
        assert f"{name}.001" in seen["now"], title


def test_what_the_package_no_longer_has_is_deleted_only_where_nobody_changed_it(bpy_script, package):
    facts = bpy_script(
        IMPORT
        + """
made.mesh.data.vertices[3].co.x += 0.1
lamp = bpy.data.objects["Light"]
lamp.parent = made.cameras[0]
value = json.loads(Path(package, "package.json").read_text())
value["cameras"] = value["cameras"][2:]
Path(package, "package.json").write_text(json.dumps(value))
update("classes")
first = sorted(before - names())
bpy.data.objects["stone"].constraints.new("COPY_LOCATION")
bpy.data.objects["gold"].location.x = 2
update("none")
answer([first, sorted(before - names()), sorted(names() - before), lamp.parent.name])
""",
        package=package,
    )
    assert facts[0] == ["view_001"]
    assert facts[1] == ["view_001"]
    assert facts[2] == ["Surface.001", "gold", "stone"]
    assert facts[3] == "view_000"


COPY = """
import numpy as np
from fieldwork.addon.scene.frame import root_of
from fieldwork.addon.scene.owned import Owned
from fieldwork.addon.roles import Owner
def copy(item):
    bpy.ops.object.select_all(action="DESELECT")
    item.select_set(True)
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.duplicate()
    return bpy.context.object
def raise_mesh():
    arrays = dict(np.load(Path(package, "mesh.npz")))
    arrays["vertices"] = arrays["vertices"] + np.float32(1)
    np.savez(Path(package, "mesh.npz"), **arrays)
def first_height(item):
    return round(item.data.vertices[0].co.z, 3)
"""


def test_a_copy_of_the_surface_is_the_users_own(bpy_script, package, tmp_path):
    facts = bpy_script(
        IMPORT
        + COPY
        + """
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend")
seen = {}
for title in ("as it was", "edited"):
    bpy.ops.wm.open_mainfile(filepath=folder + "/scene.blend")
    own = copy(bpy.data.objects["Surface"])
    if title == "edited":
        own.data.vertices[3].co.x += 0.1
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/copied.blend")
    bpy.ops.wm.open_mainfile(filepath=folder + "/copied.blend")
    count = len(bpy.data.objects)
    raise_mesh()
    made = update()
    own = bpy.data.objects["Surface.001"]
    seen[title] = [made.mesh.name, first_height(made.mesh), first_height(own), "fieldwork_role" in own,
                   len(bpy.data.objects) - count, made.warnings]
answer(seen)
""",
        package=package,
        folder=tmp_path,
    )
    assert facts["as it was"] == ["Surface", 1, 0, False, 0, []]
    assert facts["edited"] == ["Surface", 2, 0, False, 0, []]


def test_a_copy_of_a_camera_and_of_the_parent_is_the_users_own(bpy_script, package):
    facts = bpy_script(
        IMPORT
        + COPY
        + """
camera, parent = copy(made.cameras[1]), copy(made.root)
camera.location = (7, 7, 7)
count = len(bpy.data.objects)
made = update()
scene.collection.objects.link(made.root)  # the user puts the parent elsewhere
made.root.users_collection[0].objects.unlink(made.root)
again = update()
owner = Owner("capture")
answer({"camera": [made.cameras[1].name, made.cameras[1].location[:], camera.name, camera.location[:]],
        "parents": [made.root.name, again.root.name, root_of(scene, owner).name, Owned(scene, owner).root.name],
        "marked": [o.name for o in (camera, parent) if "fieldwork_role" in o],
        "new": len(bpy.data.objects) - count, "warnings": made.warnings + again.warnings})
""",
        package=package,
    )
    name, place, copy, at = facts["camera"]
    assert (name, copy, at) == ("view_001", "view_001.001", [7, 7, 7])
    assert abs(place[0] - 0.1) < 1e-6
    assert facts["parents"] == ["Fieldwork · capture"] * 4
    assert facts["marked"] == facts["warnings"] == []
    assert facts["new"] == 0


TEXTURED = """
def put_texture(color):
    # As the engine does: textures have names of their own, and in time the old ones go.
    for old in Path(package).glob("texture*"):
        old.unlink()
    name = "texture-{:02x}{:02x}{:02x}.png".format(*color)
    image = bpy.data.images.new("new", 4, 4)
    image.pixels = [c / 255 for c in (*color, 255)] * 16
    image.filepath_raw, image.file_format = f"{package}/{name}", "PNG"
    image.save()
    bpy.data.images.remove(image)
    value = json.loads(Path(package, "package.json").read_text())
    Path(package, "package.json").write_text(json.dumps({**value, "texture": name}))
def look(item):
    # The colour of the texture, and whether the slider moves the materials.
    material = item.data.materials[1]
    group = next(n.node_tree for n in material.node_tree.nodes if n.type == "GROUP")
    image = next(n.image for n in group.nodes if n.type == "TEX_IMAGE")
    target = group.animation_data.drivers[0].driver.variables[0].targets[0]
    return [[round(255 * c) for c in image.pixels[:3]], target.id.name + target.data_path]
RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
"""
SLIDER = 'Fieldwork · capture["show_labels"]'


@pytest.mark.parametrize("split", ["none", "classes"])
def test_a_surface_that_was_edited_keeps_its_texture(split, bpy_script, package, tmp_path):
    facts = bpy_script(
        IMPORT
        + COPY
        + TEXTURED
        + """
put_texture(RED)
made = update()
own = copy(made.mesh)
made.mesh.data.vertices[3].co.x += 0.1
texture = bpy.data.images["texture-ff0000.png"]
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend")
bpy.ops.wm.open_mainfile(filepath=folder + "/scene.blend")
for color in (GREEN, BLUE):
    # The engine writes the texture before Blender comes to it, and keeps the one before.
    before = list(Path(package).glob("texture*"))
    kept = [(path, path.read_bytes()) for path in before]
    put_texture(color)
    for path, content in kept:
        path.write_bytes(content)
    update(split)
    for path in before:
        path.unlink()
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend")
bpy.ops.wm.open_mainfile(filepath=folder + "/scene.blend")
new = next(o for o in bpy.data.objects if o.get("fieldwork_role") in ("mesh", "class:1"))
answer([look(bpy.data.objects["Surface"]), look(bpy.data.objects["Surface.001"]), look(new),
        sorted(i.name for i in bpy.data.images if i.name.startswith("texture"))])
""",
        package=package,
        folder=tmp_path,
        split=split,
    )
    edited, copied, new, images = facts
    assert edited == copied == [[255, 0, 0], SLIDER]
    assert new == [[0, 0, 255], SLIDER]
    assert images == ["texture-0000ff.png", "texture-ff0000.png"], "nothing piles up"


def test_a_texture_that_was_painted_on_stays(bpy_script, package):
    facts = bpy_script(
        IMPORT
        + TEXTURED
        + """
put_texture(RED)
update()
image = bpy.data.images["texture-ff0000.png"]
image.pixels[:4] = [0, 1, 1, 1]
image.update()
put_texture(BLUE)
made = update()
answer([look(made.mesh)[0], image.use_fake_user, [round(c) for c in image.pixels[:3]]])
""",
        package=package,
    )
    assert facts == [[0, 0, 255], True, [0, 1, 1]]


@pytest.mark.parametrize("override", [False, True])
def test_what_is_linked_from_another_file_stays_and_the_new_comes_beside_it(override, bpy_script, package, tmp_path):
    facts = bpy_script(
        IMPORT
        + COPY
        + TEXTURED
        + """
put_texture(RED)
update()
bpy.ops.wm.save_as_mainfile(filepath=folder + "/library.blend", relative_remap=True)
bpy.ops.wm.read_factory_settings(use_empty=True)
with bpy.data.libraries.load(folder + "/library.blend", link=True) as (there, here):
    here.collections = [name for name in there.collections if name.startswith("Fieldwork")]
scene, linked = bpy.context.scene, here.collections[0]
scene.collection.children.link(linked)
if override:
    linked.override_hierarchy_create(scene, bpy.context.view_layer, do_fully_editable=True)
def theirs():
    items = [o for o in scene.objects if (o.library or o.override_library) and o.animation_data is None]
    return sorted((o.name, o.matrix_basis.translation[:]) for o in items)
before, others = theirs(), set(scene.objects)
raise_mesh()
value = json.loads(Path(package, "package.json").read_text())
value["cameras"].append({**value["cameras"][0], "name": "new"})
Path(package, "package.json").write_text(json.dumps(value))
seen = []
for _ in range(2):
    made = update()
    seen.append([len(set(scene.objects) - others), theirs() == before, made.warnings])
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend")
    bpy.ops.wm.open_mainfile(filepath=folder + "/scene.blend")
    scene = bpy.context.scene
    others = {o for o in scene.objects if o.library or o.override_library}
made = update()
used = [i for i in (made.mesh, made.mesh.data, made.root, made.cameras[0].data, *made.mesh.data.materials) if i.library]
answer([seen, first_height(made.mesh), look(made.mesh)[0], [i.name for i in used]])
""",
        package=package,
        folder=tmp_path,
        override=override,
    )
    seen, height, color, used = facts
    everything = 1 + 5 + 1 + 1 + 1  # parent, cameras, the animated one, points, surface
    assert seen == [[everything, True, []]] * 2
    assert (height, color, used) == (1, [255, 0, 0], [])
