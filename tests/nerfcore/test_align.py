"""The world frame: up, scale, ground, north, crop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import PosesError, SettingError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.frames import on_ground, rotation_to_z, up_direction, upright
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.geometry.similarity import make_similarity, transform_points
from fieldwork.nerfcore.params import AlignParams
from fieldwork.nerfcore.poses.align import align
from fieldwork.nerfcore.poses.gps import fit_gps
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import ImageRecord, PosedImage, Poses, Project
from fieldwork.nerfcore.project.store import load_project, save_poses, save_project
from hypothesis import given, settings
from hypothesis import strategies as st


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Camera-to-world with OpenCV axes."""
    ahead = (target - center) / np.linalg.norm(target - center)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], -1)
    pose[:3, 3] = center
    return pose


def orbit(count: int = 24, height: float = 1.5, radius: float = 3.0) -> list[np.ndarray]:
    """Level cameras around the origin of a z-up world, at two heights."""
    poses = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        center = np.array([radius * np.cos(angle), radius * np.sin(angle), height * (1 if i % 2 else 0.4)])
        poses.append(look_at(center, np.zeros(3), np.array([0.0, 0, 1])))
    return poses


def random_rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def moved(poses: list[np.ndarray], motion: np.ndarray) -> list[np.ndarray]:
    scale = np.cbrt(np.linalg.det(motion[:3, :3]))
    out = []
    for pose in poses:
        new = motion @ pose
        new[:3, :3] /= scale
        out.append(new)
    return out


def subject_on_floor(seed: int = 0) -> np.ndarray:
    """A ball above a floor at z = −0.6."""
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(1500, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    floor = np.stack([*rng.uniform(-1.5, 1.5, (2, 900)), np.full(900, -0.6) + rng.normal(0, 0.002, 900)], -1)
    return np.concatenate([ball, floor])


# --- which way is up ------------------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.floats(0, 4))
def test_up_of_an_orbit(seed: int, wobble: float) -> None:
    """Any orientation of the frame, cameras held level to a few degrees."""
    rng = np.random.default_rng(seed)
    rotation = random_rotation(seed)
    poses = []
    for pose in moved(orbit(), make_similarity(1.0, rotation, rng.normal(size=3))):
        roll = np.radians(rng.normal(0, wobble))
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        poses.append(pose @ turn)
    up, confidence = up_direction(poses)
    assert up @ (rotation @ [0, 0, 1]) > np.cos(np.radians(1 + wobble))
    assert confidence > 0.8


def test_up_from_one_place_is_uncertain_but_right() -> None:
    poses = [look_at(np.zeros(3), np.array([0.0, 1, 0.1 * i]), np.array([0.0, 0, 1])) for i in range(5)]
    up, confidence = up_direction(poses)
    assert up @ [0, 0, 1] > 0.9
    assert confidence < 0.1


def test_up_of_an_object_that_was_laid_on_its_side() -> None:
    """Twenty photos of it standing, ten of it lying: standing wins, with less confidence."""
    side = make_similarity(1.0, np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    poses = orbit(20) + moved(orbit(10), side)
    up, confidence = up_direction(poses)
    assert up @ [0, 0, 1] > 0.999
    assert 0.4 < confidence < 0.8


def test_up_of_thousands_of_photos_does_not_ask_every_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    """An object that was laid on its side for some of them; the plane of most is looked for among some pairs."""
    lying = make_similarity(1.0, rotation_to_z(np.array([1.0, 0, 0])), np.zeros(3))
    poses = orbit(700) + moved(orbit(500), lying)
    asked, cross = [], np.cross
    monkeypatch.setattr(np, "cross", lambda *given: asked.append(1) or cross(*given))
    up, _ = up_direction(poses)
    assert up @ [0, 0, 1] > 0.999
    assert len(asked) < 30_000


def test_upside_down_orbit_is_turned_over() -> None:
    """Cameras below the subject looking up are level too: their own up decides the sign."""
    up, _ = up_direction(orbit(height=-2.0))
    assert up @ [0, 0, 1] > 0.99


@pytest.mark.parametrize("turn", [1, -1])
def test_up_of_sideways_photos(turn: int) -> None:
    """A camera turned by 90°, either way round: found, but only half believed; it looks down at its subject."""
    roll = make_similarity(1.0, np.array([[0.0, -turn, 0], [turn, 0, 0], [0, 0, 1]]), np.zeros(3))
    up, confidence = up_direction([pose @ roll for pose in orbit()])
    assert up @ [0, 0, 1] > 0.999
    assert 0.4 < confidence <= 0.5


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.floats(0.01, 100))
def test_world_of_unknown_scale(seed: int, scale: float) -> None:
    """Whatever frame SfM chose: z up, cameras three units from the subject, the floor at z = 0."""
    rotation = random_rotation(seed)
    motion = make_similarity(scale, rotation, np.random.default_rng(seed).normal(size=3) * scale)
    points = subject_on_floor()
    frame, confidence = upright(moved(orbit(), motion), transform_points(motion, points))
    assert confidence > 0.9
    world = transform_points(frame @ motion, points)
    assert np.median(world[1500:, 2]) == pytest.approx(0, abs=0.01)
    assert world[:1500, 2].min() > 0
    centers = transform_points(frame @ motion, np.stack([p[:3, 3] for p in orbit()]))
    distance = np.linalg.norm(centers - np.median(world, axis=0), axis=1)
    assert np.median(distance) == pytest.approx(3.0, rel=0.1)
    assert np.linalg.norm(np.median(world, axis=0)[:2]) < 0.2  # medians by axis depend a little on the axes


def test_tilted_floor_is_levelled_and_no_floor_is_invented() -> None:
    tilt = np.radians(4)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    motion = make_similarity(1.0, turn, np.zeros(3))
    frame = on_ground(transform_points(motion, subject_on_floor()), np.eye(4))
    assert frame is not None
    assert np.allclose((frame @ motion)[:3, :3] @ [0, 0, 1], [0, 0, 1], atol=0.003)
    assert on_ground(subject_on_floor()[:1500], np.eye(4)) is None
    steep = np.radians(25)
    turn = np.array([[1, 0, 0], [0, np.cos(steep), -np.sin(steep)], [0, np.sin(steep), np.cos(steep)]])
    assert on_ground(subject_on_floor() @ turn.T, np.eye(4)) is None


def test_rotation_to_z() -> None:
    for up in np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(20, 3))]):
        rotation = rotation_to_z(up)
        assert np.allclose(rotation @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)


