"""Frames of a video: codecs, sharpest of each stretch, stored rotation, damage."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from fieldwork.nerfcore.capture.ingest import new
from fieldwork.nerfcore.capture.video import extract_frames
from fieldwork.nerfcore.errors import Cancelled, InputError
from fieldwork.nerfcore.params import NewParams, PosesParams
from fieldwork.nerfcore.poses.estimate import pose_job
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.photos import folder_of
from PIL import Image, ImageFilter

COUNT, SHARP_EVERY = 48, 6


def frame_picture(i: int) -> Image.Image:
    """A picture that moves; only every sixth frame is sharp. The top-left corner is red."""
    rng = np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 255, (30, 60, 3), np.uint8)).resize((480, 240), Image.Resampling.NEAREST)
    view = coarse.crop((2 * i, i, 2 * i + 320, i + 192))
    if i % SHARP_EVERY != 2:
        view = view.filter(ImageFilter.GaussianBlur(3))
    view.paste((255, 0, 0), (0, 0, 60, 40))
    return view


def encode(path: Path, codec: str, pixels: str = "yuv420p", rotation: int = 0, transfer: int = 2) -> Path:
    """A video of `COUNT` frames at 24 frames a second; `rotation` as a phone stores it (counter-clockwise)."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=24)
        turned = rotation % 180 != 0
        stream.width, stream.height = (192, 320) if turned else (320, 192)
        stream.pix_fmt = pixels
        stream.codec_context.color_trc = transfer
        if rotation:
            stream.set_display_rotation(rotation)
        for i in range(COUNT):
            picture = frame_picture(i).rotate(-rotation, expand=True)
            container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        container.mux(stream.encode())
    return path


