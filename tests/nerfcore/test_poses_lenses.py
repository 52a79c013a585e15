"""Which parameters the final adjustment gives a lens: on COLMAP's synthetic models."""

from __future__ import annotations

import copy
import zlib  # noqa: F401  (must be loaded before pycolmap)
from typing import Any

import numpy as np
import pytest

WIDTH, HEIGHT, FOCAL, NOISE = 1024, 768, 900.0, 0.5


@pytest.fixture(scope="module")
def synthetic() -> Any:
    """A model of 24 photos through one lens, SIMPLE_RADIAL, with half a pixel of noise."""
    import pycolmap

    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 24, 400
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_params = [FOCAL, WIDTH / 2, HEIGHT / 2, 0.03]
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = NOISE
    pycolmap.synthesize_noise(noise, model)
    return model


def stretched(model: Any, factor: float) -> Any:
    """The model with its pictures made higher about their middle."""
    model = copy.deepcopy(model)
    for i in model.reg_image_ids():
        for point in model.image(i).points2D:
            point.xy = np.array([point.xy[0], HEIGHT / 2 + (point.xy[1] - HEIGHT / 2) * factor])
    return model


@pytest.mark.parametrize("model_name", ["SIMPLE_RADIAL", "RADIAL"])
def test_pixels_are_square(synthetic: Any, model_name: str) -> None:
    from fieldwork.nerfcore.poses.adjust import adjust, free_lenses

    model = copy.deepcopy(synthetic)
    if model_name == "RADIAL":  # as the mapper leaves it
        free_lenses(model, "RADIAL")
    camera = adjust(model, keep_cameras=False).camera(1)
    assert camera.model_name == "RADIAL"
    assert camera.params[0] == pytest.approx(FOCAL, rel=2e-3)
    assert camera.params[3] == pytest.approx(0.03, abs=5e-3)


def test_pixels_that_are_not_square_are_found(synthetic: Any) -> None:
    from fieldwork.nerfcore.poses.adjust import adjust

    camera = adjust(stretched(synthetic, 1.02), keep_cameras=False).camera(1)
    assert camera.model_name == "OPENCV"
    assert camera.params[1] / camera.params[0] == pytest.approx(1.02, abs=2e-3)


def test_parameters_that_noise_alone_asks_for_explain_little(synthetic: Any) -> None:
    from fieldwork.nerfcore.poses.adjust import EXPLAINED, bundle_adjust, explained, free_lenses

    radial = copy.deepcopy(synthetic)
    assert free_lenses(radial, "RADIAL")
    assert not free_lenses(radial, "RADIAL")
    bundle_adjust(radial, full=True)
    general = copy.deepcopy(radial)
    assert free_lenses(general, "OPENCV")
    assert not free_lenses(general, "OPENCV")
    bundle_adjust(general, full=True)
    assert 0 <= explained(radial, general) < EXPLAINED
    assert explained(radial, radial) == 0


def test_few_photos_keep_one_term_of_distortion(synthetic: Any) -> None:
    from fieldwork.nerfcore.poses.adjust import adjust

    model = copy.deepcopy(synthetic)
    for i in sorted(model.reg_frame_ids())[14:]:
        model.deregister_frame(i)
    assert adjust(model, keep_cameras=False).camera(1).model_name == "SIMPLE_RADIAL"
