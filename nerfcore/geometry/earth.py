"""The ellipsoid of the earth (WGS 84): which way is up at a place, and how many metres a degree is there."""

from __future__ import annotations

import numpy as np

EQUATOR = 6_378_137.0  # metres: semi-major axis
FLATTENING = 1 / 298.257223563
POLE = EQUATOR * (1 - FLATTENING)  # metres: semi-minor axis
SQUARED = FLATTENING * (2 - FLATTENING)  # first eccentricity, squared


def up_at(place: np.ndarray) -> np.ndarray:
    """The unit normal (3,) of the ellipsoid below a geocentric place (3,), in metres: up to 0.19° from the way there from the
    middle of the earth.

    Source: Bowring, “Transformation from spatial to geographical coordinates”, 1976; off by less than a millionth of a
    second of arc near the ground.
    """
    x, y, z = place
    across = np.hypot(x, y)
    reduced = np.arctan2(z * EQUATOR, across * POLE)
    latitude = np.arctan2(
        z + SQUARED / (1 - SQUARED) * POLE * np.sin(reduced) ** 3,
        across - SQUARED * EQUATOR * np.cos(reduced) ** 3,
    )
    longitude = np.arctan2(y, x)
    flat = np.cos(latitude)
    return np.array([flat * np.cos(longitude), flat * np.sin(longitude), np.sin(latitude)])


def metres_per_radian(latitude: float) -> tuple[float, float]:
    """Metres on the ellipsoid for a radian of longitude and of latitude, at a latitude in degrees: N cos φ and M, with the
    radii of curvature N in the prime vertical and M in the meridian (Torge, “Geodesy”, 2001)."""
    sine = np.sin(np.radians(latitude))
    bend = 1 - SQUARED * sine**2
    return float(EQUATOR / np.sqrt(bend) * np.cos(np.radians(latitude))), float(EQUATOR * (1 - SQUARED) / bend**1.5)
