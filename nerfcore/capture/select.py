"""Which photos of a capture to leave out: duplicates and blurred ones, each with its reason."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..images.sharpness import SAME, focus, same_picture
from ..project.schema import ImageRecord

# Not tuned.
BLUR_SHARE = 0.1  # of the median sharpness of a camera's photos, below which one is left out
MIN_PHOTOS_TO_JUDGE = 8  # of a camera
FOCUS_SHARE = 0.3  # of the median focus of photos of the camera that are not doubtful
COMPARED = 8  # of those at most: each is decoded once more
TWIN = "the same picture as"  # begins the reason of a photo that another one makes needless


def reject_duplicates(
    records: Sequence[ImageRecord], pictures: dict[str, np.ndarray], earlier: Sequence[ImageRecord] = ()
) -> None:
    """Mark photos that repeat another one, byte for byte or saved again, as rejected (the later one of the two)."""
    first_with: dict[str, ImageRecord] = {record.sha256: record for record in earlier if record.sha256}
    kept: list[ImageRecord] = []
    # Pictures whose mean brightness differs by more than those of twins may do need not be compared.
    by_brightness: list[tuple[float, int]] = []
    for record in records:
        if record.status == "rejected":
            continue
        picture = pictures.get(record.name)
        mean = 0.0 if picture is None else float(picture.mean())
        twin = first_with.get(record.sha256)
        if twin is None:
            low, high = (bisect.bisect(by_brightness, (mean + side, -1)) for side in (-SAME, SAME))
            near = sorted(number for _, number in by_brightness[low:high])
            twin = next((kept[number] for number in near if _same(kept[number], record, pictures)), None)
        if twin is not None:
            record.status, record.reason = "rejected", f"{TWIN} {Path(twin.source).name}"
        else:
            first_with[record.sha256] = record
            bisect.insort(by_brightness, (mean, len(kept)))
            kept.append(record)


def _same(a: ImageRecord, b: ImageRecord, pictures: dict[str, np.ndarray]) -> bool:
    if (a.width, a.height) != (b.width, b.height) or a.name not in pictures or b.name not in pictures:
        return False
    return same_picture(pictures[a.name], pictures[b.name])


def reject_blurred(records: Sequence[ImageRecord], folder: Path) -> None:
    """Mark photos far less sharp than the rest of the capture as rejected.

    Each is compared with the median of the photos of its own camera, because lenses and subjects differ. Where little
    is seen, as on a plain wall, little is sharp: such a photo is kept where its finest structures are as strong beside
    its coarser ones as those of the others. `folder`: the project, which has the working copies.
    """
    groups: dict[str, list[ImageRecord]] = {}
    for record in records:
        if record.status == "ok" and record.sharpness is not None:
            groups.setdefault(record.camera_group, []).append(record)
    for group in groups.values():
        if len(group) < MIN_PHOTOS_TO_JUDGE:
            continue
        median = float(np.median([record.sharpness or 0.0 for record in group]))
        doubtful = [record for record in group if (record.sharpness or 0.0) < BLUR_SHARE * median]
        if not doubtful:
            continue
        clear = [record for record in group if record not in doubtful]
        usual = float(np.median([_focus(record, folder) for record in clear[:: -(-len(clear) // COMPARED)]]))
        for record in doubtful:
            if _focus(record, folder) < FOCUS_SHARE * usual:
                record.status = "rejected"
                record.reason = f"blurred: sharpness {record.sharpness:.0f}, the others have about {median:.0f}; --keep-blurry keeps it"


def _focus(record: ImageRecord, folder: Path) -> float:
    with Image.open(folder / record.file) as image:
        return focus(image)
