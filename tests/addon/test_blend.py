"""The .blend of a capture: a render through a camera must lie on that camera's photo."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.blender.blend import blend
from fieldwork.nerfcore.errors import ProjectError, SettingError
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.geometry.similarity import make_similarity, transform_points, transform_pose
from fieldwork.nerfcore.params import BlendParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Frame, ImageRecord, PosedImage, Poses, Project, SemanticClass
from fieldwork.nerfcore.project.store import load_project, save_poses, save_project
from PIL import Image
from skimage.registration import phase_cross_correlation

WIDTH, HEIGHT = 240, 160
PLAIN = Camera(width=WIDTH, height=HEIGHT, fx=220, fy=220, cx=120, cy=80)
CAMERAS = {
    "centred": PLAIN,
    "off-centre": PLAIN.model_copy(update={"cx": 97.3, "cy": 101.8}),
    "flat pixels": PLAIN.model_copy(update={"fy": 260.0, "cx": 131.0, "cy": 70.5}),
    "tall pixels": PLAIN.model_copy(update={"fy": 190.0, "cx": 110.0, "cy": 88.0}),
    "distorted": PLAIN.model_copy(update={"model": "OPENCV", "distortion": (-0.12, 0.03, 0.002, -0.003), "cx": 125.0}),
    "portrait": Camera(width=160, height=240, fx=230, fy=230, cx=84, cy=110),
}
# The world is the SfM frame turned, moved and scaled.
TURN = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
WORLD_FROM_SFM = make_similarity(2.5, TURN, np.array([0.3, -0.2, 0.1]))
CENTER, RADIUS = np.array([0.2, 0.1, 0.55]), 0.5
BACKGROUND = (64, 64, 64)  # what Blender's factory world looks like


def floor_color(x, y):
    """Colours of the floor's 0.25 m squares at x, y: (N, 3) uint8."""
    i, j = np.floor(np.asarray(x) * 4).astype(int), np.floor(np.asarray(y) * 4).astype(int)
    return np.stack([60 + 37 * (i % 5), 50 + 41 * (j % 5), 40 + 90 * ((i + j) % 2)], -1).astype(np.uint8)


def ball_color(offset):
    """Stripes of the ball by longitude, at offsets (N, 3) from its centre: (N, 3) uint8."""
    stripe = np.floor((np.arctan2(offset[..., 1], offset[..., 0]) / np.pi + 1) * 8).astype(int) % 2
    return np.where(stripe[..., None] == 0, (230, 60, 30), (30, 200, 220)).astype(np.uint8)


