"""The ellipsoid of the earth: what is up, and how long degrees are."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.geometry.earth import EQUATOR, POLE, metres_per_radian, up_at


@pytest.mark.parametrize("latitude", [-90.0, -33.0, 0.0, 45.0, 89.0])
@pytest.mark.parametrize("height", [-400.0, 0.0, 5000.0])
def test_up_is_the_normal_of_the_ellipsoid_at_any_height(latitude: float, height: float) -> None:
    phi, lam = np.radians([latitude, 123.0])
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    ground = np.array([EQUATOR, EQUATOR, POLE]) ** 2 * up
    ground /= np.sqrt(ground @ up)
    np.testing.assert_allclose(up_at(ground + height * up), up, atol=1e-11)


def test_degrees_are_as_long_as_tables_say() -> None:
    """Metres for a degree of longitude and of latitude (WGS 84)."""
    for latitude, east, north in ((0, 111_319.5, 110_574.3), (45, 78_846.8, 111_131.8), (60, 55_800.0, 111_412.2)):
        assert np.radians(metres_per_radian(latitude)) == pytest.approx((east, north), abs=0.1)
