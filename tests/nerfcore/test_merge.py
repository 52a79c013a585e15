"""Separate models of one scene become one, and those of different scenes do not."""

from __future__ import annotations

import copy
import zlib  # noqa: F401  (must be loaded before pycolmap)
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from fieldwork.nerfcore.geometry.similarity import fit_similarity, transform_points
from fieldwork.nerfcore.poses import features, mapping, merge, pipeline, second_look
from fieldwork.nerfcore.poses.presets import FAST, STANDARD, Level
from fieldwork.nerfcore.poses.validate import check_images, pair_images

FRAMES, OF_SMALL, POINTS, STRAY = 16, 6, 250, 120
NOISE_PX = 0.5


class Told:
    """Keeps what the pose process says."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def stage(self, name: str) -> None: ...

    def progress(self, fraction: float, message: str = "") -> None: ...

    def watch(self, database: str, table: str, total: int, noun: str) -> None: ...

    def watch_end(self) -> None: ...

    def warn(self, message: str) -> None:
        self.warnings.append(message)


@dataclass
class Scene:
    """A database of exact matches, the true model, and it in two parts, the smaller one moved by a similarity."""

    database: Path
    true: Any
    large: Any
    small: Any

    def merged(self, folder: Path) -> tuple[list[Any], list[str]]:
        return merge.merge_models([self.large, self.small], self.database, folder, folder / "work", Told())

    def names(self) -> list[str]:
        return sorted(self.true.image(i).name for i in self.true.reg_image_ids())

    def across(self) -> list[tuple[int, int]]:
        """Pairs of an image of the large model alone and one of the small one alone."""
        large, small = set(self.large.reg_image_ids()), set(self.small.reg_image_ids())
        return [(a, b) for a in sorted(large - small) for b in sorted(small - large)]


def make_scene(folder: Path, common: int = 0, level: Level = FAST) -> Scene:
    """Sixteen photos around points; the last six are the small model, which holds `common` photos of the large one."""
    path = folder / level.database
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 1, FRAMES
    options.num_points3D, options.num_points2D_without_point3D = POINTS, STRAY
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = NOISE_PX
    pycolmap.set_random_seed(3)
    with features.database(path) as db:
        true = pycolmap.synthesize_dataset(options, db)
        pycolmap.synthesize_noise(noise, true, db)
    ids = sorted(true.reg_image_ids())
    large, small = part(true, ids[:-OF_SMALL]), part(true, ids[-OF_SMALL - common :])
    turn = pycolmap.Rotation3d(np.array([0.7, -1.1, 0.4]))
    small.transform(pycolmap.Sim3d(2.7, turn, np.array([4.0, -3.0, 11.0])))
    return Scene(path, true, large, small)


def part(model: Any, image_ids: list[int]) -> Any:
    """The model of some of its images, as the mapper would give it."""
    chosen = copy.deepcopy(model)
    for i in model.reg_image_ids():
        if i not in image_ids:
            chosen.deregister_frame(chosen.image(i).frame_id)
    chosen.tear_down()
    return chosen


def write_matches(path: Path, pairs: dict[tuple[int, int], np.ndarray]) -> None:
    """Give pairs of images these verified matches (N, 2), which may be none, in place of their own."""
    with features.database(path) as db:
        for (a, b), matches in pairs.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            geometry.inlier_matches = matches.astype(np.uint32)
            if db.exists_two_view_geometry(a, b):
                db.delete_two_view_geometry(a, b)
            db.write_two_view_geometry(a, b, geometry)


def read_matches(path: Path) -> dict[tuple[int, int], np.ndarray]:
    with features.database(path) as db:
        pair_ids, geometries = db.read_two_view_geometries()
        return {pair_images(i): np.asarray(g.inlier_matches) for i, g in zip(pair_ids, geometries)}


def centre_misfit(model: Any, true: Any) -> float:
    """Largest error of a camera centre after the best similarity, in per cent of the extent of the true ones."""
    ids = sorted(model.reg_image_ids())
    found, asked = (np.stack([m.image(i).projection_center() for i in ids]) for m in (model, true))
    misfit = np.linalg.norm(transform_points(fit_similarity(found, asked), found) - asked, axis=1)
    return 100 * float(misfit.max() / np.linalg.norm(np.ptp(asked, axis=0)))


def test_two_parts_become_one(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    before = scene.small.image(scene.small.reg_image_ids()[0]).projection_center()
    models, said = scene.merged(tmp_path)
    assert [model.num_reg_images() for model in models] == [FRAMES]
    assert said == [f"The separate groups of 10 and 6 photos were joined by {POINTS} points that both have."]
    assert centre_misfit(models[0], scene.true) < 0.1
    # Points that were the same are one again, seen by photos of both parts.
    assert models[0].num_points3D() <= 1.02 * POINTS
    small = set(scene.small.reg_image_ids())
    shared = [small < {element.image_id for element in p.track.elements} for p in models[0].points3D.values()]
    assert np.mean(shared) > 0.9
    checks, _ = check_images(models[0], scene.database)
    assert min(check.agreement or 0 for check in checks.values()) > 0.95
    # The parts themselves stay as they are.
    assert scene.large.num_reg_images() == FRAMES - OF_SMALL
    assert np.array_equal(scene.small.image(scene.small.reg_image_ids()[0]).projection_center(), before)


def test_few_and_partly_wrong_matches_are_enough(tmp_path: Path) -> None:
    """Two pairs of photos match across the parts, with a third of their matches wrong."""
    scene = make_scene(tmp_path)
    random, matches = np.random.default_rng(0), read_matches(tmp_path / FAST.database)
    across = scene.across()
    changed = {pair: np.zeros((0, 2)) for pair in across}
    for pair in (across[0], across[-1]):
        kept = matches[pair][random.permutation(len(matches[pair]))[:60]]
        kept[40:, 1] = random.permutation(kept[40:, 1])
        changed[pair] = kept
    write_matches(scene.database, changed)
    models, _ = scene.merged(tmp_path)
    assert [model.num_reg_images() for model in models] == [FRAMES]
    assert centre_misfit(models[0], scene.true) < 0.5


def test_photos_of_both_parts_are_enough(tmp_path: Path) -> None:
    """The mapper lets models hold the same photos: no match is needed beside them."""
    scene = make_scene(tmp_path, common=2)
    write_matches(scene.database, {pair: np.zeros((0, 2)) for pair in scene.across()})
    assert scene.small.num_reg_images() == OF_SMALL + 2
    models, _ = scene.merged(tmp_path)
    assert [model.num_reg_images() for model in models] == [FRAMES]
    assert centre_misfit(models[0], scene.true) < 0.2


def test_different_scenes_stay_apart(tmp_path: Path) -> None:
    """Matches across the groups are many, and accidental."""
    scene = make_scene(tmp_path)
    random = np.random.default_rng(1)
    accidental = {
        pair: np.stack([random.permutation(POINTS)[:40], random.permutation(POINTS)[:40]], 1) for pair in scene.across()
    }
    write_matches(scene.database, accidental)
    assert len(merge.find_ties(scene.small, scene.large, scene.database).points) > 500
    models, said = scene.merged(tmp_path)
    assert [model.num_reg_images() for model in models] == [10, 6]
    assert said == []


@pytest.mark.parametrize(("count", "left"), [(merge.LEAST_POINTS - 5, [10, 6]), (merge.LEAST_POINTS + 10, [16])])
def test_too_few_points_in_common(tmp_path: Path, count: int, left: list[int]) -> None:
    scene = make_scene(tmp_path)
    across, matches = scene.across(), read_matches(tmp_path / FAST.database)
    write_matches(scene.database, {p: matches[p][:count] if p == across[0] else np.zeros((0, 2)) for p in across})
    models, _ = scene.merged(tmp_path)
    assert [model.num_reg_images() for model in models] == left


def test_matches_that_contradict_the_joined_model(tmp_path: Path) -> None:
    """Forty points would join the groups, but most other matches across them, of features without a point, miss."""
    scene = make_scene(tmp_path)
    across, matches = scene.across(), read_matches(tmp_path / FAST.database)
    ids = sorted(scene.true.reg_image_ids())
    stray = {
        i: np.flatnonzero([not point.has_point3D() for point in scene.true.image(i).points2D]).tolist() for i in ids
    }
    changed = {(a, b): np.stack([stray[a][:40], stray[b][:40]], 1) for a, b in across}
    changed[across[0]] = matches[across[0]][:40]
    write_matches(scene.database, changed)
    ties = merge.find_ties(scene.small, scene.large, scene.database)
    assert merge.similarity(ties, scene.small, scene.large) is not None
    models, _ = scene.merged(tmp_path)
    assert [model.num_reg_images() for model in models] == [10, 6]


def run_pipeline(scene: Scene, folder: Path, preset: str, monkeypatch: pytest.MonkeyPatch) -> tuple[dict, Told]:
    """The pipeline's result on a mapper that finds the two models, and what it said."""
    build = mapping.build

    def two_models(*arguments: Any, **further: Any) -> list[Any]:
        return build(*arguments, **further) if "start" in further else [scene.large, scene.small]

    monkeypatch.setattr(mapping, "build", two_models)
    camera = scene.true.image(scene.true.reg_image_ids()[0]).camera
    size = {"width": camera.width, "height": camera.height, "focal_px": camera.mean_focal_length()}
    told = Told()
    job = {
        "image_folder": str(folder),
        "masks": None,
        "work": str(folder),
        "sparse": str(folder / "sparse"),
        "preset": preset,
        "neighbours": 3,
        "video": False,
        "restart": False,
        "group": 0,
        "start": None,
        "images": [{"file": name, "group": "all", **size} for name in scene.names()],
    }
    return pipeline.run(job, told), told