def photograph(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """The exact photo of floor and ball, four rays a pixel: (H, W, 3) uint8. Shares no code with Blender."""
    total = np.zeros((camera.height, camera.width, 3))
    for shift in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        pixels = pixel_centers(camera.width, camera.height).reshape(-1, 2) + shift
        direction = rays(camera, pixels)[0] @ pose[:3, :3].T
        origin = pose[:3, 3]
        color = np.tile(np.array(BACKGROUND, np.uint8), (len(pixels), 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[2] / direction[:, 2]
        hit = origin + t[:, None] * direction
        floor = (t > 0) & (np.abs(hit[:, :2]) < 1.5).all(-1)
        color[floor] = floor_color(hit[floor, 0], hit[floor, 1])
        along = -(direction * (origin - CENTER)).sum(-1)
        discriminant = along**2 - ((origin - CENTER) ** 2).sum() + RADIUS**2
        ball = discriminant > 0
        near = along[ball] - np.sqrt(discriminant[ball])
        color[ball] = ball_color(origin + near[:, None] * direction[ball] - CENTER)
        total += color.reshape(total.shape)
    return np.rint(total / 4).astype(np.uint8)


def surface() -> dict[str, np.ndarray]:
    """Floor (class 1) and ball (class 2) as the arrays of mesh.npz; every patch of colour has its own vertices."""
    vertices, faces, colors, classes = [], [], [], []

    def quad(corners, color, number):
        first = len(vertices)
        vertices.extend(corners)
        colors.extend([color] * 4)
        faces.extend([(first, first + 1, first + 2), (first, first + 2, first + 3)])
        classes.extend([number] * 2)

    for i in range(-6, 6):
        for j in range(-6, 6):
            x, y = i / 4, j / 4
            color = floor_color(x + 0.1, y + 0.1)
            quad([(x, y, 0), (x + 0.25, y, 0), (x + 0.25, y + 0.25, 0), (x, y + 0.25, 0)], color, 1)
    longitudes, latitudes = np.linspace(-np.pi, np.pi, 129), np.linspace(-np.pi / 2, np.pi / 2, 65)

    def at(a, b):
        return CENTER + RADIUS * np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])

    for a0, a1 in itertools.pairwise(longitudes):
        for b0, b1 in itertools.pairwise(latitudes):
            color = ball_color(at((a0 + a1) / 2, (b0 + b1) / 2) - CENTER)
            quad([at(a0, b0), at(a1, b0), at(a1, b1), at(a0, b1)], color, 2)
    face_class = np.array(classes, np.int32)
    class_id = np.zeros(len(vertices), np.int32)
    class_id[np.array(faces)] = face_class[:, None]
    return {
        "vertices": np.array(vertices, np.float32),
        "faces": np.array(faces, np.int32),
        "colors": np.array(colors, np.uint8),
        "class_id": class_id,
        "face_class": face_class,
        "normals": np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1)),
    }


def look(position) -> np.ndarray:
    """Camera-to-world (4, 4), OpenCV axes, at `position`, looking at the ball, a little tilted."""
    forward = CENTER - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.05, 0.02, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    pose[:3, 3] = position
    return pose


def make_project(folder: Path, cameras: list[Camera], mesh: bool = True, points: int = 200) -> None:
    (folder / "images").mkdir(parents=True)
    sfm_from_world = np.linalg.inv(WORLD_FROM_SFM)
    records, posed = [], []
    for index, camera in enumerate(cameras):
        angle = 0.7 + 0.9 * index
        pose = look(np.array([2.4 * np.cos(angle), 2.4 * np.sin(angle), 1.5]))
        name = f"view_{index}"
        Image.fromarray(photograph(camera, pose)).save(folder / f"images/{name}.png")
        records.append(ImageRecord(name=name, file=f"images/{name}.png", width=camera.width, height=camera.height))
        posed.append(PosedImage(name=name, camera=index, camera_to_world=transform_pose(sfm_from_world, pose).tolist()))
    project = Project(
        images=records,
        classes=[
            SemanticClass(id=1, name="floor", color=(0.2, 0.5, 0.9), priority=1.0),
            SemanticClass(id=2, name="ball", color=(0.9, 0.6, 0.1), priority=1.0),
        ],
        frame=Frame(world_from_sfm=WORLD_FROM_SFM.tolist(), scale_known=True),
    )
    save_project(folder, project)
    xyz = np.random.default_rng(0).uniform(-1.4, 1.4, (points, 3)) * [1, 1, 0]
    cloud = Points(transform_points(sfm_from_world, xyz), floor_color(xyz[:, 0], xyz[:, 1]), np.zeros(points))
    save_poses(folder, Poses(source="test", cameras=cameras, images=posed), cloud)
    if mesh:
        target = folder / "exports/main/mesh.npz"
        target.parent.mkdir(parents=True)
        np.savez(target, **surface())


RENDER = """
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
root = next(o for o in bpy.data.objects if o.get("fieldwork_role") == "root")
for name, value in (("photo", 0.0), ("labels", 1.0)):
    root["show_labels"] = value
    root.update_tag()
    scene.render.filepath = f"{out}/{name}.png"
    bpy.ops.render.render(write_still=True)
answer(scene.camera.name)
"""


