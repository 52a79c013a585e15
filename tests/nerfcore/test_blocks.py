"""Large captures in blocks: which photos a block gets, and that the meshes of two blocks meet as if they were one."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Timer

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.blocks.join import joined, open_at_seams
from fieldwork.nerfcore.blocks.maps import cut_maps, joined_maps, load_maps, moved, save_maps
from fieldwork.nerfcore.blocks.plan import Plan, block_folder, cut, load_plan, save_plan
from fieldwork.nerfcore.blocks.projects import write_block
from fieldwork.nerfcore.blocks.sights import Sights, chosen, load_sights, save_sights, sights_of
from fieldwork.nerfcore.blocks.surface import (
    Part,
    core_surface,
    limit_of,
    load_part,
    part_box,
    pictures_shown,
    save_part,
    shared_region,
)
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.errors import ProjectError, SettingError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.geometry.similarity import make_similarity
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.mesh import clean, depth_maps, triangles
from fieldwork.nerfcore.mesh.extract import extract
from fieldwork.nerfcore.mesh.fusion import fuse_maps, tolerances
from fieldwork.nerfcore.mesh.instances import GAP, find_instances
from fieldwork.nerfcore.mesh.region import all_hits
from fieldwork.nerfcore.mesh.surface import Surface, is_watertight, vertex_normals, with_faces
from fieldwork.nerfcore.params import BlocksParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.lock import project_lock
from fieldwork.nerfcore.project.schema import Frame, ImageRecord, PosedImage, Poses, Project, SemanticClass
from fieldwork.nerfcore.project.store import load_points, load_project, load_visibility, save_poses, save_project
from fieldwork.nerfcore.workflows import blocks as workflow
from fieldwork.tests.nerfcore.support.depth_views import Hit, box, look_at, maps_of, orbit, sphere
from fieldwork.tests.nerfcore.support.flat import wall_mesh

CPU = torch.device("cpu")
NAMES = {0: "void", 1: "upper", 2: "lower"}
CELLS = 48


def two_blocks(half: float = 1.0, at: float = 0.1) -> Plan:
    """The cube of half side `half`, cut across x."""
    whole = {"low": (-half,) * 3, "high": (half,) * 3}
    left = {"name": "1", "low": (-half,) * 3, "high": (at, half, half), "images": []}
    right = {"name": "2", "low": (at, -half, -half), "high": (half,) * 3, "images": []}
    return Plan.model_validate({**whole, "blocks": [left, right]})


def known_maps(hit: Hit, plan: Plan, poses: list[np.ndarray]) -> list[MapArrays]:
    """What two perfect fields show of an analytic shape, each cut to what is its own."""
    maps = depth_maps.confirmed_maps(*maps_of(hit, poses), CPU, Reporter())
    common = np.linalg.inv(plan.world_from_common)
    maps = moved(maps, common)

    def corners(pair: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        low, high = (corner * common[0, 0] + common[:3, 3] for corner in pair)
        return low, high

    return [cut_maps(maps, corners(plan.reach(block)), corners(plan.whole)) for block in plan.blocks]


def classed(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """A surface with the class of its height and a colour of its place."""
    face_class = np.where(vertices[faces].mean(1)[:, 2] > 0.05, 1, 2).astype(np.int32)
    class_id = np.where(vertices[:, 2] > 0.05, 1, 2).astype(np.int32)
    colors = ((vertices + 1) * 100).clip(0, 255).astype(np.uint8)
    normals = vertex_normals(vertices, faces).astype(np.float32)
    return Surface(vertices.astype(np.float32), faces.astype(np.int32), normals, colors, class_id, face_class)


def sights_in(each: list[MapArrays], plan: Plan) -> list[Sights]:
    return [sights_of(maps, limit_of(plan)) for maps in each]


def in_blocks(each: list[MapArrays], plan: Plan, cells: int = CELLS) -> tuple[list[Part], list[list[int]]]:
    """The part of each block from the maps that see it, and how many of each block's maps these are."""
    sights, parts, counts = sights_in(each, plan), [], []
    region = shared_region(None, plan, sights, cells)
    for block in plan.blocks:
        heard = [seen.speak_of(*part_box(region, plan, block, sights)) for seen in sights]
        counts.append([int(keep.sum()) for keep in heard])
        maps = joined_maps([chosen(own, keep) for own, keep in zip(each, heard) if keep.any()])
        vertices, faces, inside, seams = core_surface(maps, region, plan, block, Reporter(), sights)
        used, index = np.unique(faces[inside], return_inverse=True)
        parts.append(Part(classed(vertices[used], index.reshape(-1, 3)), seams, region.voxel))
    return parts, counts