def numbers(paths: list[Path]) -> list[int]:
    return [int(path.stem.rsplit("_", 1)[1]) for path in paths]


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "libx265", "yuv420p"),
        ("b.mov", "prores_ks", "yuv422p10le"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("b.mp4", "libsvtav1", "yuv420p"),
    ],
)
def test_codecs_and_sharpest_frames(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    video = encode(tmp_path / name, codec, pixels)
    paths = extract_frames(video, tmp_path / "frames", COUNT // SHARP_EVERY, Reporter())
    assert len(paths) == COUNT // SHARP_EVERY
    assert numbers(paths) == list(range(2, COUNT, SHARP_EVERY))
    with Image.open(paths[3]) as image:
        difference = np.abs(np.asarray(image, float) - np.asarray(frame_picture(20), float))
    assert image.size == (320, 192)
    assert difference.mean() < 15


@pytest.mark.parametrize("rotation", [90, -90, 180])
def test_stored_rotation_is_applied(tmp_path: Path, rotation: int) -> None:
    video = encode(tmp_path / "a.mp4", "libx264", rotation=rotation)
    paths = extract_frames(video, tmp_path / "frames", 8, Reporter())
    with Image.open(paths[0]) as image:
        assert image.size == (320, 192)
        red, green, _ = image.convert("RGB").getpixel((20, 15))
    assert red > 200
    assert green < 60


@pytest.mark.parametrize("rotation", [0, 90])
def test_pixels_that_are_not_square_are_made_so(tmp_path: Path, rotation: int) -> None:
    """Anamorphic video: 240 × 192 pixels that are a third wider than high, shown as 320 × 192."""
    video = tmp_path / "a.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 240, 192, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        if rotation:
            stream.set_display_rotation(rotation)
        for i in range(12):
            container.mux(stream.encode(av.VideoFrame.from_image(frame_picture(i).resize((240, 192)))))
        container.mux(stream.encode())
    for path in extract_frames(video, tmp_path / "frames", 4, Reporter()):
        with Image.open(path) as image:
            assert image.size == ((192, 320) if rotation else (320, 192))


def test_verb_and_reuse(tmp_path: Path) -> None:
    video = encode(tmp_path / "Mein Video ü.mp4", "libx264")
    result = new(NewParams(photos=video, project=tmp_path / "p", frames=8), Reporter())
    assert result["images"] == 8
    project = load_project(tmp_path / "p")
    assert all(" " not in record.name for record in project.images)
    before = [(p.name, p.stat().st_mtime_ns) for p in sorted((tmp_path / "p" / "frames").glob("*.png"))]
    new(NewParams(photos=video, project=tmp_path / "p", frames=8), Reporter())
    assert before == [(p.name, p.stat().st_mtime_ns) for p in sorted((tmp_path / "p" / "frames").glob("*.png"))]


def test_truncated_and_foreign_files(tmp_path: Path) -> None:
    whole = encode(tmp_path / "a.webm", "libvpx-vp9").read_bytes()
    (tmp_path / "cut.webm").write_bytes(whole[: len(whole) // 2])
    report = Reporter()
    paths = extract_frames(tmp_path / "cut.webm", tmp_path / "frames", 12, report)
    assert 3 <= len(paths) <= 12  # what is there is used
    mp4 = encode(tmp_path / "a.mp4", "libx264").read_bytes()
    for name, data in (("headless.mp4", mp4[: len(mp4) // 2]), ("text.mp4", b"hello" * 100), ("empty.mp4", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=name):
            extract_frames(tmp_path / name, tmp_path / "other", 12, Reporter())


def test_a_video_that_ends_before_its_time_is_told(tmp_path: Path) -> None:
    """Half a file of some kinds is read to its end without an error."""
    video = encode(tmp_path / "whole.mkv", "libx264")
    report = Reporter()
    extract_frames(video, tmp_path / "whole", 12, report)
    assert report.warnings == []
    data = video.read_bytes()
    (tmp_path / "half.mkv").write_bytes(data[: len(data) // 2])
    paths = extract_frames(tmp_path / "half.mkv", tmp_path / "half", 12, report)
    assert 0 < len(paths) < 10
    (text,) = report.warnings
    assert f"of its 2.0 s, as if it had been cut off: {len(paths)} frames were chosen instead of 12" in text


def test_sound_only(tmp_path: Path) -> None:
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        for _ in range(10):
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InputError, match="only sound"):
        extract_frames(path, tmp_path / "frames", 12, Reporter())


def test_cancel(tmp_path: Path) -> None:
    video = encode(tmp_path / "a.mp4", "libx264")
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        extract_frames(video, tmp_path / "frames", 12, report)


def test_photos_in_a_folder_called_frames_are_no_video(tmp_path: Path) -> None:
    """Photos need not lie in the order they were taken in."""
    for photos, is_video in ((folder_of(tmp_path / "frames"), False), (encode(tmp_path / "a.mp4", "libx264"), True)):
        project = tmp_path / f"project {is_video}"
        new(NewParams(project=project, photos=photos, frames=4), Reporter())
        job = pose_job(project, load_project(project), PosesParams(project=project), Reporter())
        assert job["video"] is is_video


def test_frames_of_a_video_of_unknown_length_are_from_all_of_it(tmp_path: Path) -> None:
    """As recorders write it that do not come back to say how long it became."""
    path = tmp_path / "a.webm"
    with av.open(str(path), "w", options={"live": "1"}) as container:
        stream = container.add_stream("libvpx-vp9", rate=1)
        stream.width, stream.height, stream.pix_fmt = 320, 192, "yuv420p"
        for i in range(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_image(frame_picture(i))))
        container.mux(stream.encode())
    with av.open(str(path)) as container:
        assert not container.duration
        assert not container.streams.video[0].frames
    found = numbers(extract_frames(path, tmp_path / "frames", 8, Reporter()))
    assert found == [2 + 6 * i for i in range(8)]


def test_titles_of_a_video_need_not_be_utf_8(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "Cafe Mueller"
        stream = container.add_stream("mpeg4", rate=24)
        stream.width, stream.height, stream.pix_fmt = 320, 192, "yuv420p"
        for i in range(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_image(frame_picture(i))))
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes().replace(b"Cafe Mueller", b"Caf\xe9 M\xfcller "))
    assert b"Caf\xe9" in path.read_bytes()
    assert len(extract_frames(path, tmp_path / "frames", 8, Reporter())) == 8


def test_frames_are_known_from_whatever_folder_it_runs_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "va").mkdir()
    encode(tmp_path / "va" / "clip.mp4", "libx264")
    for folder, place in (("va", Path()), (".", Path("va"))):
        monkeypatch.chdir(tmp_path / folder)
        new(NewParams(project=place / "proj", photos=place / "clip.mp4", frames=4), Reporter())
        assert len(load_project(place / "proj").images) == 4


@pytest.mark.parametrize(("transfer", "name"), [(18, "HLG"), (16, "PQ"), (1, "")])
def test_hdr_videos_are_told(tmp_path: Path, transfer: int, name: str) -> None:
    report = Reporter()
    extract_frames(encode(tmp_path / "a.mp4", "libx265", "yuv420p10le", transfer=transfer), tmp_path / "f", 4, report)
    told = [warning for warning in report.warnings if "HDR" in warning]
    assert len(told) == bool(name)
    assert all(f"a.mp4 is an HDR video ({name})" in warning for warning in told)
