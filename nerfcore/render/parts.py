"""Parts of a render, made by several programs: which frames of it are there."""

from __future__ import annotations

from pathlib import Path

from ..project.fingerprints import Fingerprint, read_made
from ..project.runs import RENDER_RECORD


def record_name(frames: tuple[int, int] | None) -> str:
    """The file in a folder of renders that tells what they, or a part of them, were made from."""
    whole = Path(RENDER_RECORD)
    return RENDER_RECORD if frames is None else f"{whole.stem}_{frames[0]:06d}-{frames[1]:06d}{whole.suffix}"


def forget_overwritten(out: Path, inputs: Fingerprint, names: list[str]) -> None:
    """Take away the records of renders of other fields, cameras or settings whose pictures are about to be overwritten: they
    would tell of pictures that are not there any more, also where the new ones are stopped halfway.

    Args:
        out: folder of the renders. names: of the frames to be rendered.
    """
    whole, wanted = Path(RENDER_RECORD), {Path(name).name for name in names}
    for record in (out / RENDER_RECORD, *out.glob(f"{whole.stem}_*-*{whole.suffix}")):
        made = read_made(record)
        frames = [] if made is None or made.inputs == inputs else made.result.get("frames", [])
        if wanted & {Path(frame).stem for frame in frames}:
            record.unlink(missing_ok=True)


def rendered_parts(out: Path, inputs: Fingerprint, names: list[str]) -> dict[str, list[Path]]:
    """The pictures of each frame that parts of the render have made of the same field, cameras and settings.

    Args:
        out: folder of the renders. names: of the frames that are wanted.
    """
    whole = Path(RENDER_RECORD)
    found: dict[str, list[Path]] = {}
    for record in sorted(out.glob(f"{whole.stem}_*-*{whole.suffix}")):
        made = read_made(record)
        if made is None or made.inputs != inputs:
            continue
        pictures = [out / Path(path).name for path in made.result.get("frames", [])]
        # The EXR comes last of a frame: its name is the frame's.
        of_frame: list[Path] = []
        for picture in pictures:
            of_frame.append(picture)
            if picture.suffix == ".exr":
                if all(path.is_file() for path in of_frame):
                    found[picture.stem] = of_frame
                of_frame = []
    return {name: found[name] for name in names if name in found}
