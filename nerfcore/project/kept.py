"""What is kept of a project whose photos are read, or whose cameras are placed, once more: labels, masks, classes, the
world."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..errors import ProjectError
from ..geometry.similarity import fit_similarity, similarity_scale, transform_points
from ..progress import Reporter
from .schema import Frame, ImageRecord, Poses, Project, ProvenanceStep, SemanticClass
from .store import load_poses, world_from_sfm

BESIDE = "from_project"  # in results of `new` and `import`: where the photos or the data set lie, seen from the project
LEAST_CAMERAS = 3
# Not tuned. Beyond these the cameras are not the same ones any more: share of their spread, cosine of 5°.
FARTHEST_OFF, LEAST_COSINE = 0.05, 0.996
KEPT, STEPS = 0.7, 10  # share of the cameras that a motion goes by: the others may have been placed wrongly; steps
ARM = 0.1  # of the cameras' spread: how far out their axes are compared, which count little beside the centres


def same_place(before: str, now: Path) -> bool:
    """Whether a path of a project's provenance is that of a file or folder.

    Earlier versions noted paths as they were typed, which say nothing of the folder that they were typed in.
    """
    was, now = Path(before), Path(now)
    return was.resolve() == now.resolve() or (not was.is_absolute() and was == now)


def same_source(made: ProvenanceStep, setting: str, now: Path, project: Path) -> bool:
    """Whether a step of a project was made of this file or folder, which may have been moved along with the project."""
    was, beside = str(made.settings.get(setting)), made.result.get(BESIDE)
    if same_place(was, now):
        return True
    return bool(beside) and not Path(was).exists() and (project / str(beside)).resolve() == Path(now).resolve()


def from_project(place: Path, project: Path) -> str | None:
    """A file or folder as seen from the project's folder; None where it is on another drive."""
    try:
        return Path(os.path.relpath(place, project)).as_posix()
    except ValueError:
        return None


def keep_later_labels(records: Sequence[ImageRecord], before: Sequence[ImageRecord], folder: Path) -> list[ImageRecord]:
    """Give unchanged photos without a label map the one that was imported or made since; which photos got one.

    Maps that came with the photos, which are called `labels/<name>.png`, come anew with them or not.
    """
    labelled = {
        (r.sha256, r.width, r.height): r
        for r in before
        if r.label and r.label != f"labels/{r.name}.png" and (folder / r.label).is_file()
    }
    given = []
    for record in records:
        earlier = labelled.get((record.sha256, record.width, record.height))
        if record.label is None and record.status != "rejected" and earlier is not None:
            record.label, record.instances = earlier.label, earlier.instances
            record.confidence = earlier.confidence
            record.depth = record.depth or earlier.depth
            given.append(record)
    return given


def resized_labels(records: Sequence[ImageRecord], before: Sequence[ImageRecord]) -> list[str]:
    """Names of photos without a label map whose later one is of the same photo at another size, and so was not kept."""
    sizes = {r.sha256: (r.width, r.height) for r in before if r.label and r.label != f"labels/{r.name}.png"}
    return [
        r.name for r in records if r.label is None and sizes.get(r.sha256, (r.width, r.height)) != (r.width, r.height)
    ]


def earlier_cut_outs(project: Project | None) -> list[ImageRecord]:
    """Photos whose masks Fieldwork made itself when it read them the last time; somebody may have edited these since."""
    steps = reversed(project.provenance) if project else ()
    read = next((s for s in steps if s.verb in ("new", "import") and not s.settings.get("add")), None)
    return project.images if project and read and read.result.get("cut_out") else []


def with_earlier_names(
    names: dict[int, str], before: Sequence[SemanticClass], present: Iterable[int]
) -> dict[int, str]:
    """Names of classes by id, with those that the ids `present` had before and that are not taken."""
    known = {c.id: c.name for c in before}
    earlier = {i: known[i] for i in present if i in known and known[i] not in names.values()}
    return {**earlier, **names}


def with_earlier_classes(classes: Sequence[SemanticClass], before: Sequence[SemanticClass]) -> list[SemanticClass]:
    """Classes as they were before, with those that are new."""
    ids = {c.id: c for c in classes} | {c.id: c for c in before}
    return [ids[i] for i in sorted(ids)]