def in_one(each: list[MapArrays], plan: Plan, cells: int = CELLS) -> Surface:
    region, maps = shared_region(None, plan, sights_in(each, plan), cells), joined_maps(each)
    bricks = fuse_maps(maps, region, Reporter())
    vertices, faces = extract(bricks, Reporter())
    near = tolerances(bricks, vertices, faces, 4 * region.voxel)
    vertices, faces = triangles.compact(vertices, faces[clean.shown(vertices, faces, maps, near, Reporter())])
    return joined([Part(classed(vertices, faces), np.zeros((0, 2)), region.voxel)])[0]


SHAPES: dict[str, Callable[[], Hit]] = {
    "sphere": lambda: sphere(0.5),
    "box": lambda: box(np.array([-0.45, -0.3, -0.25]), np.array([0.5, 0.3, 0.35])),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_two_blocks_make_the_mesh_of_one(shape: str) -> None:
    plan = two_blocks()
    maps = known_maps(SHAPES[shape](), plan, orbit(24, 1.8))
    (parts, _), one = in_blocks(maps, plan), in_one(maps, plan)
    assert all(len(part.surface.faces) > 0.2 * len(one.faces) for part in parts)
    assert open_at_seams(parts[0].surface, parts) > 20, "a block alone is open at its seam"
    both, _ = joined(parts)
    assert open_at_seams(both, parts) == 0
    assert is_watertight(both.faces)
    assert is_watertight(one.faces)
    # No double layer: there is as much surface as in one piece, and every triangle of it.
    assert len(both.faces) == len(one.faces)
    area = [triangles.areas(s.vertices.astype(float), s.faces).sum() for s in (both, one)]
    assert area[0] == pytest.approx(area[1], rel=1e-5)
    # Labels agree: so do the areas of each class, and things that the seam cuts through are one.
    for kind in (1, 2):
        shares = [triangles.areas(s.vertices.astype(float), s.faces)[s.face_class == kind].sum() for s in (both, one)]
        assert shares[0] == pytest.approx(shares[1], rel=1e-5)
    found = [find_instances(s.vertices, s.faces, s.face_class, NAMES, 0, GAP * parts[0].voxel)[1] for s in (both, one)]
    assert [i.name for i in found[0]] == [i.name for i in found[1]] == ["upper.001", "lower.001"]
    alone = [find_instances(p.surface.vertices, p.surface.faces, p.surface.face_class, NAMES, 0, 0.0)[1] for p in parts]
    assert sum(len(instances) for instances in alone) == 4, "each block has a part of both"


def row_of_blocks(count: int) -> Plan:
    """A bar of 2 along x, cut into equal blocks."""
    at = np.linspace(-1, 1, count + 1)
    blocks = [
        {"name": f"{k + 1}", "low": (at[k], -0.4, -0.4), "high": (at[k + 1], 0.4, 0.4), "images": []}
        for k in range(count)
    ]
    return Plan.model_validate({"low": (-1, -0.4, -0.4), "high": (1, 0.4, 0.4), "blocks": blocks})


def test_blocks_of_a_soft_field_make_the_mesh_of_one() -> None:
    """Views disagree by up to eight voxels, so that bricks are fused with a wider truncation, but in one block they are sure:
    it takes part in what is done, as it would in one piece."""
    plan, each = two_blocks(), []
    for number, maps in enumerate(known_maps(sphere(0.5), plan, orbit(24, 1.8))):
        depth = maps.depth.clone()
        for view in range(len(maps)):
            begin = int(maps.first[view])
            own = slice(begin, begin + int(maps.size[view].prod()))
            hit = (depth[own] > 0) & (depth[own] < FREE)
            depth[own] = torch.where(hit, depth[own] + 0.04 * (view % 5 - 2), depth[own])
        each.append(replace(maps, depth=depth, spread=torch.full_like(maps.spread, 0.02 + 0.4 * number)))
    (parts, _), one = in_blocks(each, plan), in_one(each, plan)
    both, _ = joined(parts)
    region = shared_region(None, plan, sights_in(each, plan), CELLS)
    assert fuse_maps(joined_maps(each), region, Reporter()).wide.any()
    assert len(both.faces) == len(one.faces) > 1000
    assert np.array_equal(np.sort(both.vertices, 0), np.sort(one.vertices, 0)), "to the bit"


def test_what_fills_holes_is_marked() -> None:
    vertices, faces = wall_mesh(20)[:2]
    wall = classed(vertices, faces)
    hole = np.linalg.norm(vertices[faces].mean(1), axis=1) < 0.1
    found, filled = joined([Part(with_faces(wall, ~hole), np.zeros((0, 2)), 0.05)])
    assert len(triangles.border_edges(found.faces)) == len(triangles.border_edges(faces))
    assert 0 < filled.sum() < len(filled)
    area = triangles.areas(vertices, faces)
    share = triangles.area_share(found.vertices, found.faces, filled)
    assert share == pytest.approx(area[hole].sum() / area.sum(), rel=1e-5)
    assert not filled[: int((~hole).sum())].any()


def test_a_part_needs_only_the_maps_that_see_it() -> None:
    """A bar of five blocks: a part from the maps of its neighbours is the same as from all."""
    plan = row_of_blocks(5)
    bar = box(np.array([-0.95, -0.3, -0.3]), np.array([0.95, 0.3, 0.3]))
    sides = [np.array([0, y, z]) for y, z in ((0.6, 0.01), (-0.6, 0.01), (0.01, 0.6), (0.01, -0.6))]
    each = []
    for number, block in enumerate(plan.blocks):
        (low, _, _), (high, _, _) = plan.region(block)
        along = [np.array([x, 0.0, 0.0]) for x in np.linspace(-0.9, 0.9, 19) if low <= x <= high]
        poses = [look_at(place + side, place) for place in along for side in sides]
        each.append(known_maps(bar, plan, poses)[number])
    parts, counts = in_blocks(each, plan, 40)
    one = in_one(each, plan, 40)
    both, _ = joined(parts)
    assert len(both.faces) == len(one.faces) > 1000
    assert open_at_seams(both, parts) == open_at_seams(one, parts), "holes are those of one piece"
    assert np.array_equal(np.sort(both.vertices, 0), np.sort(one.vertices, 0)), "to the bit"
    # Blocks that are farther away are not even read.
    read = [[other for other, count in enumerate(row) if count] for row in counts]
    assert 0 in read[0]
    assert 4 in read[4]
    assert max(read[0]) <= 2 <= min(read[4])
    assert sum(map(sum, counts)) < 0.7 * 5 * sum(len(maps) for maps in each)


def test_what_maps_speak_of_holds_all_that_they_show(tmp_path: Path) -> None:
    plan = two_blocks()
    for maps in known_maps(sphere(0.5), plan, orbit(6, 1.8)):
        seen = sights_of(maps, limit_of(plan))
        points = [depth_maps.hit_points(maps, view).numpy() for view in range(len(maps))]
        for view, hits in enumerate(points):
            asked = [seen.speak_of(point, point, 0.0, 0.0)[view] for point in hits[::97]]
            assert all(asked)
        assert not seen.speak_of(np.full(3, 9.0), np.full(3, 9.5), 0.0, 0.0).any()
        save_sights(tmp_path / "sights.npz", seen)
        again = load_sights(tmp_path / "sights.npz")
        assert all(np.array_equal(getattr(again, name), value) for name, value in vars(seen).items())
    (tmp_path / "sights.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(ProjectError, match="damaged"):
        load_sights(tmp_path / "sights.npz")
    with pytest.raises(ProjectError, match="missing"):
        load_sights(tmp_path / "none.npz")


def test_a_block_s_maps_tell_only_of_its_surroundings() -> None:
    plan = two_blocks()
    left, right = known_maps(sphere(0.5), plan, orbit(12, 1.8))
    (_, far), (near, _) = plan.reach(plan.blocks[0]), plan.reach(plan.blocks[1])
    assert all_hits(left)[:, 0].max() <= far[0] + 1e-5
    assert all_hits(right)[:, 0].min() >= near[0] - 1e-5
    assert all_hits(left)[:, 0].max() > 0.1 > all_hits(right)[:, 0].min(), "they overlap"
    # A ray that meets nothing says nothing of the other block's part.
    whole = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(12, 1.8)), CPU, Reporter())
    assert 0 < int((left.depth >= FREE).sum()) < int((whole.depth >= FREE).sum())