# --- the verb -------------------------------------------------------------------------------------------------------


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Cameras around a ball on a floor, in a frame with y up and units of 10 cm."""
    motion = make_similarity(10.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([5.0, 6, 7]))
    poses = moved(orbit(8), motion)
    camera = Camera(width=80, height=60, fx=80, fy=80, cx=40, cy=30)
    images = [PosedImage(name=f"c{i}", camera=0, camera_to_world=pose.tolist()) for i, pose in enumerate(poses)]
    cloud = transform_points(motion, subject_on_floor())
    points = Points(cloud, np.zeros((len(cloud), 3), np.uint8), np.zeros(len(cloud)))
    records = [ImageRecord(name=f"c{i}", file=f"images/c{i}.jpg", width=80, height=60) for i in range(8)]
    save_project(tmp_path, Project(images=records))
    save_poses(tmp_path, Poses(source="sfm", cameras=[camera], images=images), points)
    return tmp_path


def run(project: Path, **settings_: object) -> dict:
    return align(AlignParams(project=project, **settings_), Reporter())  # type: ignore[arg-type]


def test_up_scale_ground_and_crop_together(project: Path) -> None:
    result = run(project, up="y", scale=("c0", "c4", 6.0 * np.hypot(1, 0)), ground=True, crop="-1,-1,-0.1,1,1,2")
    assert result["scale_known"]
    scene = load_scene(project)
    assert np.median(scene.points.xyz[1500:, 2]) == pytest.approx(0, abs=0.01)
    a, b = (next(v for v in scene.views if v.name == name).camera_to_world[:3, 3] for name in ("c0", "c4"))
    assert np.linalg.norm(a - b) == pytest.approx(6.0, rel=1e-6)
    assert np.allclose(scene.bounds, [[-1, -1, -0.1], [1, 1, 2]])
    assert all(-view.camera_to_world[2, 1] > 0.5 for view in scene.views)
    project_ = load_project(project)
    assert project_.frame.up_confidence == 1.0
    assert project_.provenance[-1].verb == "align"


@pytest.mark.parametrize("up", ["x", "-x", "y", "-Y", "z", "-z", "0.3,-0.5,0.1"])
def test_up_override_is_in_the_present_world(project: Path, up: str) -> None:
    direction = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}.get(up.strip("-").lower())
    vector = np.array(direction if direction else [0.3, -0.5, 0.1], float)
    vector *= -1 if up.startswith("-") else 1
    before = np.array(load_project(project).frame.world_from_sfm)
    after = np.array(run(project, up=up)["transform"])
    assert np.allclose((after @ np.linalg.inv(before))[:3, :3] @ vector / np.linalg.norm(vector), [0, 0, 1])


def test_scale_by_two_points_of_the_world(project: Path) -> None:
    run(project, up="y")
    before = load_scene(project).points.xyz
    run(project, scale=("0,0,0", "0,0,2", 1.0))
    assert np.allclose(load_scene(project).points.xyz, before / 2)


def test_crop_box_moves_along(project: Path) -> None:
    run(project, up="y", crop="auto")
    box = np.array(load_project(project).frame.bounds)
    inside = load_scene(project).points.xyz
    share = ((inside >= box[0]) & (inside <= box[1])).all(1).mean()
    assert share > 0.9
    run(project, scale=("0,0,0", "0,0,2", 1.0))
    assert np.allclose(load_project(project).frame.bounds, box / 2)
    run(project, crop="none")
    assert load_project(project).frame.bounds is None


@pytest.mark.parametrize(
    ("settings_", "match"),
    [
        ({"up": "sideways"}, "up direction 'sideways'"),
        ({"up": "0,0,0"}, "no length"),
        ({"up": "1,2"}, "has 2 numbers"),
        ({"scale": ("c0", "nobody", 1.0)}, "No placed photo is called 'nobody'"),
        ({"scale": ("c0", "c0", 1.0)}, "same place"),
        ({"scale": ("c0", "c1", -1.0)}, "not positive"),
        ({"crop": "1,1,1,0,0,0"}, "is empty"),
        ({"crop": "1,2,x,4,5,6"}, "not understood"),
    ],
)
def test_impossible_settings_change_nothing(project: Path, settings_: dict, match: str) -> None:
    before = (project / "project.json").read_bytes()
    with pytest.raises(SettingError, match=match):
        run(project, **settings_)
    assert (project / "project.json").read_bytes() == before


def test_ground_that_is_not_there(project: Path) -> None:
    with pytest.raises(PosesError, match="No level ground"):
        run(project, up="x", ground=True)


# --- GPS ------------------------------------------------------------------------------------------------------------


def gps_walk(noise: float, size: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera centres in a world of wrong scale and heading, and their noisy latitudes and longitudes at 48° N."""
    rng = np.random.default_rng(seed)
    metres = rng.uniform(-size / 2, size / 2, (30, 2))
    angle, scale = np.radians(70), 0.05
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centers = np.concatenate([scale * metres @ turn.T, rng.uniform(0, 0.1, (30, 1))], 1)
    measured = metres + rng.normal(0, noise, metres.shape)
    latitude = 48 + np.degrees(measured[:, 1] / 6_378_137)
    longitude = 11 + np.degrees(measured[:, 0] / (6_378_137 * np.cos(np.radians(48))))
    return centers, latitude, longitude