@pytest.mark.parametrize("kind", CAMERAS)
def test_render_from_the_first_camera_lies_on_the_first_photo(kind, tmp_path, bpy_script):
    folder = tmp_path / "Kugel & Boden"
    make_project(folder, [CAMERAS[kind]] * 2)
    report = Reporter()
    result = blend(BlendParams(project=folder, out=tmp_path / "out/scene.blend"), report)
    assert report.warnings == []
    assert result["cameras"] == 2
    assert result["points"] == 200
    assert result["mesh"] == len(surface()["faces"])
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["scene.blend"]
    assert bpy_script(RENDER, blend=tmp_path / "out/scene.blend", out=tmp_path) == "view_0"

    photo = np.asarray(Image.open(next((folder / "exports/main/package/images").glob("view_0.*"))).convert("RGB"))
    render = np.asarray(Image.open(tmp_path / "photo.png").convert("RGB"))
    assert render.shape == photo.shape
    seen = (photo != 0).any(-1)  # black: outside the lens of the distorted photo
    assert seen.mean() > 0.9
    error = np.abs(render.astype(int) - photo)[seen]
    assert error.mean() < 5.0, f"mean error {error.mean():.2f} of 255"
    assert np.median(error) <= 1
    shift, *_ = phase_cross_correlation(
        np.where(seen[..., None], photo, 0).sum(-1), np.where(seen[..., None], render, 0).sum(-1), upsample_factor=20
    )
    assert np.abs(shift).max() <= 0.1, f"the render is shifted by {shift} pixels"

    labels = np.asarray(Image.open(tmp_path / "labels.png").convert("RGB")).reshape(-1, 3)
    for color in ((51, 128, 230), (230, 153, 26)):
        assert (np.abs(labels.astype(int) - color).max(-1) <= 1).mean() > 0.1