def test_maps_in_another_frame_show_the_same_places(tmp_path: Path) -> None:
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(6, 1.8)), CPU, Reporter())
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    similarity = make_similarity(2.5, turn, np.array([3.0, -1, 0.5]))
    other = moved(maps, similarity)
    expected = all_hits(maps).numpy() @ similarity[:3, :3].T + similarity[:3, 3]
    np.testing.assert_allclose(all_hits(other).numpy(), expected, atol=1e-5)
    save_maps(tmp_path / "maps.npz", other)
    stored = load_maps(tmp_path / "maps.npz", CPU)
    assert all(torch.equal(getattr(stored, name), value) for name, value in vars(other).items())
    assert load_maps(tmp_path / "maps.npz", torch.device("mps")).depth.device == CPU, "Warp has no kernels for it"
    (tmp_path / "maps.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(ProjectError, match="damaged"):
        load_maps(tmp_path / "maps.npz", CPU)


CAMERA = Camera(width=60, height=40, fx=50, fy=50, cx=30, cy=20)


def walk(photos: int = 12, points: bool = True) -> Scene:
    """Photos along a wall of 12 m, each of 2.4 m of it."""
    x = np.linspace(-5, 5, photos)
    poses = [look_at(np.array([place, -2.0, 1.0]), np.array([place, 0, 1.0])) for place in x]
    views = [View(f"p{k:02d}", CAMERA, pose, image=Path("none")) for k, pose in enumerate(poses)]
    wall = np.stack(np.meshgrid(np.linspace(-6, 6, 60), [0.0], np.linspace(0, 2, 10), indexing="ij"), -1).reshape(-1, 3)
    seen = Points(wall, np.zeros((len(wall), 3), np.uint8), np.ones(len(wall))) if points else Points.empty()
    bounds = None if points else np.array([[-6.0, -0.5, 0], [6, 0.5, 2]])
    return Scene(views, list(range(photos)), [], points=seen, bounds=bounds)


def test_a_block_s_pictures_are_those_of_its_maps_whatever_made_them(monkeypatch: pytest.MonkeyPatch) -> None:
    views = walk(4).views
    monkeypatch.setattr(depth_maps, "CPU_PIXELS", 4 * 72 * 48)
    monkeypatch.setattr(depth_maps, "SIDE", 120)
    big = [replace(view, camera=CAMERA.resized(120, 80)) for view in views]
    for kind, side in (("cuda", 120), ("cpu", 72)):
        assert depth_maps.map_size(big, torch.device(kind)) == side
        flats = depth_maps.flat_views(big, np.eye(4), depth_maps.map_size(big, torch.device(kind)))
        empty = [np.zeros((f.camera.height, f.camera.width), np.float32) for f in flats]
        maps = depth_maps.map_arrays(flats, [depth_maps.DepthMap(e, e, e) for e in empty], CPU)
        found = pictures_shown(maps, big, np.eye(4), Path("maps.npz"))
        assert [f.camera for f in found] == [f.camera for f in flats]
    with pytest.raises(ProjectError, match=r"maps\.npz holds depth maps of another size"):
        pictures_shown(maps, big[:3], np.eye(4), Path("7/maps.npz"))


@pytest.mark.parametrize("points", [True, False])
def test_blocks_are_cut_by_where_the_photos_were_taken(points: bool) -> None:
    plan = cut(walk(points=points), 2)
    first, second = plan.blocks
    assert first.high[0] == second.low[0] == pytest.approx(0, abs=0.6)
    assert first.low[0] == plan.low[0] < first.high[0] < second.high[0] == plan.high[0]
    assert (first.low[1:], first.high[1:]) == (second.low[1:], second.high[1:])
    # Those beside the seam see both blocks, the others one.
    assert set(first.images) | set(second.images) == {f"p{k:02d}" for k in range(12)}
    both = set(first.images) & set(second.images)
    assert "p05" in both
    assert "p06" in both
    assert not {"p00", "p11"} & both
    assert plan.region(first)[1][0] > first.high[0]
    assert np.isinf(plan.core(first)[0]).all(), "nothing lies beyond but what it sees"


def test_four_blocks_divide_where_most_photos_are() -> None:
    plan = cut(walk(24), 4)
    assert [block.name for block in plan.blocks] == ["1", "2", "3", "4"]
    cuts = [block.high[0] for block in plan.blocks[:-1]]
    assert cuts == sorted(cuts) == [block.low[0] for block in plan.blocks[1:]]
    volume = sum(np.prod(np.subtract(block.high, block.low)) for block in plan.blocks)
    assert volume == pytest.approx(np.prod(np.subtract(plan.high, plan.low)))


@pytest.mark.parametrize("on_cluster", [True, False])
def test_a_worker_waits_for_one_that_still_holds_its_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_cluster: bool
) -> None:
    plan = two_blocks()
    save_plan(tmp_path, plan)
    save_project(block_folder(tmp_path, plan.blocks[0]), Project())
    task = workflow.tasks_of(BlocksParams(project=tmp_path), plan)[0]
    monkeypatch.setitem(workflow._STAGES, "train", lambda *_: ({"steps": 1}, False))
    with ExitStack() as held:
        held.enter_context(project_lock(block_folder(tmp_path, plan.blocks[0]), "blocks"))
        if on_cluster:
            Timer(0.3, held.close).start()
            assert workflow.run_stage(task.values, Reporter())["result"] == {"steps": 1}
        else:
            with pytest.raises(ProjectError, match="is being worked on"):
                workflow._here(BlocksParams(project=tmp_path), plan, Reporter())


