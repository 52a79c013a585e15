"""What encoders made of photos, kept on disk: PROJECT/jobs/embeddings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...files import atomic_path
from ...images.picture import over
from ...images.working import read_picture
from ...project.fingerprints import digest
from ...project.schema import ImageRecord
from ..lookup import UNREADABLE
from .segmenter import Segmenter

FOLDER = "jobs/embeddings"
KEPT = 48  # the oldest go first


def photo_pixels(folder: Path, photo: ImageRecord) -> np.ndarray:
    """A photo (H, W, 3) uint8 over white. Raises InputError."""
    return (over(read_picture(folder / photo.file), 1.0).pixels[..., :3] * 255 + 0.5).astype(np.uint8)


def embedded(folder: Path, photo: ImageRecord, model: Segmenter) -> tuple[list[np.ndarray], bool]:
    """What the decoder needs of a photo, and whether it was there already. Raises InputError, DiskError."""
    encoder, file = model.encoder.path.stat(), (folder / photo.file).stat()
    made = [str(model.encoder.path), encoder.st_mtime_ns, encoder.st_size, photo.file, file.st_mtime_ns, file.st_size]
    path = folder / FOLDER / f"{digest(made)[:32]}.npz"
    known = _read(path, len(model.embeddings))
    if known is not None:
        return known, True
    values = model.encode(photo_pixels(folder, photo))
    with atomic_path(path) as temporary, open(temporary, "wb") as out:
        np.savez(out, *[value.astype(np.float16) for value in values])
    for old in sorted(path.parent.glob("*.npz"), key=lambda p: p.stat().st_mtime)[:-KEPT]:
        old.unlink(missing_ok=True)
    return [value.astype(np.float16).astype(np.float32) for value in values], False


def _read(path: Path, count: int) -> list[np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            return [data[f"arr_{number}"].astype(np.float32) for number in range(count)]
    except UNREADABLE:
        return None
