"""The final adjustment of poses, points and lenses, and what is believed of a lens. Runs in the pose process."""

from __future__ import annotations

import collections
import copy
from typing import Any

import numpy as np
import pycolmap

from .features import FULL_MODEL_FROM, LONG_LENS

PRINCIPAL_POINT_FROM = 10  # photos through one lens; not tuned
MAX_POINT_ERROR = 4.0  # pixels; COLMAP's filter_max_reproj_error
ROUNDS = 2  # not tuned: the loss follows the residuals, which follow the loss
CAUCHY = 2.385  # of the noise: as good as least squares to 95 % if all matches were right (Holland and Welsch, 1977)
RAYLEIGH = 1.1774  # √(2 ln 2): median length of a vector whose two parts have unit variance
TOLERANCE = 1e-6  # relative change of the cost; pycolmap's default, 0, takes five times as long for the same lens


def has_long_lens(model: Any) -> bool:
    """Whether a lens in use has a view too narrow for its principal point and higher distortion to be seen."""
    return any(camera.mean_focal_length() >= LONG_LENS * max(camera.width, camera.height) for camera in _used(model))


def has_odd_lens(model: Any) -> bool:
    """Whether a lens in use is like none that exists, so that self-calibration has run away.

    Real ones have square pixels within 3 %, a principal point within 12 % of the long side of the middle, and little
    tangential distortion.
    """
    for camera in _used(model):
        side = max(camera.width, camera.height)
        if abs(camera.focal_length_x / camera.focal_length_y - 1) > 0.03:
            return True
        offset = camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2
        if max(abs(offset[0]), abs(offset[1])) > 0.12 * side:
            return True
        if camera.model_name == "OPENCV" and max(abs(camera.params[6]), abs(camera.params[7])) > 0.02:
            return True
    return False


def _used(model: Any) -> list[Any]:
    return [model.camera(i) for i in sorted({model.image(i).camera_id for i in model.reg_image_ids()})]


def adjust(model: Any, keep_cameras: bool) -> Any:
    """Final bundle adjustment of a model; the adjusted model is returned.

    A lens that took at least fifteen photos is given all of OPENCV's parameters, and its principal point is refined
    where there is no other lens; not so where its view is narrow, or where the outcome is like no real lens.

    Wrong matches that survived verification are too few to bend poses, but they do pull at the principal point, which
    some captures hardly determine. So the loss is Cauchy's, with the scale that the residuals ask for.
    """
    if keep_cameras:
        return model
    if not has_long_lens(model):
        freed = copy.deepcopy(model)
        bundle_adjust(freed, full=True)
        if not has_odd_lens(freed):
            return freed
    bundle_adjust(model, full=False)
    return model


def bundle_adjust(model: Any, full: bool) -> None:
    """Bundle adjustment in place, with Cauchy's loss; points that miss by more than four pixels are taken out.

    `full` gives lenses of many photos all of OPENCV's parameters, and refines a principal point that can be seen.
    """
    taken = collections.Counter(model.image(i).camera_id for i in model.reg_image_ids())
    for camera_id, count in taken.items():
        camera = model.camera(camera_id)
        if full and count >= FULL_MODEL_FROM and camera.model_name == "SIMPLE_RADIAL":
            focal, cx, cy, k = camera.params
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal, cx, cy, k, 0.0, 0.0, 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    # Through a long lens a shifted principal point looks like a turned camera.
    options.refine_principal_point = full and len(taken) == 1 and model.num_reg_images() >= PRINCIPAL_POINT_FROM
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.function_tolerance = TOLERANCE
    for _ in range(ROUNDS):
        options.ceres.loss_function_scale = max(CAUCHY * noise(model), 1e-3)
        pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    for point_id in [i for i, point in model.points3D.items() if point.error > MAX_POINT_ERROR]:
        model.delete_point3D(point_id)


def noise(model: Any) -> float:
    """Standard deviation, in pixels and along one axis, of the features about their projected points.

    From the median of the residuals, which wrong matches do not touch; 0 without points.
    """
    lengths = []
    for i in model.reg_image_ids():
        image = model.image(i)
        seen = image.get_observation_points2D()
        if not seen:
            continue
        pose = image.cam_from_world().matrix()
        local = np.stack([model.point3D(point.point3D_id).xyz for point in seen]) @ pose[:, :3].T + pose[:, 3]
        found = np.asarray(image.camera.img_from_cam(local))
        lengths.append(np.linalg.norm(found - np.stack([point.xy for point in seen]), axis=1))
    lengths = np.concatenate(lengths) if lengths else np.zeros(0)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) / RAYLEIGH if len(lengths) else 0.0
