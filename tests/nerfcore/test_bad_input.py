"""Bad input at the command line: a clear sentence, the right exit code, and a project that can go on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.tests.nerfcore.support.photos import folder_of, picture
from PIL import Image


def command(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict]:
    """Exit code and the JSON object that a command prints."""
    capfd.readouterr()
    code = main([str(a) for a in arguments] + ["--json"])
    return code, json.loads(capfd.readouterr().out)


def nothing(folder: Path) -> None: ...


def one_empty_file(folder: Path) -> None:
    (folder / "a.jpg").touch()


def one_truncated(folder: Path) -> None:
    picture().save(folder / "a.jpg")
    data = (folder / "a.jpg").read_bytes()
    (folder / "a.jpg").write_bytes(data[: len(data) // 2])


def one_text(folder: Path) -> None:
    (folder / "a.jpg").write_text("no photo")


def one_panorama(folder: Path) -> None:
    Image.new("RGB", (20000, 2000), (90, 120, 30)).save(folder / "a.jpg", quality=60)


def one_document(folder: Path) -> None:
    (folder / "a.docx").write_bytes(b"PK")


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (nothing, "There are no photos in"),
        (one_empty_file, "the file is empty (0 bytes)"),
        (one_truncated, "truncated"),
        (one_text, "not an image"),
        (one_panorama, "a panorama (20000×2000)"),
        (one_document, "There are no photos in"),
    ],
)
def test_nothing_usable(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], write: Callable[[Path], None], sentence: str
) -> None:
    photos, project = tmp_path / "photos", tmp_path / "p"
    photos.mkdir()
    write(photos)
    code, answer = command(capfd, "new", project, "--photos", photos)
    assert code == 1
    assert sentence in answer["error"]["message"]
    assert answer["error"]["hint"]
    assert not (project / "project.json").exists()
    # The same command, once there are photos.
    for i in range(3):
        picture(i).save(photos / f"good{i}.jpg", quality=95)
    code, answer = command(capfd, "new", project, "--photos", photos)
    assert (code, answer["images"]) == (0, 3)


def alike(folder: Path) -> None:
    for i in range(5):
        picture().save(folder / f"{i}.jpg", quality=95)


def one(folder: Path) -> None:
    picture().save(folder / "only.jpg", quality=95)


def walls(folder: Path) -> None:
    for i in range(4):
        ramp = np.linspace(150 + 10 * i, 190, 400)[None, :, None].repeat(300, 0).repeat(3, 2)
        Image.fromarray(ramp.astype(np.uint8)).save(folder / f"{i}.png")


def strangers(folder: Path) -> None:
    for i in range(4):
        blocks = np.random.default_rng(i).integers(0, 255, (45, 60, 3), np.uint8)
        Image.fromarray(blocks).resize((900, 675), Image.Resampling.BICUBIC).save(folder / f"{i}.jpg", quality=95)


@pytest.mark.parametrize(
    ("write", "used", "sentence"),
    [
        (one, 1, "has 1 usable photo (0 rejected); poses need at least 3"),
        (alike, 1, "has 1 usable photo (4 rejected); poses need at least 3"),
        (walls, 4, "too little texture"),
        (strangers, 4, "match no other photo"),
    ],
)
def test_nothing_can_be_placed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], write: Callable[[Path], None], used: int, sentence: str
) -> None:
    photos, project = tmp_path / "photos", tmp_path / "p"
    photos.mkdir()
    write(photos)
    code, answer = command(capfd, "new", project, "--photos", photos)
    assert (code, answer["images"]) == (0, used)
    code, answer = command(capfd, "poses", project, "--preset", "fast")
    assert code == 1
    assert sentence in answer["error"]["message"]
    assert answer["error"]["hint"]
    assert not (project / "poses" / "poses.json").exists()


@pytest.mark.slow
def test_a_project_that_failed_goes_on_with_further_photos(
    shared_data: Callable[[str], Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    photos, project, more = tmp_path / "photos", tmp_path / "p", tmp_path / "more"
    photos.mkdir()
    strangers(photos)
    assert command(capfd, "new", project, "--photos", photos)[0] == 0
    assert command(capfd, "poses", project, "--preset", "fast")[0] == 1
    more.mkdir()
    for path in sorted((shared_data("fountain_p11") / "images").iterdir())[3:9]:
        shutil.copy(path, more)
    code, answer = command(capfd, "new", project, "--photos", more, "--add", "--max-size", "800")
    assert (code, answer["images"]) == (0, 10)
    code, answer = command(capfd, "poses", project, "--preset", "fast", "--strict")
    assert (code, answer["registered"], answer["total"]) == (3, 6, 10)
    assert {i["reason"] for i in answer["images"] if i["status"] != "ok"} == {"matches no other photo"}
    assert any("4 of 10 photos have no pose" in warning for warning in answer["warnings"])


def test_bad_files_among_good_ones_are_a_warning(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    photos = folder_of(tmp_path / "photos", 4)
    one_empty_file(photos)
    picture(9).save(photos / "b.jpg", format="PNG")  # a PNG by its content: used
    code, answer = command(capfd, "new", tmp_path / "p", "--photos", photos, "--strict")
    assert (code, answer["images"]) == (3, 5)
    assert answer["rejected"] == [{"file": "a.jpg", "reason": "the file is empty (0 bytes)"}]
    assert command(capfd, "new", tmp_path / "p", "--photos", photos)[0] == 0


def test_what_excludes_each_other_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for cameras in (["--test", "--orbit", 4], ["--all", "--camera", "cameras.json"], ["--test", "--all"]):
        code, answer = command(capfd, "render", tmp_path, "--out", tmp_path / "r", *cameras)
        assert (code, answer["error"]["code"]) == (2, "usage")
        assert "give one of test, all, camera and orbit" in answer["error"]["message"]


@pytest.mark.parametrize("words", [["batch", "list.csv", "--storage", "s3://x/y"], ["blocks", "p", "--wheel", "f.whl"]])
def test_what_only_a_cluster_uses_is_not_left_out_silently(words: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    code, answer = command(capfd, *words)
    assert (code, answer["error"]["code"]) == (2, "usage")
    assert f"{words[2][2:]}: only workers of a cluster use it" in answer["error"]["message"]


def test_defaults_are_shown_as_they_are_written(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--help"]) == 0
    assert "[default: 480x320]" in " ".join(capfd.readouterr().out.split())
