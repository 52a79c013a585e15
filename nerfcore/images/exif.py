"""What EXIF says that poses and provenance need: camera, focal length, time, place."""

from __future__ import annotations

from typing import Any

from PIL import ExifTags, Image

BASE, GPS = ExifTags.Base, ExifTags.GPS
INCH_PER_UNIT = {2: 1.0, 3: 2.54, 4: 25.4, 5: 25400.0}  # FocalPlaneResolutionUnit: units in an inch


def photo_facts(exif: Image.Exif, stored_size: tuple[int, int]) -> dict[str, Any]:
    """The useful facts of an EXIF block, as plain JSON values; absent ones are left out.

    Keys: make, model, lens, focal_mm, focal_35mm, focal_px (for `stored_size`, in pixels of the original), time,
    gps {latitude, longitude (degrees), altitude (metres)}, exposure_s, iso.
    """
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    facts: dict[str, Any] = {}
    for key, value in (
        ("make", exif.get(BASE.Make)),
        ("model", exif.get(BASE.Model)),
        ("lens", detail.get(BASE.LensModel)),
        ("time", detail.get(BASE.DateTimeOriginal) or exif.get(BASE.DateTime)),
    ):
        if text := _text(value):
            facts[key] = text
    for key, value in (
        ("focal_mm", detail.get(BASE.FocalLength)),
        ("focal_35mm", detail.get(BASE.FocalLengthIn35mmFilm)),
        ("exposure_s", detail.get(BASE.ExposureTime)),
        ("iso", _first(detail.get(BASE.ISOSpeedRatings))),
    ):
        number = _number(value)
        if number is not None and number > 0:
            facts[key] = number
    focal = _focal_px(detail, facts, stored_size)
    if focal:
        facts["focal_px"] = focal
    if position := _gps(exif.get_ifd(ExifTags.IFD.GPSInfo)):
        facts["gps"] = position
    return facts


def _focal_px(detail: dict[Any, Any], facts: dict[str, Any], size: tuple[int, int]) -> float | None:
    """Focal length in pixels: from the 35 mm equivalent (36 mm frame), else from the sensor's pixel density.

    Both hold for the picture as the camera stored it. Where EXIF gives that one's size, this file's scale is the
    larger ratio of their sides, which is right after shrinking and after cropping along one side.
    """
    original = [_number(detail.get(tag)) or 0.0 for tag in (BASE.ExifImageWidth, BASE.ExifImageHeight)]
    known = min(original) > 0
    scale = max(max(size) / max(original), min(size) / min(original)) if known else 1.0
    if "focal_35mm" in facts:
        focal = facts["focal_35mm"] / 36.0 * (max(original) * scale if known else max(size))
    else:
        density = _number(detail.get(BASE.FocalPlaneXResolution))
        unit = INCH_PER_UNIT.get(int(_number(detail.get(BASE.FocalPlaneResolutionUnit)) or 2), 1.0)
        if "focal_mm" not in facts or not density or not known:
            return None
        focal = facts["focal_mm"] / 25.4 * density * unit * scale
    # Some phones and scanners write nonsense; no usable lens is outside this range.
    return focal if 0.2 * max(size) < focal < 30 * max(size) else None


def _gps(block: dict[Any, Any]) -> dict[str, float] | None:
    latitude = _degrees(block.get(GPS.GPSLatitude), block.get(GPS.GPSLatitudeRef), "S")
    longitude = _degrees(block.get(GPS.GPSLongitude), block.get(GPS.GPSLongitudeRef), "W")
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    position = {"latitude": latitude, "longitude": longitude}
    altitude = _number(block.get(GPS.GPSAltitude))
    if altitude is not None:
        below = block.get(GPS.GPSAltitudeRef) in (1, b"\x01", "1")
        position["altitude"] = -altitude if below else altitude
    return position


def _degrees(value: Any, reference: Any, negative: str) -> float | None:
    if not isinstance(value, (tuple, list)) or len(value) != 3:
        return None
    parts = [_number(part) for part in value]
    if any(part is None for part in parts):
        return None
    degrees = sum(part / 60**i for i, part in enumerate(parts) if part is not None)
    return -degrees if str(reference).strip("\x00 b'").upper().startswith(negative) else degrees


def _first(value: Any) -> Any:
    return value[0] if isinstance(value, (tuple, list)) and value else value


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if number == number and abs(number) != float("inf") else None


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value.replace("\x00", "").strip() if isinstance(value, str) else ""
