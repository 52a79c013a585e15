"""Posed data sets with wrong values, to `import`: what is taken has poses and lenses that can be."""

from __future__ import annotations

import json

import numpy as np
from fieldwork.nerfcore.project.store import load_poses
from hypothesis import strategies as st

from .draw import DAMAGES, MUTATIONS, damage, drawn, mutated
from .outcome import Case, Outcome, outcome
from .scene import Scene, content

AREA = "import"
NUMBERS = ["nan", "inf", "-1", "0", "1e300", "word", "", "0.5", "9" * 30]

WRONG = st.one_of(
    st.tuples(st.just("json"), st.lists(MUTATIONS, min_size=1, max_size=3)),
    st.tuples(st.just("json"), st.lists(MUTATIONS, min_size=1, max_size=1)),
    st.tuples(st.just("file"), DAMAGES),
    st.tuples(st.just("image"), st.tuples(st.integers(0, 4), DAMAGES)),
    st.tuples(
        st.just("colmap"), st.tuples(st.sampled_from(["cameras", "images"]), st.floats(0, 1), st.sampled_from(NUMBERS))
    ),
    st.tuples(st.just("colmap file"), st.tuples(st.sampled_from(["cameras", "images", "points3D"]), DAMAGES)),
    st.tuples(st.just("nested"), st.integers(10, 100_000)),
)


def attempt(scene: Scene, wrong: tuple) -> Outcome:
    kind, value = wrong
    dataset = scene.copy(scene.dataset)
    transforms = dataset / "transforms.json"
    if kind == "json":
        text = transforms.read_text()
        for where, odd in value:
            text, _ = mutated(text, where, odd)
        transforms.write_text(text)
    elif kind == "file":
        damage(transforms, value)
    elif kind == "image":
        damage(dataset / "images" / f"v{value[0]}.png", value[1])
    elif kind == "nested":
        transforms.write_text("[" * value + "]" * value)
    else:
        colmap(dataset)
        path = dataset / "sparse" / "0" / f"{value[0]}.txt"
        if kind == "colmap":
            words = path.read_text().split(" ")
            words[min(int(value[1] * len(words)), len(words) - 1)] = value[2]
            path.write_text(" ".join(words))
        else:
            damage(path, value[1])
    before, project = content(dataset), scene.empty("imported")
    reply = scene.engine.ask("import", dataset=dataset, project=project)
    if content(dataset) != before:
        return outcome(reply, "the user's data set was changed")
    if reply.code:
        left = [path.name for path in project.iterdir()] if project.is_dir() else []
        return outcome(reply, f"an error leaves {left}" if "project.json" in left else "")
    return outcome(reply, unsound(project, reply.all_told))


def colmap(dataset) -> None:
    """The same data set as a COLMAP text model."""
    head = json.loads((dataset / "transforms.json").read_text())
    (dataset / "transforms.json").unlink()
    model = dataset / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 OPENCV 48 48 66 66 24 24 0.0 0.0 0.0 0.0\n")
    lines = []
    for i, frame in enumerate(head["frames"], 1):
        position = np.array(frame["transform_matrix"])[:3, 3]
        lines.append(f"{i} 1 0 0 0 {' '.join(f'{x:.4f}' for x in position)} 1 {frame['file_path'].split('/')[-1]}\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text(
        "".join(f"{k} {k % 3}.5 0.5 {k % 5}.5 9 9 9 0.5 1 0 2 3\n" for k in range(1, 9))
    )


def unsound(project, told: str) -> str:
    """What of the imported cameras cannot be."""
    poses = load_poses(project)
    for image in poses.images:
        turn = np.array(image.camera_to_world)[:3, :3]
        if not np.isfinite(image.camera_to_world).all():
            return f"the pose of {image.name} is not finite"
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            return f"the pose of {image.name} is no rotation"
    for camera in poses.cameras:
        values = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
        if not np.isfinite(values).all() or min(camera.fx, camera.fy) <= 0:
            return f"the lens {values} cannot be"
        if not 0.05 < camera.fx / camera.width < 100 and "lens" not in told:
            return f"a focal length of {camera.fx} for {camera.width} pixels is taken without a word"
    if len(poses.images) < 5 and not any(word in told for word in ("missing", "left out", "without", "not ", "cannot")):
        return f"only {len(poses.images)} of 5 photos were imported, without a word"
    return ""


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [Case(AREA, repr(wrong), lambda wrong=wrong: attempt(scene, wrong)) for wrong in drawn(WRONG, count, seed)]