def test_joined_groups_end_the_climb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(tmp_path)
    result, told = run_pipeline(scene, tmp_path, "fast", monkeypatch)
    assert result["groups"] == [FRAMES]
    assert [image["status"] for image in result["images"]] == ["ok"] * FRAMES
    assert len(told.warnings) == 1
    assert "groups of 10 and 6 photos were joined" in told.warnings[0]
    centres = np.stack([np.array(image["camera_to_world"])[:3, 3] for image in result["images"]])
    asked = np.stack([scene.true.find_image_with_name(name).projection_center() for name in scene.names()])
    misfit = transform_points(fit_similarity(centres, asked), centres) - asked
    assert np.linalg.norm(misfit, axis=1).max() < 0.002 * np.linalg.norm(np.ptp(asked, axis=0))


def test_affine_features_join_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing matches across the groups but what a second database of further features has."""
    scene = make_scene(tmp_path, level=STANDARD)
    further = features.copy_database(scene.database, tmp_path / "further.db")
    write_matches(scene.database, {pair: np.zeros((0, 2)) for pair in scene.across()})
    asked_for: list[list[set[str]]] = []

    def found(clusters: list[set[str]], path: Path, joined: Path, *_: Any) -> bool:
        asked_for.append(clusters)
        second_look.join(path, further, joined)
        return True

    monkeypatch.setattr(second_look, "add_affine_features", found)
    result, told = run_pipeline(scene, tmp_path, "standard", monkeypatch)
    assert len(asked_for) == 1
    assert result["groups"] == [FRAMES]
    assert [image["status"] for image in result["images"]] == ["ok"] * FRAMES
    assert "separate groups of 10 and 6: looking for affine features" in told.warnings[0]
    assert "were joined" in told.warnings[1]
    assert len(told.warnings) == 2
    assert result["level"] == "standard, groups joined"


def test_bridges_are_photos_of_both_models(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    clusters = merge.bridges([scene.large, scene.small], scene.database, scene.names())
    first = {scene.large.image(i).name for i in scene.large.reg_image_ids()}
    assert len(clusters) == OF_SMALL
    assert all(cluster & first and cluster - first for cluster in clusters)
