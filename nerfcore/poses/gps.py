"""Scale and north from the GPS positions of the photos, when they mean something."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import PosesError
from ..geometry.earth import metres_per_radian

GPS_NOISE = 5.0  # metres, of a phone under open sky (gps.gov: 4.9 m)
# Not tuned: the next two.
EXTENT_OVER_NOISE = 8.0  # how far the photos must be spread for GPS to say anything
MAX_MISFIT = 0.4  # of the spread of the positions; unrelated ones reach about 1


@dataclass(frozen=True)
class GpsFit:
    """`turn` (4, 4) is the rotation about z and the scale that bring the world to metres with +y to the north.

    `origin` is where the world's origin lies (degrees), `residual` the median misfit in metres.
    """

    turn: np.ndarray
    origin: tuple[float, float]
    residual: float


def local_metres(latitude: np.ndarray, longitude: np.ndarray, origin: tuple[float, float]) -> np.ndarray:
    """East and north (N, 2) in metres from a place (degrees), on the plane that touches the ellipsoid there."""
    east = (longitude - origin[1] + 180) % 360 - 180  # the shorter way, also over the meridian of 180°
    return np.radians(np.stack([east, latitude - origin[0]], -1)) * metres_per_radian(origin[0])


def middle(latitude: np.ndarray, longitude: np.ndarray) -> tuple[float, float]:
    """A place (degrees) amid most of some, wherever a few lie by mistake."""
    east = (longitude - longitude[0] + 180) % 360 - 180
    return float(np.median(latitude)), float(np.median(east)) + float(longitude[0])


def fit_gps(centers: np.ndarray, latitude: np.ndarray, longitude: np.ndarray) -> GpsFit:
    """Fit heading and scale of cameras to their GPS positions; up is kept as it is.

    Args:
        centers: (N, 3) camera centres in a world with z up.
        latitude, longitude: (N,) degrees.
    Raises:
        PosesError: too few positions, too close together for their noise, or they contradict the poses.
    """
    if len(centers) < 4:
        raise PosesError(f"Only {len(centers)} placed photos have a GPS position.", "Give the scale with --scale.")
    reference = middle(latitude, longitude)
    target = local_metres(latitude, longitude, reference)
    z, w = centers[:, 0] + 1j * centers[:, 1], target[:, 0] + 1j * target[:, 1]
    keep = np.ones(len(z), bool)
    factor, shift = 1.0 + 0j, 0j
    for _ in range(5):
        mean_z, mean_w = z[keep].mean(), w[keep].mean()
        a, b = z[keep] - mean_z, w[keep] - mean_w
        # Least squares for w = factor · z + shift over complex numbers: a plane similarity without reflection.
        factor = (np.conj(a) @ b) / max(float((np.abs(a) ** 2).sum()), 1e-30)
        shift = mean_w - factor * mean_z
        misfit = np.abs(factor * z + shift - w)
        keep = misfit <= max(3 * float(np.median(misfit)), 1e-6)
    # Of those that fit together: a single one far away, from before the receiver had found its place, spreads nothing.
    extent = float(np.linalg.norm(np.ptp(target[keep], axis=0)))
    if extent < EXTENT_OVER_NOISE * GPS_NOISE:
        raise PosesError(
            f"The GPS positions lie within {extent:.0f} m, which is too little for their error of about "
            f"{GPS_NOISE:.0f} m.",
            "Give the scale with --scale.",
        )
    residual = float(np.median(np.abs(factor * z + shift - w)))
    spread = float(np.median(np.abs(w - w.mean())))
    if residual > MAX_MISFIT * spread or abs(factor) < 1e-9:
        raise PosesError(
            f"The GPS positions do not fit the camera positions (misfit {residual:.0f} m of a spread of {spread:.0f} m).",
            "Give the scale with --scale.",
        )
    turn = np.diag([abs(factor), abs(factor), abs(factor), 1.0])
    turn[:2, :2] = [[factor.real, -factor.imag], [factor.imag, factor.real]]
    metres = metres_per_radian(reference[0])
    east, north = np.degrees([shift.real / metres[0], shift.imag / metres[1]]).tolist()
    return GpsFit(turn, (reference[0] + north, (reference[1] + east + 180) % 360 - 180), residual)
