"""The tiny captures that cases work on, and whether a project is whole afterwards."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
from fieldwork.nerfcore.errors import FieldworkError
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes
from fieldwork.nerfcore.mesh.stored import MESH, mesh_folder
from fieldwork.nerfcore.project.lock import project_lock
from fieldwork.nerfcore.project.store import POSES_FILE, load_points, load_poses, load_project
from fieldwork.nerfcore.render.run import load_trained
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project, camera_poses, draw
from fieldwork.tests.nerfcore.support.flat import LENS, on_plane, ring
from fieldwork.tests.nerfcore.support.photos import picture
from PIL import Image

from .draw import fresh
from .engine import Engine

STEPS = 160  # of training, after which the ball has a surface
TRAINING = {"preset": "draft", "steps": STEPS, "set": SMALL}
LETTING_GO = 1.0  # seconds
MESHING = {"resolution": 32}


class Scene:
    """Folders to copy from: `trained` a project with a run and a mesh, `posed` without; `photos`, `wall` and `dataset` as
    users have them."""

    def __init__(self, folder: Path, train: bool = True) -> None:
        self.folder = folder
        self.engine = Engine(folder)
        self.posed = ball_project(folder / "posed", views=8, side=36, points=60)
        self.trained = Path(shutil.copytree(self.posed, folder / "trained"))
        self.photos = _photos(folder / "photos")
        self.wall = _wall(folder / "wall")
        self.dataset = _dataset(folder / "dataset")
        if train:
            for verb, values in (("train", TRAINING), ("mesh", MESHING)):
                reply = self.engine.ask(verb, project=self.trained, **values)
                if reply.code:
                    raise AssertionError(f"{verb} of the undamaged scene fails: {reply.message}")

    def copy(self, source: Path) -> Path:
        """A copy to work on; the copy of the case before is removed."""
        return Path(shutil.copytree(source, fresh(self.folder / "case" / source.name), symlinks=True))

    def empty(self, name: str) -> Path:
        return fresh(self.folder / "case" / name)


def _photos(folder: Path) -> Path:
    (folder / "labels").mkdir(parents=True)
    for i in range(4):
        picture(i, (160, 120)).save(folder / f"p{i}.jpg", quality=92)
        Image.fromarray(np.full((120, 160), 1 + i % 2, np.uint8)).save(folder / "labels" / f"p{i}.png")
    return folder


def _wall(folder: Path) -> Path:
    """Photos that poses can be estimated of: boards before a wall, all of them painted."""
    folder.mkdir()
    boards = [(-0.5, -0.3, 0.25, 0.5), (0.45, 0.35, 0.22, 0.8), (0.1, -0.5, 0.2, 0.3)]  # x, y, half side, from the wall
    for i, pose in enumerate(ring(8, radius=0.35)):
        color = tiles(on_plane(LENS, pose)[0][:, :2])
        for x, y, half, away in boards:
            place = on_plane(LENS, pose, away)[0][:, :2] - [x, y]
            hit = np.abs(place).max(1) < half
            color[hit] = tiles(place[hit] + 7 * away)
        pixels = (255 * color + 0.5).astype(np.uint8).reshape(LENS.height, LENS.width, 3)
        Image.fromarray(pixels).save(folder / f"w{i}.jpg", quality=95)
    return folder


def tiles(xy: np.ndarray) -> np.ndarray:
    """sRGB (N, 3) in [0, 1] of a wall of tiles at (N, 2), each of a colour of its own."""
    table = np.random.default_rng(0).uniform(0.05, 0.95, (128, 128, 3))
    x, y = (np.floor(9 * xy).astype(int) % 128).T
    return table[x, y]


def _dataset(folder: Path) -> Path:
    """The ball as a transforms.json."""
    (folder / "images").mkdir(parents=True)
    side = 48
    camera = Camera(width=side, height=side, fx=66, fy=66, cx=24, cy=24)
    frames = []
    for i, pose in enumerate(camera_poses(5)):
        Image.fromarray(draw(camera, pose)[0]).save(folder / "images" / f"v{i}.png")
        frames.append({"file_path": f"images/v{i}.png", "transform_matrix": flip_camera_axes(pose).tolist()})
    lens = {"fl_x": 66.0, "fl_y": 66.0, "cx": 24.0, "cy": 24.0, "w": side, "h": side, "k1": 0.0, "k2": 0.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def content(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a folder, by path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def lost(project: Path, before: dict[str, str], but: str = "") -> str:
    """What of a project is lost: "" where all of it is there.

    before: `content` of it when it was whole. but: a file that the case itself damaged.
    """
    try:
        load_project(project)
    except FieldworkError as error:
        return "" if but == "project.json" else f"project lost: {error.message}"
    for name in before:
        if name.startswith(("images/", "labels/", "masks/")) and name != but and not (project / name).is_file():
            return f"project lost: {name} is gone"
    parts = {POSES_FILE: load_poses, "poses/points.npz": load_points, "runs/main/field.safetensors": _load_run}
    for name, load in parts.items():
        if name in before and not but.startswith(("runs/", "poses/")) and but != name:
            try:
                load(project)
            except FieldworkError as error:
                return f"project lost: {error.message}"
    mesh = mesh_folder(project, "main") / MESH
    if str(mesh.relative_to(project)) in before and but != str(mesh.relative_to(project)):
        try:
            with np.load(mesh) as stored:
                dict(stored)
        except Exception as error:  # noqa: BLE001 - a damaged file may raise anything
            return f"project lost: {mesh}: {error}"
    return ""


def _load_run(project: Path) -> Any:
    return load_trained(project, "main")


def held(project: Path) -> str:
    """Whether somebody still holds the lock of a project, as a sentence; the answer comes a moment before it is free."""
    deadline = time.monotonic() + LETTING_GO
    while True:
        try:
            with project_lock(project, "campaign"):
                return ""
        except FieldworkError as error:
            if time.monotonic() > deadline:
                return f"the lock is still held: {error.message}"
        time.sleep(0.02)