def textured(arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The same surface with its colours in a texture (16, 16, 3) instead: black vertices, UVs at texel centres."""
    colors, index = np.unique(arrays["colors"][arrays["faces"][:, 0]], axis=0, return_inverse=True)
    index = index.reshape(-1)
    texture = np.zeros((16, 16, 3), np.uint8)
    texture.reshape(-1, 3)[: len(colors)] = colors
    uv = np.stack([(index % 16 + 0.5) / 16, 1 - (index // 16 + 0.5) / 16], -1)
    return {
        **arrays,
        "colors": np.zeros_like(arrays["colors"]),
        "uv": np.repeat(uv[:, None], 3, axis=1).astype(np.float32),
    }, texture


@pytest.mark.parametrize("split", ["none", "classes"])
def test_a_textured_mesh_and_class_objects_lie_on_the_photo_too(split, tmp_path, bpy_script):
    make_project(tmp_path / "p", [CAMERAS["off-centre"]])
    arrays, texture = textured(surface())
    np.savez(tmp_path / "p/exports/main/mesh.npz", **arrays)
    Image.fromarray(texture).save(tmp_path / "p/exports/main/texture.png")
    result = blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend", split=split), Reporter())
    surfaces = [name for name in result["objects"] if name in ("Surface", "floor", "ball")]
    assert surfaces == {"none": ["Surface"], "classes": ["floor", "ball"]}[split]
    bpy_script(RENDER, blend=tmp_path / "scene.blend", out=tmp_path)
    photo = np.asarray(Image.open(tmp_path / "p/images/view_0.png")).astype(int)
    render = np.asarray(Image.open(tmp_path / "photo.png").convert("RGB"))
    error = np.abs(render - photo)
    assert error.mean() < 5
    assert np.median(error) <= 1
    labels = np.asarray(Image.open(tmp_path / "labels.png").convert("RGB")).reshape(-1, 3)
    for color in ((51, 128, 230), (230, 153, 26)):
        assert (np.abs(labels.astype(int) - color).max(-1) <= 1).mean() > 0.1


INSPECT = """
bpy.ops.wm.open_mainfile(filepath=blend)
import numpy as np
def values(attribute, name, count, width=1):
    array = np.zeros(count * width, np.float32 if width > 1 else np.int32)
    attribute.data.foreach_get(name, array)
    return array
objects = {o.get("fieldwork_role"): o for o in bpy.data.objects}
mesh, points, path = objects["mesh"].data, objects["points"].data, objects["camera path"]
slots = np.zeros(len(mesh.polygons), np.int32)
mesh.polygons.foreach_get("material_index", slots)
spots = []
for frame in (1, 2, 3):
    bpy.context.scene.frame_set(frame)
    spots.append([list(row) for row in path.matrix_world])
first = objects["camera:view_0"]
answer({
    "parents": sorted({o.parent.get("fieldwork_role") for o in bpy.data.objects if o.parent}),
    "orphans": [o.name for o in bpy.data.objects if not o.parent],
    "face_class": values(mesh.attributes["class_id"], "value", len(mesh.polygons)).tolist(),
    "domains": [mesh.attributes["class_id"].domain, mesh.color_attributes["Color"].domain],
    "slot_names": [mesh.materials[i].name for i in slots[[0, -1]]],
    "materials": len(mesh.materials),
    "colors": values(mesh.color_attributes["Color"], "color_srgb", len(mesh.vertices), 4).tolist()[:8],
    "points": len(points.vertices),
    "point_colors": len(points.color_attributes["Color"].data),
    "backgrounds": [first.data.background_images[0].image.name, first.data.show_background_images],
    "packed": all(i.packed_file is not None for i in bpy.data.images if i.source == "FILE"),
    "path": spots,
    "cameras": [[list(row) for row in objects[f"camera:view_{n}"].matrix_world] for n in range(3)],
})
"""


def test_what_the_file_holds(tmp_path, bpy_script):
    make_project(tmp_path / "p", [CAMERAS["centred"]] * 3)
    blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
    facts = bpy_script(INSPECT, blend=tmp_path / "scene.blend")
    mesh = surface()
    assert facts["parents"] == ["root"]
    assert facts["orphans"] == ["Fieldwork · p"]
    assert facts["face_class"] == mesh["face_class"].tolist()
    assert facts["domains"] == ["FACE", "POINT"]
    assert facts["slot_names"] == ["p · floor", "p · ball"]
    assert facts["materials"] == 3  # void, floor, ball
    np.testing.assert_allclose(np.array(facts["colors"][:4]) * 255, [*mesh["colors"][0], 255], atol=0.51)
    assert facts["points"] == facts["point_colors"] == 200
    assert facts["backgrounds"] == ["view_0.png", True]
    assert facts["packed"]
    np.testing.assert_allclose(facts["path"], facts["cameras"], atol=1e-5)
    assert [step.verb for step in load_project(tmp_path / "p").provenance] == ["blend"]


OPENED = """
import fieldwork
fieldwork.register()
found = {}
for name, file in files.items():
    bpy.ops.wm.open_mainfile(filepath=file)
    settings = bpy.context.scene.fieldwork
    found[name] = [settings.project, len(settings.images), settings.project_uuid]
answer(found)
"""


def test_the_file_knows_its_project_where_that_is(tmp_path, bpy_script):
    """Opened beside its project, or moved with it; not where another project is in that place."""
    make_project(tmp_path / "one/p", [CAMERAS["centred"]] * 3)
    blend(BlendParams(project=tmp_path / "one/p", out=tmp_path / "one/scene.blend"), Reporter())
    shutil.copytree(tmp_path / "one", tmp_path / "moved")
    make_project(tmp_path / "other/p", [CAMERAS["centred"]] * 2)
    (tmp_path / "alone").mkdir()
    for folder in ("other", "alone"):
        shutil.copy(tmp_path / "one/scene.blend", tmp_path / folder)
    files = {name: tmp_path / name / "scene.blend" for name in ("one", "moved", "other", "alone")}
    facts = bpy_script(OPENED, files=files)
    uuid = load_project(tmp_path / "one/p").uuid
    assert facts["one"] == facts["moved"] == ["//p", 3, uuid]
    assert facts["other"] == facts["alone"] == ["", 0, ""]


AGAIN = """
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
scene = bpy.context.scene
first = import_package(scene, read_package(package))
count = [len(bpy.data.objects), len(bpy.data.meshes), len(bpy.data.materials), len(bpy.data.cameras),
         len(bpy.data.node_groups), len(bpy.data.images), len(bpy.data.collections)]
first.root.location = (5, 0, 0)
first.meshes[0].name = "Renamed"
faces = len(first.meshes[0].data.polygons)
value = json.loads((Path(package) / "package.json").read_text())
del value["cameras"][2]
(Path(package) / "package.json").write_text(json.dumps(value))
second = import_package(scene, read_package(package))
bpy.context.view_layer.update()
answer({
    "count": count,
    "after": [len(bpy.data.objects), len(bpy.data.meshes), len(bpy.data.materials), len(bpy.data.cameras),
              len(bpy.data.node_groups), len(bpy.data.images), len(bpy.data.collections)],
    "same": first.root == second.root and first.meshes == second.meshes and second.meshes[0].name == "Renamed",
    "root": list(second.root.location),
    "moved": second.cameras[0].matrix_world.translation.x - value["cameras"][0]["camera_to_world"][0][3],
    "faces": [faces, len(second.meshes[0].data.polygons)],
    "cameras": len(second.cameras),
})
"""


def test_importing_again_updates_in_place(tmp_path, bpy_script):
    make_project(tmp_path / "p", [CAMERAS["centred"]] * 3)
    blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
    facts = bpy_script(AGAIN, package=tmp_path / "p/exports/main/package")
    before, after = facts["count"], facts["after"]
    assert after[0] == before[0] - 1, "the camera that is gone from the package is gone from the scene"
    assert after[1:3] == before[1:3]
    assert after[4:] == before[4:]
    assert facts["same"]
    assert facts["root"] == [5, 0, 0], "the user's transform of the parent is kept"
    assert facts["moved"] == pytest.approx(5, abs=1e-5), "cameras are where the package says, under the parent"
    assert facts["faces"][0] == facts["faces"][1]
    assert facts["cameras"] == 2


def test_without_a_mesh_cameras_and_points_are_written_and_it_is_said(tmp_path):
    pytest.importorskip("bpy", reason="needs the bpy package")
    make_project(tmp_path / "p", [CAMERAS["off-centre"], CAMERAS["portrait"]], mesh=False)
    result = blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
    assert result["mesh"] is None
    assert result["cameras"] == 2
    assert any("no mesh yet" in warning for warning in result["warnings"])
    assert any("differ in size" in warning for warning in result["warnings"])


def test_a_wrong_name_a_missing_pose_and_a_damaged_mesh_are_named(tmp_path):
    make_project(tmp_path / "p", [CAMERAS["centred"]])
    with pytest.raises(SettingError, match=r"\.blend"):
        blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.obj"), Reporter())
    (tmp_path / "p/exports/main/mesh.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(ProjectError, match=r"mesh\.npz is damaged"):
        blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
    (tmp_path / "p/poses/poses.json").unlink()
    with pytest.raises(ProjectError, match="no camera poses"):
        blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
    assert not (tmp_path / "scene.blend").exists()


def test_a_failing_blender_leaves_the_old_file_and_says_why(tmp_path, monkeypatch):
    make_project(tmp_path / "p", [CAMERAS["centred"]])
    (tmp_path / "scene.blend").write_bytes(b"old")
    monkeypatch.setenv("FIELDWORK_BLENDER", "/bin/false")
    from fieldwork.nerfcore.errors import BlenderError

    with pytest.raises(BlenderError, match="code 1"):
        blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
    assert (tmp_path / "scene.blend").read_bytes() == b"old"
    monkeypatch.setenv("FIELDWORK_BLENDER", "/nowhere/blender")
    with pytest.raises(BlenderError, match="not an executable"):
        blend(BlendParams(project=tmp_path / "p", out=tmp_path / "scene.blend"), Reporter())