def test_too_many_blocks_for_the_photos_are_told() -> None:
    with pytest.raises(SettingError, match="fewer blocks"):
        cut(walk(4), 8)


def test_a_block_is_a_project_of_its_own(tmp_path: Path) -> None:
    scene = walk()
    project = Project(
        images=[ImageRecord(name=v.name, file=f"images/{v.name}.jpg", width=60, height=40) for v in scene.views],
        classes=[SemanticClass(id=1, name="wall", color=(1, 0, 0))],
        frame=Frame(scale_known=True),
    )
    (tmp_path / "images").mkdir()
    for view in scene.views:
        (tmp_path / "images" / f"{view.name}.jpg").write_bytes(view.name.encode())
    save_project(tmp_path, project)
    images = [PosedImage(name=v.name, camera=0, camera_to_world=v.camera_to_world.tolist()) for v in scene.views]
    # Each photo saw the points in front of it.
    place = scene.points.xyz[:, 0]
    view, point = np.nonzero(np.abs(np.linspace(-5, 5, 12)[:, None] - place[None]) < 1.2)
    save_poses(tmp_path, Poses(cameras=[CAMERA], images=images), scene.points, (view, point))
    plan = cut(load_scene(tmp_path, 4), 2)
    save_plan(tmp_path, plan)
    assert load_plan(tmp_path) == plan
    folder = write_block(tmp_path, plan, plan.blocks[0], 4)
    own = load_scene(folder)
    assert [v.name for v in own.views] == plan.blocks[0].images
    assert all(v.image.read_bytes() == v.name.encode() for v in own.views)
    held_out = {load_scene(tmp_path, 4).views[i].name for i in load_scene(tmp_path, 4).test}
    assert {own.views[i].name for i in own.test} == held_out & set(plan.blocks[0].images)
    assert own.bounds is not None
    np.testing.assert_allclose(own.bounds, plan.region(plan.blocks[0]))
    assert 0 < len(load_points(folder)) < len(scene.points)
    for name, seen in load_visibility(folder).items():
        np.testing.assert_allclose(
            np.sort(load_points(folder).xyz[seen], axis=0),
            np.sort(scene.points.xyz[load_visibility(tmp_path)[name]], axis=0),
        )
    # Written again it is the same project, with what was done to it.
    before = load_project(folder).uuid
    write_block(tmp_path, plan, plan.blocks[0], 4)
    assert load_project(folder).uuid == before
    (tmp_path / "blocks/plan.json").write_text("{}")
    with pytest.raises(ProjectError, match="damaged"):
        load_plan(tmp_path)


