"""Photos of one camera at several zooms."""

from __future__ import annotations

from fieldwork.nerfcore.poses.zoom import lens_groups
from fieldwork.nerfcore.project.schema import ImageRecord


def photos(group: str, *focals: float | None) -> list[ImageRecord]:
    return [ImageRecord(name=f"{group}{i}", camera_group=group, focal_px=focal) for i, focal in enumerate(focals)]


def test_photos_of_one_zoom_share_a_lens() -> None:
    """Equivalents are rounded; photos without one are of the same lens."""
    assert lens_groups(photos("phone", 1000.0, 1040.0, None, 1075.0)) == ["phone"] * 4
    without = ImageRecord(name="x", width=30, height=20)
    assert lens_groups([without]) == ["30x20"]


def test_a_digital_zoom_has_a_lens_of_its_own() -> None:
    names = lens_groups([*photos("phone", 1000.0, 2000.0, 1020.0, None, 2000.0), *photos("other", 1000.0)])
    assert names[0] == names[2] != names[1] == names[4]
    assert names[3] == "phone", "nobody knows"
    assert names[5] == "other"