def test_gps_gives_scale_and_north() -> None:
    centers, latitude, longitude = gps_walk(noise=3.0, size=200.0)
    latitude[3] += 0.01  # one that is a kilometre off
    fit = fit_gps(centers, latitude, longitude)
    factor = np.linalg.norm(fit.turn[:3, 0])
    assert factor == pytest.approx(20.0, rel=0.03)
    north = np.array([np.cos(np.radians(160)), np.sin(np.radians(160)), 0])  # where +y of the earth lies in the world
    assert np.allclose(fit.turn[:3, :3] @ north / factor, [0, 1, 0], atol=0.05)
    assert fit.residual < 8
    assert fit.origin == pytest.approx((48, 11), abs=1e-4)


@pytest.mark.parametrize("latitude", [0.0, 48.0, 70.0])
@pytest.mark.parametrize("size", [(20.0, 300.0), (300.0, 20.0)])
def test_scale_from_gps_is_that_of_the_ellipsoid(latitude: float, size: tuple[float, float]) -> None:
    """Along the meridian and across it, where a sphere would be off by up to 0.7 %."""
    metres = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2)) * size
    found = np.stack([geodetic(place, latitude, 11.0) for place in metres])
    fit = fit_gps(np.concatenate([metres, np.zeros((40, 1))], 1), *found.T)
    np.testing.assert_allclose(fit.turn[:2, :2], np.eye(2), atol=1e-4)
    assert fit.origin == pytest.approx((latitude, 11.0), abs=1e-7)
    assert fit.residual < 0.005


