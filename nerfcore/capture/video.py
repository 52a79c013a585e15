"""Frames of a video: the sharpest of each stretch of time, upright."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import scipy
from PIL import Image

from ..errors import InputError
from ..files import atomic_path, write_json
from ..progress import Reporter
from ..project.store import FRAMES_FILE

GREY_WIDTH = 640  # pixels, at which the sharpness of frames is compared; not tuned
HDR = {16: "PQ", 18: "HLG"}  # transfer characteristics of ITU-T H.273
WHOLE = 0.8  # of the time that a video says it takes, for which there must be pictures; not tuned


def extract_frames(video: Path, folder: Path, count: int, report: Reporter) -> list[Path]:
    """Save the sharpest frame of each of `count` equal stretches of a video as PNG files in `folder`.

    The rotation stored with the video (phones) is applied, and pixels that are not square are made so. A finished extraction of the same file is reused.

    Returns:
        the frame files, in time order: `<video name>_<frame number>.png`.
    Raises:
        InputError: the file is no video, has no picture, or is damaged from the start.
    """
    stat = video.stat()
    key = [str(video), stat.st_size, stat.st_mtime, count]
    finished = _finished(folder, key)
    if finished:
        return finished
    chosen: list[Path] = []
    best: tuple[float, int, Image.Image] | None = None
    current, duration, reached, damaged = 0, 0.0, 0.0, False
    try:
        with _opened(video) as container:
            if not container.streams.video:
                raise InputError(f"{video} has no pictures, only sound.", "Choose another video.")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            duration = _duration(container, stream) or _length(video)
            aspect = float(stream.sample_aspect_ratio or 1)
            if hdr := HDR.get(stream.codec_context.color_trc):
                report.warn(
                    f"{video.name} is an HDR video ({hdr}), whose brightness is not brought to that of a screen: colours are "
                    "flat and differ from the scene's. Record without HDR, or convert it to SDR first."
                )
            for number, seconds, frame in _frames(container, stream):
                if number % 10 == 0:
                    report.progress(min(seconds / duration, 1.0), f"{len(chosen)} frames chosen")
                reached = seconds + 1 / float(stream.average_rate or 30)
                window = min(int(seconds / duration * count), count - 1)
                if window != current and best is not None:
                    chosen.append(_save(best, video, folder))
                    best = None
                current = window
                value = frame_sharpness(frame)
                if best is None or value > best[0]:
                    best = value, number, _upright(frame, aspect)
    except av.FFmpegError as error:
        if len(chosen) < 4:
            raise InputError(
                f"{video} cannot be decoded: {error}.", "Convert it to MP4 (H.264) and try again."
            ) from error
        damaged = True
        report.warn(f"{video.name} is damaged after {len(chosen)} chosen frames: {error}. The rest is left out.")
    if best is not None:
        chosen.append(_save(best, video, folder))
    if not chosen:
        raise InputError(f"{video} has no pictures.", "Choose another video.")
    if len(chosen) < count and reached < WHOLE * duration and not damaged:
        report.warn(
            f"{video.name} ends after {reached:.1f} of its {duration:.1f} s, as if it had been cut off: {len(chosen)} frames were "
            f"chosen instead of {count}. Copy it once more, or choose more frames (--frames)."
        )
    write_json(folder / FRAMES_FILE, {"key": key, "files": [path.name for path in chosen]})
    return chosen


def _opened(video: Path) -> Any:
    """The container of a video. Its titles are not needed, and need not be UTF-8."""
    return av.open(str(video), metadata_errors="replace")


def _save(best: tuple[float, int, Image.Image], video: Path, folder: Path) -> Path:
    path = folder / f"{video.stem}_{best[1]:06d}.png"
    with atomic_path(path) as temporary:
        best[2].save(temporary, compress_level=1)
    return path


def every_nth(video: Path, count: int) -> int | None:
    """The n for which taking every n-th frame of a video, from the first, gives `count` frames; None if none or many do.

    Raises:
        InputError: the file is no video.
    """
    try:
        with _opened(video) as container:
            stream = container.streams.video[0]
            frames = stream.frames or sum(packet.pts is not None for packet in container.demux(stream))
    except (av.FFmpegError, IndexError) as error:
        raise InputError(f"{video} cannot be decoded: {error}.", "Choose another video.") from error
    found = [n for n in range(1, frames + 1) if -(-frames // n) == count]
    return found[0] if len(found) == 1 else None


def save_every_nth(video: Path, n: int, folder: Path) -> list[Path]:
    """Save every n-th frame of a video, from the first, upright, as PNG files in `folder`, in order.

    Raises:
        InputError: the video cannot be decoded to its end.
    """
    paths = []
    try:
        with _opened(video) as container:
            for number, frame in enumerate(container.decode(container.streams.video[0])):
                if number % n == 0:
                    paths.append(folder / f"{video.stem}_{number:06d}.png")
                    _upright(frame).save(paths[-1], compress_level=1)
    except av.FFmpegError as error:
        raise InputError(f"{video} cannot be decoded: {error}.", "Choose another video.") from error
    return paths


def _finished(folder: Path, key: list[Any]) -> list[Path]:
    try:
        index = json.loads((folder / FRAMES_FILE).read_text(encoding="utf-8"))
        paths = [folder / name for name in index["files"]]
        return paths if index["key"] == json.loads(json.dumps(key)) and all(p.is_file() for p in paths) else []
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _duration(container: Any, stream: Any) -> float | None:
    """Seconds of video as the container says, or by its number of frames; None where it does not say, as of recordings that
    were written while they were made."""
    if stream.duration and stream.time_base:
        return max(float(stream.duration * stream.time_base), 1e-3)
    if container.duration:
        return max(container.duration / av.time_base, 1e-3)
    return max(stream.frames / float(stream.average_rate or 30), 1e-3) if stream.frames else None


def _length(video: Path) -> float:
    """Seconds of video by the times of its packets, which are read but not decoded."""
    with _opened(video) as container:
        stream = container.streams.video[0]
        times, count = [], 0
        for packet in container.demux(stream):
            count += packet.size > 0
            if packet.pts is not None and stream.time_base:
                times.append(float((packet.pts + (packet.duration or 0)) * stream.time_base))
    return max(max(times) - min(times), 1e-3) if len(times) > 1 else max(count / float(stream.average_rate or 30), 1e-3)


def _frames(container: Any, stream: Any) -> Iterator[tuple[int, float, Any]]:
    start: float | None = None
    for number, frame in enumerate(container.decode(stream)):
        seconds = float(frame.time) if frame.time is not None else number / float(stream.average_rate or 30)
        start = seconds if start is None else start
        yield number, max(seconds - start, 0.0), frame


def frame_sharpness(frame: Any) -> float:
    """Variance of the Laplacian of a frame's grey values at a width of 640 pixels."""
    height = max(2, round(frame.height * GREY_WIDTH / frame.width))
    grey = frame.reformat(GREY_WIDTH, height, "gray").to_ndarray()
    return float(scipy.ndimage.laplace(grey.astype(np.float32)).var())


def _upright(frame: Any, aspect: float = 1.0) -> Image.Image:
    """The frame as it is meant to be seen; `aspect`: width of its pixels by their height."""
    image = frame.to_image()
    if abs(aspect - 1) > 0.01:
        image = image.resize((max(1, round(image.width * aspect)), image.height), Image.Resampling.LANCZOS)
    turns = round(frame.rotation / 90) % 4  # counter-clockwise quarter turns that make it upright
    return image.rotate(90 * turns, expand=True) if turns else image
