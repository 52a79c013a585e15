"""A thing whose two sides look alike, filmed all around."""

from __future__ import annotations

import json
import zlib  # noqa: F401  (must be loaded before pycolmap)
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.poses import chain, features
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.tests.nerfcore.support.captures import ingest, poses

FRAMES, POINTS, WIDTH, HEIGHT, FOCAL = 36, 200, 640, 480, 800.0


class Quiet:
    def stage(self, name: str) -> None: ...

    def progress(self, fraction: float, message: str = "") -> None: ...


def can_database(folder: Path) -> tuple[Path, list[str]]:
    """A database of exact matches of a can with the same label twice, filmed once around.

    Point k and point k + POINTS are the same spot of the two labels. Frames up to 100° apart match where they see the
    same side; those further apart match the wrong label.
    """
    random = np.random.default_rng(0)
    angle, height = random.uniform(0, np.pi, POINTS), random.uniform(-0.5, 0.5, POINTS)
    angle, height = np.concatenate([angle, angle + np.pi]), np.tile(height, 2)
    radius = 0.4 + 0.05 * np.sin(5 * height)
    xyz = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)
    outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    names = [f"can_{i:03d}.png" for i in range(FRAMES)]
    path = folder / "features.db"
    seen, keypoints = [], []
    for i in range(FRAMES):
        turn = 2 * np.pi * i / FRAMES
        place = np.array([2 * np.cos(turn), 2 * np.sin(turn), 0.8 + 0.2 * np.sin(3 * turn)])
        camera = look_at(place, np.zeros(3))
        visible = np.flatnonzero((outward * (place - xyz)).sum(1) > 0.3)
        local = (xyz[visible] - place) @ camera[:3, :3]
        pixel = FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        seen.append({point: number for number, point in enumerate(visible.tolist())})
        keypoints.append(pixel + random.normal(0, 0.3, pixel.shape))
    with features.database(path) as db:
        model = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[750, 320, 240, 0])
        camera_id = db.write_camera(model)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        rig_id = db.write_rig(rig)
        ids = []
        for name, values in zip(names, keypoints):
            image = pycolmap.Image(name=name, camera_id=camera_id)
            ids.append(db.write_image(image))
            image.image_id = ids[-1]
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            db.write_frame(frame)
            db.write_keypoints(ids[-1], values.astype(np.float32))
        for i in range(FRAMES):
            for j in range(i + 1, FRAMES):
                write_pair(db, (ids[i], ids[j]), (seen[i], seen[j]), min(j - i, FRAMES - j + i) * 360 / FRAMES > 100)
    return path, names


def write_pair(db: object, pair: tuple[int, int], seen: tuple[dict[int, int], dict[int, int]], wrong: bool) -> None:
    shift = POINTS if wrong else 0
    matches = [
        (a, seen[1][(p + shift) % (2 * POINTS)]) for p, a in seen[0].items() if (p + shift) % (2 * POINTS) in seen[1]
    ]
    if len(matches) < 15:
        return
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    geometry.inlier_matches = np.array(matches, np.uint32)
    db.write_matches(*pair, np.array(matches, np.uint32))
    db.write_two_view_geometry(*pair, geometry)


def matched(path: Path) -> dict[tuple[int, int], int]:
    """Number of matches by places of the frames, of every pair that would not be matched again."""
    with features.database(path) as db:
        ids = {int(image.name[4:7]): image.image_id for image in db.read_all_images()}
        pairs = [(a, b) for a in ids for b in ids if a < b and db.exists_two_view_geometry(ids[a], ids[b])]
        return {(a, b): len(db.read_two_view_geometry(ids[a], ids[b]).inlier_matches) for a, b in pairs}


def test_matches_between_alike_sides_are_taken_out(tmp_path: Path) -> None:
    path, names = can_database(tmp_path)
    before = matched(path)
    work = tmp_path / "work"
    found = chain.follow(path, tmp_path, work, names, Quiet())
    assert matched(path) == before  # the database itself was not touched
    assert [len(stretch) for stretch in found.rotations] == [FRAMES]
    count = chain.tell_apart(path, tmp_path, work, names, Quiet())
    after = matched(path)
    assert set(after) == set(before)
    apart = {pair: min(pair[1] - pair[0], FRAMES - pair[1] + pair[0]) * 360 / FRAMES for pair in before}
    wrong = {pair for pair, degrees in apart.items() if degrees > 100}
    assert len(wrong) > 100
    assert {pair for pair in after if after[pair] == 0} == wrong
    assert count == len(wrong)
    # Once more: the chain is remembered, and nothing is left to take out.
    again = chain.follow(path, tmp_path, work, names, Quiet())
    assert all(np.allclose(again.rotations[0][name], found.rotations[0][name]) for name in names)
    assert chain.reject_contradicting(path, again, names) == 0
    assert chain.tell_apart(path, tmp_path, work, names, Quiet()) == count


def test_angle_between_rotations() -> None:
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert chain.angle_between(quarter, np.eye(3)) == pytest.approx(90)
    assert chain.angle_between(quarter @ quarter, np.eye(3)) == pytest.approx(180)
    assert chain.angle_between(quarter, quarter) == pytest.approx(0, abs=1e-5)


@pytest.mark.slow
def test_video_around_a_can(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """The camera goes around one and a half times; the can's label is on it twice."""
    project = ingest(shared_data("can_video") / "can.mp4", tmp_path / "p")
    result = poses(project, "standard")
    assert result["registered"] >= 79
    report = json.loads((project / "poses" / "report.json").read_text())
    assert report["contradicting_pairs"] > 100
    assert result["verdict"]["level"] == "good"
    assert min(image["agreement"] for image in report["images"] if image["status"] == "ok") > 0.8
    centres = np.stack([view.camera_to_world[:3, 3] for view in load_scene(project).views])
    assert np.ptp(np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))) > np.radians(500)
