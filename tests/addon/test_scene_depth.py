"""Which viewports have no depth of their own, and what of the objects' shapes is kept when the scene changes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
from fieldwork.addon.errors import EngineError
from fieldwork.addon.live import objects
from fieldwork.addon.live.objects import mesh_of
from fieldwork.addon.live.scene_depth import UNUSED, SceneDepth, Shape, _covers, lacks_depth


def space(overlays: bool, shading: str) -> SimpleNamespace:
    return SimpleNamespace(overlay=SimpleNamespace(show_overlays=overlays), shading=SimpleNamespace(type=shading))


def test_depth_is_missing_where_engines_draw_without_overlays() -> None:
    lacking = {
        (o, s)
        for o in (True, False)
        for s in ("WIREFRAME", "SOLID", "MATERIAL", "RENDERED")
        if lacks_depth(space(o, s))
    }
    assert lacking == {(False, "MATERIAL"), (False, "RENDERED")}


def test_only_what_changed_is_made_anew() -> None:
    depth = SceneDepth()
    cup, plate = Shape(frozenset({"cup", "Mesh"}), 1), Shape(frozenset({"plate", "Mesh.001"}), 2)
    depth._shapes = {("cup", 1): cup, ("plate", 2): plate}
    depth.changed({"Scene"})
    assert list(depth._shapes.values()) == [cup, plate]
    depth.changed({"Mesh.001"})
    assert list(depth._shapes.values()) == [cup]
    depth.changed(None)
    assert not depth._shapes
    assert depth.changes == 3, "each change is drawn anew"


def test_nothing_is_kept_that_no_viewport_asks_for() -> None:
    depth = SceneDepth()
    depth._targets = {1: SimpleNamespace(used=10.0), 2: SimpleNamespace(used=30.0)}
    depth._shapes = {("cup", 1): Shape(frozenset({"cup"}), 1)}
    depth.give_up(10.0 + UNUSED)
    assert list(depth._targets) == [2]
    assert depth._shapes, "a viewport still needs them"
    depth.give_up(30.0 + UNUSED)
    assert not depth._targets
    assert not depth._shapes


def test_objects_for_which_there_is_no_room_are_told(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file, **_) -> None:
        file.write(b"some of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(objects.np, "savez", full)
    with pytest.raises(EngineError, match="no room for the scene's objects"):
        objects.write_triangles(tmp_path / "objects.npz", bpy.context.evaluated_depsgraph_get())
    assert list(tmp_path.iterdir()) == []


def test_what_is_drawn_as_wires_hides_nothing() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    bpy.ops.object.light_add()

    def covering() -> list[str]:
        # Outside a window no viewport says what it shows.
        shown = SimpleNamespace(visible_in_viewport_get=lambda _space: True)
        found = []
        for one in bpy.context.evaluated_depsgraph_get().object_instances:
            obj = SimpleNamespace(type=one.object.type, display_type=one.object.display_type, original=shown)
            if _covers(SimpleNamespace(object=obj, parent=None, show_self=one.show_self), None):
                found.append(one.object.name)
        return found

    assert covering() == ["Cube"]
    cube.display_type = "WIRE"
    assert covering() == []


def test_triangles_are_those_of_the_evaluated_object() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_cube_add(size=2)
    cube = bpy.context.object
    cube.modifiers.new("twice", "ARRAY").count = 2
    vertices, faces = mesh_of(cube.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    assert len(faces) == 24
    assert np.allclose([vertices.min(0), vertices.max(0)], [[-1, -1, -1], [3, 1, 1]])
    bpy.ops.curve.primitive_bezier_curve_add()
    curve = bpy.context.object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert len(mesh_of(curve)[1]) == 0, "a line has no surface"
