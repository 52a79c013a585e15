"""Folders of photos with odd files among them, to `new`: what is no whole photo is named, the others are taken."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from fieldwork.nerfcore.project.store import load_project
from hypothesis import strategies as st
from PIL import Image

from .draw import DAMAGES, MUTATIONS, damage, drawn, mutated
from .outcome import Case, Outcome, outcome
from .scene import Scene, content

AREA = "ingest"
NAMES = [
    "ü.jpg",
    " .jpg",
    "-x.jpg",
    "a\nb.jpg",
    "a'b\".jpg",
    "x.JPG",
    "con.jpg",
    "a.b.c.jpg",
    "漢字.jpg",
    "n" * 200 + ".jpg",
]
SETTINGS = {
    "max_size": [64, 0, -5, 10**9, 63.5, "big"],
    "mask_mode": ["empty", "none", ""],
    "frames": [4, 0, -1, 10**12],
    "photos": ["/nowhere", "", "/dev/null", "\x00", "/proc/self/mem"],
    "classes": ["/nowhere.json", "/etc"],
    "labels": ["/nowhere", "/dev/null"],
}

ODD = st.one_of(
    st.tuples(st.just("damage"), st.tuples(st.integers(0, 3), DAMAGES)),
    st.tuples(st.just("named"), st.sampled_from(NAMES)),
    st.tuples(st.just("mode"), st.sampled_from(["1", "L", "LA", "P", "RGBA", "CMYK", "I;16", "F"])),
    st.tuples(st.just("size"), st.sampled_from([(1, 1), (1, 400), (3000, 2), (63, 64), (31, 31)])),
    st.tuples(st.just("suffix"), st.sampled_from([".png", ".tif", ".exr", ".heic", ".npy", ".dng", ".mp4", ".webp"])),
    st.tuples(st.just("label"), st.tuples(st.sampled_from(["size", "rgb", "float", "255", "text"]), st.integers(0, 3))),
    st.tuples(st.just("label damage"), st.tuples(st.integers(0, 3), DAMAGES)),
    st.tuples(st.just("mask"), st.tuples(st.sampled_from(["black", "size", "text", "grey"]), st.integers(0, 3))),
    st.tuples(st.just("classes"), MUTATIONS),
    st.tuples(st.just("classes text"), st.text(max_size=40)),
)
SETTING = st.sampled_from([(name, value) for name, values in SETTINGS.items() for value in values])
FOLDERS = st.tuples(st.lists(ODD, min_size=1, max_size=3), st.one_of(st.none(), st.none(), SETTING))
CLASSES = '{"1": "stone", "2": {"name": "wood", "color": [0.1, 0.2, 0.3]}, "ignore": 0}'


def make_odd(photos: Path, odd: tuple[str, Any]) -> None:
    kind, value = odd
    labels, masks = photos / "labels", photos / "masks"
    if kind == "damage":
        target = photos / f"p{value[0]}.jpg"
        if target.is_file():
            damage(target, value[1])
    elif kind == "named":
        shutil.copy(photos.parent / "photos.jpg", photos / value)
    elif kind == "mode":
        with Image.open(photos.parent / "photos.jpg") as photo:
            grey = np.asarray(photo.convert("L"))
        made = {
            "I;16": lambda: Image.fromarray(grey.astype(np.uint16) * 257),
            "F": lambda: Image.fromarray(grey.astype(np.float32)),
        }
        picture = made[value]() if value in made else Image.fromarray(grey).convert("RGB").convert(value)
        picture.save(photos / f"mode{'.tif' if value in ('F', 'CMYK') else '.png'}")
    elif kind == "size":
        Image.new("RGB", value, (200, 90, 30)).save(photos / "size.png")
    elif kind == "suffix":
        shutil.copy(photos.parent / "photos.jpg", photos / f"suffix{value}")
    elif kind == "label damage":
        target = labels / f"p{value[0]}.png"
        if target.is_file():
            damage(target, value[1])
    elif kind == "label":
        make_label(labels / f"p{value[1]}.png", value[0])
    elif kind == "mask":
        masks.mkdir(exist_ok=True)
        make_mask(masks / f"p{value[1]}.png", value[0])
    elif kind == "classes":
        (labels / "classes.json").write_text(mutated(CLASSES, *value)[0])
    else:
        (labels / "classes.json").write_text(value, encoding="utf-8", errors="replace")


def make_label(path: Path, kind: str) -> None:
    if path.is_dir():
        return
    if kind == "text":
        path.write_text("no picture")
        return
    pixels = {
        "size": np.ones((20, 30), np.uint8),
        "rgb": np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8),
        "float": (np.random.default_rng(0).random((120, 160)) * 65535).astype(np.uint16),
        "255": np.full((120, 160), 255, np.uint8),
    }[kind]
    Image.fromarray(pixels).save(path)


def make_mask(path: Path, kind: str) -> None:
    if kind == "text":
        path.write_text("no picture")
        return
    values = {"black": 0, "size": 255, "grey": 127}
    Image.new("L", (30, 20) if kind == "size" else (160, 120), values[kind]).save(path)


def whole(path: Path) -> bool:
    """Whether another program reads all of a picture."""
    try:
        with Image.open(path) as image:
            image.load()
    except Exception:  # noqa: BLE001 - whatever a decoder raises
        return False
    return True


def attempt(scene: Scene, folder: tuple) -> Outcome:
    odds, setting = folder
    photos = scene.copy(scene.photos)
    shutil.copy(photos / "p0.jpg", photos.parent / "photos.jpg")
    with Image.open(photos / "p1.jpg") as picture:  # like no other photo of the folder
        picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(photos.parent / "photos.jpg")
    for odd in odds:
        make_odd(photos, odd)
    before, project = content(photos), scene.empty("made")
    values = {"photos": photos, **({setting[0]: setting[1]} if setting else {})}
    reply = scene.engine.ask("new", project=project, **values)
    if content(photos) != before:
        return outcome(reply, "the user's photos were changed")
    if reply.code:
        return outcome(reply, in_the_way(scene, project))
    return outcome(reply, silent(photos, project, reply.all_told) if values["photos"] == photos else "")


def in_the_way(scene: Scene, project: Path) -> str:
    """Whether what a failed call left of a project keeps the next one, with good photos, from making it."""
    if not project.is_dir():
        return ""
    reply = scene.engine.ask("new", project=project, photos=scene.photos)
    if reply.code:
        return f"after an error a second call fails: {reply.message}"
    return silent(scene.photos, project, reply.all_told)


def silent(photos: Path, project: Path, told: str) -> str:
    """What was taken, or left out, without a word."""
    for record in load_project(project).images:
        if record.status == "rejected":
            continue
        for name in (record.file, record.label, record.mask):
            if name and not whole(project / name):
                return f"the working copy {name} is no whole picture"
    for path in sorted(photos.glob("*.jpg")):
        if (path.is_dir() or not whole(path)) and path.name not in told:
            return f"{path.name} is no whole photo, which nothing says"
    for path in sorted((photos / "labels").glob("*.png")):
        photo = photos / f"{path.stem}.jpg"
        if photo.is_file() and whole(photo) and not whole(path) and path.name not in told:
            return f"the label map {path.name} is no whole picture, which nothing says"
    return ""


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [
        Case(AREA, repr(folder), lambda folder=folder: attempt(scene, folder)) for folder in drawn(FOLDERS, count, seed)
    ]
