"""Photos of one camera at several zooms: phones crop the picture, and note only another 35 mm equivalent."""

from __future__ import annotations

from collections.abc import Sequence

from ..project.schema import ImageRecord

STEP = 1.15  # between the focal lengths of two zooms; equivalents are rounded to whole millimetres; not tuned


def lens_groups(records: Sequence[ImageRecord]) -> list[str]:
    """For each photo the name of the lens model that it shares with others: that of its camera group, and of its zoom where
    the group has several by EXIF."""
    groups: dict[str, list[ImageRecord]] = {}
    for record in records:
        groups.setdefault(record.camera_group or f"{record.width}x{record.height}", []).append(record)
    named = {r.name: name for group, members in groups.items() for r, name in _by_zoom(group, members)}
    return [named[record.name] for record in records]


def _by_zoom(group: str, members: list[ImageRecord]) -> list[tuple[ImageRecord, str]]:
    known = sorted((r for r in members if r.focal_px), key=lambda r: r.focal_px or 0.0)
    zooms: list[list[ImageRecord]] = []
    for record in known:
        if not zooms or (record.focal_px or 0.0) > STEP * (zooms[-1][-1].focal_px or 0.0):
            zooms.append([])
        zooms[-1].append(record)
    if len(zooms) < 2:
        return [(record, group) for record in members]
    named = [(record, f"{group}, zoom {number}") for number, zoom in enumerate(zooms) for record in zoom]
    return named + [(record, group) for record in members if not record.focal_px]