def earlier_poses(folder: Path) -> Poses | None:
    """The poses of a project; None where there are none that can be read."""
    try:
        return load_poses(folder)
    except ProjectError:
        return None


def keep_world(
    project: Project, before: Poses | None, after: Poses, fresh: Frame, report: Reporter
) -> tuple[Frame, bool]:
    """The frame for cameras that were placed anew, and whether it is the one that was set by hand.

    That one is moved with the cameras, so that the coordinates of the world stay what they were. Where nothing was set, or
    the cameras do not say how they moved, it is `fresh`; the latter is told. Marks on the surface go with the cameras.
    """
    motion, why = motion_of(after, before) if before is not None else (None, "the earlier poses cannot be read")
    marks = np.array(project.frame.marks_from_sfm) @ (np.eye(4) if motion is None else motion)
    fresh = fresh.model_copy(update={"marks_from_sfm": marks.tolist()})
    if not set_by_hand(project, fresh):
        return fresh, False
    if motion is None:
        report.warn(
            f"Up direction, scale and region were reset, because {why}. Set them again with `fieldwork align` and "
            "`fieldwork region`."
        )
        return fresh, False
    moved = {"world_from_sfm": (world_from_sfm(project) @ motion).tolist(), "marks_from_sfm": marks.tolist()}
    return project.frame.model_copy(update=moved), True


def set_by_hand(project: Project, fresh: Frame) -> bool:
    """Whether somebody aligned the present world or chose a region; `fresh`: the frame that comes with the cameras."""
    if project.frame.bounds != fresh.bounds:
        return True
    for step in reversed(project.provenance):
        if step.verb == "align":
            return True
        if step.verb in ("poses", "import") and step.result.get("world_kept") is False:
            return False
    return False


def motion_of(after: Poses, before: Poses) -> tuple[np.ndarray | None, str]:
    """The similarity (4, 4) from the frame of poses to that of earlier ones of the same photos, or why there is none.

    A few cameras that only one of the two placed wrongly do not count (trimmed least squares).
    """
    if placed_alike(after, before):
        return np.eye(4), ""
    old = {image.name: np.array(image.camera_to_world) for image in before.images}
    new = {image.name: np.array(image.camera_to_world) for image in after.images if image.name in old}
    if len(new) < LEAST_CAMERAS:
        return None, f"only {len(new)} photos have a pose as before"
    source, target = np.stack(list(new.values())), np.stack([old[name] for name in new])
    size = _spread(target)
    if size < 1e-9 or _spread(source) < 1e-9:
        return None, "all cameras are at one place"
    here, there = _marked(source), _marked(target)
    kept = np.arange(len(here))
    for _ in range(STEPS):
        motion = fit_similarity(here[kept].reshape(-1, 3), there[kept].reshape(-1, 3))
        off = np.linalg.norm(transform_points(motion, source[:, :3, 3]) - target[:, :3, 3], axis=1)
        kept = np.argsort(off)[: max(LEAST_CAMERAS, round(KEPT * len(off)))]
    turned = motion[:3, :3] / similarity_scale(motion) @ source[:, :3, :3]
    cosine = np.einsum("nij,nij->n", turned, target[:, :3, :3]) / 2 - 0.5
    if np.median(off) > FARTHEST_OFF * size or np.median(cosine) < LEAST_COSINE:
        return None, "the cameras stand to each other in another way than before"
    return motion, ""


def _spread(poses: np.ndarray) -> float:
    """How far the centres of most poses (N, 4, 4) are from their middle."""
    centres = poses[:, :3, 3]
    return float(np.median(np.linalg.norm(centres - np.median(centres, 0), axis=1)))


def _marked(poses: np.ndarray) -> np.ndarray:
    """Four points (N, 4, 3) of each pose: its centre, and one on each axis, which say how a line of cameras is turned."""
    centres, axes = poses[:, None, :3, 3], poses[:, :3, :3].transpose(0, 2, 1)
    return np.concatenate([centres, centres + ARM * _spread(poses) * axes], 1)


def placed_alike(a: Poses, b: Poses) -> bool:
    """Whether two sets of poses place the same photos with the same lenses at the same places."""
    return a.cameras == b.cameras and [(i.name, i.camera, i.camera_to_world) for i in a.images] == [
        (i.name, i.camera, i.camera_to_world) for i in b.images
    ]