def test_a_surface_keeps_what_its_triangles_have() -> None:
    vertices = np.arange(15.0).reshape(5, 3) / 10
    surface = replace(classed(vertices, np.array([[0, 1, 2], [1, 2, 4], [2, 3, 4]])), face_instance=np.array([5, 6, 7]))
    kept = with_faces(surface, np.array([False, True, False]))
    for name in ("vertices", "normals", "colors", "class_id"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(surface, name)[[1, 2, 4]])
    np.testing.assert_array_equal(kept.faces, [[0, 1, 2]])
    assert (kept.face_class[0], kept.face_instance) == (surface.face_class[1], [6])
    assert with_faces(replace(surface, face_instance=None), np.ones(3, bool)).face_instance is None


def test_a_part_that_is_missing_or_damaged_is_told(tmp_path: Path) -> None:
    block = two_blocks().blocks[0]
    with pytest.raises(ProjectError, match="missing"):
        load_part(tmp_path, block)
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    part = Part(classed(vertices, faces), np.array([[0, 0.1]]), 0.02)
    path = tmp_path / "blocks/1/runs/main/part.npz"
    save_part(path, part)
    stored = load_part(tmp_path, block)
    assert (stored.voxel, stored.seams.tolist()) == (0.02, [[0, 0.1]])
    np.testing.assert_array_equal(stored.surface.vertices, part.surface.vertices)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ProjectError, match="damaged"):
        load_part(tmp_path, block)
