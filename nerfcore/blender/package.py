"""The package: what Blender needs of a capture, readable with numpy and JSON alone.

package.json        name and UUID of the project, classes, cameras (camera-to-world in the world frame, OpenGL axes);
                    instances, their relations and measures of the mesh, empty where there are none; the revision of the
                    marks that its classes are from, or null
renders/            rendered photos, without lens distortion too, where there are any
images/             the photos without lens distortion, in the size of their camera
points.npz          xyz (N, 3) float32 world, rgb (N, 3) uint8 sRGB
lenses.json         which lens each photo was undistorted for
mesh.npz            only when there is a mesh: vertices, faces, normals, colors, class_id, face_class, face_instance,
                    confidence of the vertices, unseen where there are such faces
texture-….png       the texture of the mesh, named by its content; some of earlier meshes
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ..data.load import load_scene
from ..data.scene import Scene, View
from ..errors import InputError, ProjectError
from ..files import UNREADABLE_ARRAYS, atomic_path, disk_errors, file_hash, write_json
from ..geometry.cameras import Camera, flip_camera_axes, pixel_centers, project, rays
from ..images.encode import write_picture
from ..images.picture import Picture, as_float, associated, to_srgb8
from ..images.working import read_picture, shows_transparency
from ..params import PackageParams
from ..progress import Reporter
from ..project.fingerprints import moved, read_made
from ..project.label_revision import LABEL_REVISION
from ..project.runs import (
    CHECKPOINT,
    INSTANCES,
    MEASURES,
    MESH_RECORD,
    RENDER_RECORD,
    SCENE_GRAPH,
    checkpoint_id,
    checkpoint_state,
    holdout_of,
    run_folder,
    state_id,
)
from ..project.store import is_project, load_project

FORMAT, VERSION = "fieldwork-package", 1
MESH_ARRAYS = ("vertices", "faces", "colors", "class_id", "face_class")
OLD_TEXTURES = 3  # kept for scenes that show an earlier mesh


def package_folder(project: Path, run: str) -> Path:
    return project / "exports" / run / "package"


def write_package(
    project: Path, run: str, scene: Scene, name: str, report: Reporter, renders: Path | None = None
) -> Path:
    """Write the package of a run; photos that are already there and newer than their source are kept.

    Args:
        project: the project's folder; the mesh is read from exports/<run>/mesh.npz there, if it exists.
        scene: its views and points in the world frame.
        name: what Blender calls it.
        renders: folder of pictures rendered from the photos' cameras, named like the photos; None: where Blender's panel
            puts them.
    Returns:
        the folder.
    Raises:
        InputError: a photo is missing or unreadable.
        ProjectError: the mesh file is damaged.
    """
    folder = package_folder(project, run)
    with disk_errors(folder):
        (folder / "images").mkdir(parents=True, exist_ok=True)
    report.stage("Undistorting the photos")
    cameras = _write_pictures(scene, folder, photo_renders(project, run, renders), report)
    _remove_others(folder, cameras)
    points = scene.points
    with atomic_path(folder / "points.npz") as temporary, open(temporary, "wb") as out:
        np.savez_compressed(out, xyz=points.xyz.astype(np.float32), rgb=points.rgb.astype(np.uint8))
    source = project / "exports" / run
    made = read_made(source / MESH_RECORD)
    has_mesh = _copy_mesh(source / "mesh.npz", folder / "mesh.npz")
    texture = _copy_texture(source / "texture.png", folder) if has_mesh else None
    write_json(
        folder / "package.json",
        {
            "format": FORMAT,
            "version": VERSION,
            "name": name,
            "uuid": load_project(project).uuid if is_project(project) else "",
            "run": run,
            "frame": "world",
            "ignore_id": scene.ignore_id,
            "classes": [{"id": c.id, "name": c.name, "color": list(c.color)} for c in scene.classes],
            "cameras": cameras,
            "mesh": has_mesh,
            "texture": texture,
            "instances": _beside(source / INSTANCES, []) if has_mesh else [],
            "relations": _relations(source) if has_mesh else [],
            "measures": _beside(source / MEASURES, {}) if has_mesh else {},
            LABEL_REVISION: made.result.get(LABEL_REVISION) if has_mesh and made else None,
            "checkpoint": checkpoint_id(project, run),
            "mesh_checkpoint": made.checkpoint if has_mesh and made else "",
        },
    )
    return folder


def photo_renders(project: Path, run: str, renders: Path | None) -> Path:
    """The folder of renders from the photos' cameras: the one given, else where Blender's panel puts those of a run; earlier
    versions put those of all runs into one."""
    own, common = (project / "exports" / place / "photos" for place in (f"{run}/renders", "renders"))
    return renders or (common if common.is_dir() and not own.is_dir() else own)


def stale(project: Path, run: str, renders: Path | None = None, pictures: bool = True) -> list[str]:
    """Warnings about what would be delivered of a run but was made from an earlier training of it, or lies elsewhere."""
    folder, state = project / "exports" / run, checkpoint_state(run_folder(project, run) / CHECKPOINT)
    notes = []
    if (folder / "mesh.npz").is_file():
        made = read_made(folder / MESH_RECORD)
        # Without a record it is of a version that wrote none; so may the field be.
        trained = state is not None and (made.checkpoint != state_id(state) if made else bool(state.get("training")))
        if made is not None and moved(made, load_project(project)):
            notes.append(
                f"The project was aligned anew since the mesh of the run “{run}” was made: it lies elsewhere, or is of "
                "another size. Run `fieldwork mesh` again."
            )
        elif trained:
            notes.append(f"The mesh is from an earlier training of the run “{run}”. Run `fieldwork mesh` again.")
    shown = read_made(photo_renders(project, run, renders) / RENDER_RECORD) if pictures else None
    if shown is not None and shown.settings.get("run") != run:
        notes.append(f"The renders of the photos are of the run “{shown.settings.get('run')}”, not of “{run}”.")
    elif shown is not None and state is not None and shown.checkpoint != state_id(state):
        notes.append(f"The renders of the photos are from an earlier training of the run “{run}”. Render them again.")
    return notes


def camera_entry(view: View, image: str, split: str) -> dict[str, Any]:
    """One camera of package.json: pinhole in pixels, or a panorama; `camera_to_world` has OpenGL axes."""
    camera = view.camera
    return {
        "name": view.name,
        "model": "EQUIRECTANGULAR" if camera.model == "EQUIRECTANGULAR" else "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "camera_to_world": flip_camera_axes(view.camera_to_world).tolist(),
        "image": image,
        "split": split,
    }


def undistortion_grid(camera: Camera) -> torch.Tensor:
    """Where each pixel of the distortion-free picture lies in the photo: (1, H, W, 2) in torch's −1 … 1.

    The distortion-free camera has the same size, focal lengths and principal point. Pixels that the lens never
    imaged lie outside.
    """
    directions, _ = rays(camera.undistorted(), pixel_centers(camera.width, camera.height).reshape(-1, 2))
    found = project(camera, directions)
    inside = np.isfinite(found).all(-1)
    # Beyond the angle where the lens polynomial turns back, a projection is a mirage: it must lead back to its ray.
    back, valid = rays(camera, np.where(inside[:, None], found, 0))
    inside &= valid & ((back * directions).sum(-1) > 1 - 1e-6)
    grid = np.where(inside[:, None], found / [camera.width, camera.height] * 2 - 1, 9.0)
    return torch.from_numpy(grid.astype(np.float32)).reshape(1, camera.height, camera.width, 2)


def undistort(picture: Picture, grid: torch.Tensor) -> Picture:
    """A picture resampled along `undistortion_grid` as 8-bit sRGB; black, or empty, where the lens saw nothing."""
    weighed = as_float(associated(picture))  # as filters must see them
    photo = torch.from_numpy(np.array(weighed.pixels)).permute(2, 0, 1)[None]
    out = torch.nn.functional.grid_sample(photo, grid, mode="bicubic", padding_mode="zeros", align_corners=False)
    return to_srgb8(replace(weighed, pixels=out[0].permute(1, 2, 0).numpy()))


def _write_pictures(scene: Scene, folder: Path, renders: Path, report: Reporter) -> list[dict[str, Any]]:
    """Write the photos without lens distortion, the renders beside them and lenses.json; the cameras of package.json."""
    cameras = []
    grids: dict[str, torch.Tensor] = {}
    lenses = _lenses(folder)
    test = set(scene.test)
    for index, view in enumerate(scene.views):
        report.progress(index / len(scene.views), view.name)
        file = _write_photo(view, folder, grids, lenses)
        entry = camera_entry(view, f"images/{file.name}", "test" if index in test else "train")
        render = _write_render(view, folder, renders, grids)
        cameras.append(entry | ({"render": f"renders/{render.name}"} if render else {}))
    write_json(folder / "lenses.json", lenses)
    return cameras


def _remove_others(folder: Path, cameras: list[dict[str, Any]]) -> None:
    """Delete the pictures of an earlier package that no camera of this one names."""
    for part, key in (("images", "image"), ("renders", "render")):
        kept = {Path(camera[key]).name for camera in cameras if key in camera}
        for other in (folder / part).glob("*"):
            if other.name not in kept:
                other.unlink()


def _write_photo(view: View, folder: Path, grids: dict[str, torch.Tensor], lenses: dict[str, str]) -> Path:
    camera = view.camera
    plain = camera.model in {"PINHOLE", "EQUIRECTANGULAR"} or (not any(camera.distortion) and camera.model == "OPENCV")
    suffix = view.image.suffix.lower()
    keep = plain and suffix in {".jpg", ".jpeg", ".png"}
    name = view.name.replace("/", "_")
    if not view.image.is_file():
        raise InputError(f"The photo {view.image} is missing.", "Restore it, or make the project again.")
    # JPEG has no alpha.
    made = ".png" if not keep and suffix not in {".jpg", ".jpeg"} and shows_transparency(view.image) else ".jpg"
    target = folder / "images" / (name + (suffix if keep else made))
    key = json.dumps(camera.model_dump(mode="json"))
    if target.is_file() and target.stat().st_mtime >= view.image.stat().st_mtime and lenses.get(view.name) == key:
        return target
    lenses[view.name] = key
    with atomic_path(target) as temporary:
        if keep:
            shutil.copyfile(view.image, temporary)
        else:
            if not plain and key not in grids:
                grids[key] = undistortion_grid(camera)
            _develop(view, temporary, None if plain else grids[key])
    return target


def _write_render(view: View, folder: Path, renders: Path, grids: dict[str, torch.Tensor]) -> Path | None:
    """The rendered picture of a photo, straightened as the photo is; None when there is none."""
    source = renders / f"{view.name}.png"
    if not source.is_file():
        return None
    picture = read_picture(source)
    camera = view.camera.resized(*picture.size)
    if any(camera.distortion) or camera.model not in {"PINHOLE", "EQUIRECTANGULAR", "OPENCV"}:
        key = json.dumps(camera.model_dump(mode="json"))
        if key not in grids:
            grids[key] = undistortion_grid(camera)
        picture = undistort(picture, grids[key])
    target = folder / "renders" / (view.name.replace("/", "_") + ".png")
    target.parent.mkdir(exist_ok=True)
    with atomic_path(target) as temporary:
        write_picture(temporary, picture)
    return target


def _lenses(folder: Path) -> dict[str, str]:
    """The lens each photo of the package was undistorted for: it may have been estimated anew since."""
    try:
        value = json.loads((folder / "lenses.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _develop(view: View, target: Path, grid: torch.Tensor | None) -> None:
    picture = read_picture(view.image)
    if grid is not None:
        picture = undistort(picture, grid)
    if target.suffix == ".png":
        write_picture(target, picture)
    else:
        color = np.ascontiguousarray(picture.pixels[..., :3])
        Image.fromarray(color).save(target, "JPEG", quality=92, subsampling=0)


def _copy_mesh(source: Path, target: Path) -> bool:
    """Copy the mesh into the package; false when there is none yet."""
    if not source.is_file():
        target.unlink(missing_ok=True)
        return False
    try:
        with np.load(source, allow_pickle=False) as data:
            missing = [name for name in MESH_ARRAYS if name not in data]
    except UNREADABLE_ARRAYS as error:
        raise ProjectError(f"{source} is damaged: {error}.", "Run `fieldwork mesh` again.") from error
    if missing:
        raise ProjectError(f"{source} lacks {', '.join(missing)}.", "Run `fieldwork mesh` again.")
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
    return True


def _beside(path: Path, missing: Any) -> Any:
    """The JSON value of a file that stands beside the mesh; `missing` where there is none."""
    if not path.is_file():
        return missing
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork mesh` again.") from error


def _relations(source: Path) -> list[dict[str, Any]]:
    """How the instances of a mesh stand to each other; none where nobody looked since they were found or renamed."""
    graph, known = _beside(source / SCENE_GRAPH, {}), _beside(source / INSTANCES, [])
    names = {entry["id"]: entry["name"] for entry in known}
    same = all(names.get(thing["id"]) == thing["name"] for thing in graph.get("things", []))
    return graph.get("relations", []) if same else []


def _copy_texture(source: Path, folder: Path) -> str | None:
    """Copy the texture of the packaged mesh; the copy's name, None when the mesh has no UVs."""
    with np.load(folder / "mesh.npz", allow_pickle=False) as data:
        wanted = "uv" in data and source.is_file()
    if not wanted:
        return None
    target = folder / f"texture-{file_hash(source)[:8]}.png"
    if not target.is_file():
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
    others = [path for path in folder.glob("texture*.png") if path != target]
    for path in sorted(others, key=lambda path: path.stat().st_mtime)[:-OLD_TEXTURES]:
        path.unlink()
    return target.name


def package(params: PackageParams, report: Reporter) -> dict[str, Any]:
    """Prepare the package of a project (see above).

    Returns:
        {"folder", "cameras": count, "points": count, "mesh": whether there is one}
    Raises:
        ProjectError: there are no poses.
        InputError: a photo is missing.
    """
    folder = params.project.absolute()
    scene = load_scene(folder, holdout_of(folder, params.run))
    for warning in stale(folder, params.run, params.renders):
        report.warn(warning)
    target = write_package(folder, params.run, scene, folder.name, report, params.renders)
    return {
        "folder": str(target),
        "cameras": len(scene.views),
        "points": len(scene.points),
        "mesh": (target / "mesh.npz").is_file(),
    }