def geodetic(place: np.ndarray, latitude: float, longitude: float) -> list[float]:
    """Latitude and longitude of a place (east, north) in metres on the plane that touches the ellipsoid at others."""
    phi, lam = np.radians([latitude, longitude])
    long, short = 6_378_137.0, 6_378_137.0 * (1 - 1 / 298.257223563)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    middle = np.array([long**2, long**2, short**2]) * up / np.sqrt((np.array([long, long, short]) ** 2) @ up**2)
    east = np.array([-np.sin(lam), np.cos(lam), 0])
    x, y, z = middle + place[0] * east + place[1] * np.cross(up, east)
    # The normal of the ellipsoid below: the plane is less than 2 mm above it.
    return np.degrees([np.arctan2(z * (long / short) ** 2, np.hypot(x, y)), np.arctan2(y, x)]).tolist()


def test_gps_that_says_nothing_is_refused() -> None:
    with pytest.raises(PosesError, match="too little for their error"):
        fit_gps(*gps_walk(noise=3.0, size=10.0))
    centers, latitude, longitude = gps_walk(noise=3.0, size=200.0)
    with pytest.raises(PosesError, match="do not fit"):
        fit_gps(centers, np.random.default_rng(1).permutation(latitude), longitude)
    with pytest.raises(PosesError, match="Only 2 placed photos"):
        fit_gps(centers[:2], latitude[:2], longitude[:2])


def test_one_position_far_away_gives_a_small_capture_no_scale() -> None:
    """Of a photo that was taken before the receiver had found its place: the others still lie within their error."""
    centers, latitude, longitude = gps_walk(noise=3.0, size=10.0)
    latitude[3] += 0.02
    with pytest.raises(PosesError, match="too little for their error"):
        fit_gps(centers, latitude, longitude)


def test_one_position_far_away_leaves_the_scale_of_the_others() -> None:
    centers, latitude, longitude = gps_walk(noise=0.0, size=300.0)
    known = fit_gps(centers, latitude, longitude)
    latitude[3] -= 40
    np.testing.assert_allclose(fit_gps(centers, latitude, longitude).turn, known.turn, atol=1e-3)


def test_gps_on_both_sides_of_the_meridian_of_180_degrees() -> None:
    centers, latitude, longitude = gps_walk(noise=0.0, size=300.0)
    known = fit_gps(centers, latitude, longitude)
    fit = fit_gps(centers, latitude, (longitude - 11 + 360) % 360 - 180)
    np.testing.assert_allclose(fit.turn, known.turn, rtol=1e-6, atol=1e-6)
    assert abs(fit.origin[1]) == pytest.approx(180, abs=1e-4)


def test_gps_verb(project: Path) -> None:
    data = load_project(project)
    run(project, up="y")
    data = load_project(project)
    # The orbit is 6 units of 10 cm wide; its GPS positions say 60 m.
    for view in load_scene(project).views:
        x, y, _ = view.camera_to_world[:3, 3]
        record = next(r for r in data.images if r.name == view.name)
        record.exif = {"gps": {"latitude": 48 + np.degrees(y / 6_378_137), "longitude": np.degrees(x / 4_267_808)}}
    save_project(project, data)
    result = run(project, gps=True)
    assert result["scale_known"]
    assert result["gps"]["residual_m"] < 0.5
    assert np.cbrt(np.linalg.det(np.array(result["transform"])[:3, :3])) == pytest.approx(1.0, rel=0.01)
