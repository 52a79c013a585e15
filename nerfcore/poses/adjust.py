"""The final adjustment of poses, points and lenses, and what is believed of a lens. Runs in the pose process."""

from __future__ import annotations

import collections
import copy
from collections.abc import Container
from typing import Any

import numpy as np
import pycolmap

from .features import FULL_MODEL_FROM, LONG_LENS

PRINCIPAL_POINT_FROM = 10  # photos through one lens; not tuned
MAX_POINT_ERROR = 4.0  # pixels; COLMAP's filter_max_reproj_error
ROUNDS = 2  # not tuned: the loss follows the residuals, which follow the loss
CAUCHY = 2.385  # of the noise: as good as least squares to 95 % if all matches were right (Holland and Welsch, 1977)
RAYLEIGH = 1.1774  # √(2 ln 2): median length of a vector whose two parts have unit variance
EXPLAINED = 0.005  # of the cost of the residuals; docs/experiments.md, “Square pixels”
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

    A lens that took at least fifteen photos is given two terms of radial distortion, and its principal point is refined
    where there is no other lens; not so where its view is narrow, or where the outcome is like no real lens. It is given
    all of OPENCV's parameters, a focal length for each axis and tangential distortion, where these explain what is left:
    cameras have square pixels, and photos taken upright alone hardly tell a stretched picture from another scene.

    Wrong matches that survived verification are too few to bend poses, but they do pull at the principal point, which
    some captures hardly determine. So the loss is Cauchy's, with the scale that the residuals ask for.
    """
    if keep_cameras:
        return model
    if not has_long_lens(model):
        radial = copy.deepcopy(model)
        free_lenses(radial, "RADIAL")
        bundle_adjust(radial, full=True)
        general = copy.deepcopy(radial)
        if free_lenses(general, "OPENCV"):
            bundle_adjust(general, full=True)
            if not has_odd_lens(general) and explained(radial, general) > EXPLAINED:
                return general
        if not has_odd_lens(radial):
            return radial
    bundle_adjust(model, full=False)
    return model


def free_lenses(model: Any, name: str) -> bool:
    """Give lenses that took many photos the parameters of another COLMAP model, RADIAL or OPENCV, beginning with those they
    have; whether there was one that had fewer."""
    taken = collections.Counter(model.image(i).camera_id for i in model.reg_image_ids())
    before = {"RADIAL": ("SIMPLE_RADIAL",), "OPENCV": ("SIMPLE_RADIAL", "RADIAL")}[name]
    changed = False
    for camera_id, count in taken.items():
        camera = model.camera(camera_id)
        if count < FULL_MODEL_FROM or camera.model_name not in before:
            continue
        focal, cx, cy, *k = camera.params
        k1, k2 = [*k, 0.0][:2]
        camera.model = getattr(pycolmap.CameraModelId, name)
        camera.params = [focal, cx, cy, k1, k2] if name == "RADIAL" else [focal, focal, cx, cy, k1, k2, 0.0, 0.0]
        changed = True
    return changed


def bundle_adjust(model: Any, full: bool) -> None:
    """Bundle adjustment in place, with Cauchy's loss; points that miss by more than four pixels are taken out.

    `full` refines a principal point that can be seen.
    """
    used = len({model.image(i).camera_id for i in model.reg_image_ids()})
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    # Through a long lens a shifted principal point looks like a turned camera.
    options.refine_principal_point = full and used == 1 and model.num_reg_images() >= PRINCIPAL_POINT_FROM
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.function_tolerance = TOLERANCE
    for _ in range(ROUNDS):
        options.ceres.loss_function_scale = max(CAUCHY * noise(model), 1e-3)
        pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    for point_id in [i for i, point in model.points3D.items() if point.error > MAX_POINT_ERROR]:
        model.delete_point3D(point_id)


def explained(model: Any, other: Any) -> float:
    """The share of the cost of a model's residuals, by Cauchy's loss, that another one of the same photos does without; of
    the points that both have."""
    points = set(model.points3D) & set(other.points3D)
    scale = max(CAUCHY * noise(model), 1e-3)
    cost, rest = (float(np.log1p((residuals(m, points) / scale) ** 2).sum()) for m in (model, other))
    return 1 - rest / cost if cost > 0 else 0.0


def noise(model: Any) -> float:
    """Standard deviation, in pixels and along one axis, of the features about their projected points.

    From the median of the residuals, which wrong matches do not touch; 0 without points.
    """
    lengths = residuals(model, model.points3D)
    return float(np.median(lengths)) / RAYLEIGH if len(lengths) else 0.0


def residuals(model: Any, points: Container[int]) -> np.ndarray:
    """Distances (N,) in pixels of the features of some points from where these are projected; finite ones only."""
    lengths = [np.zeros(0)]
    for i in model.reg_image_ids():
        image = model.image(i)
        seen = [point for point in image.get_observation_points2D() if point.point3D_id in points]
        if not seen:
            continue
        pose = image.cam_from_world().matrix()
        local = np.stack([model.point3D(point.point3D_id).xyz for point in seen]) @ pose[:, :3].T + pose[:, 3]
        found = np.asarray(image.camera.img_from_cam(local))
        lengths.append(np.linalg.norm(found - np.stack([point.xy for point in seen]), axis=1))
    distances = np.concatenate(lengths)
    return distances[np.isfinite(distances)]
