"""The verb `new`: working copies, reasons for bad files, running again after whatever happened."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.capture import ingest, select, working_copies
from fieldwork.nerfcore.capture.find import list_photos
from fieldwork.nerfcore.errors import Cancelled, DiskError, InputError, ProjectError
from fieldwork.nerfcore.images.decode import read_photo
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import ImageRecord
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.photos import exif, folder_of, new, picture
from PIL import Image, ImageFilter


def test_working_copies(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "Fotos mit Ümlaut")
    picture(7, (1000, 625)).save(photos / "big.png", exif=exif(1))
    result = new(photos, tmp_path / "Projekt ß", max_size=500)
    assert result["images"] == 4
    project = load_project(tmp_path / "Projekt ß")
    big = next(record for record in project.images if record.name == "big")
    assert (big.width, big.height) == (500, 312)
    assert big.file == "images/big.png"
    with Image.open(tmp_path / "Projekt ß" / big.file) as image:
        assert image.size == (500, 312)
    assert big.focal_px == pytest.approx(45 / 36 * 500)
    assert big.sha256 == ingest.file_hash(photos / "big.png")
    assert big.camera_group == "Maker Model X 30.0mm 500x312"
    assert project.provenance[0].verb == "new"


def test_several_cameras_and_equal_names(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for i, camera in enumerate(("left", "right")):
        (photos / camera).mkdir(parents=True)
        for k in range(2):
            picture(10 * i + k).save(photos / camera / f"{k}.jpg", quality=95)
    new(photos, tmp_path / "p")
    assert [record.name for record in load_project(tmp_path / "p").images] == ["left_0", "left_1", "right_0", "right_1"]


def test_bad_files_have_reasons(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 4)
    (photos / "empty.jpg").touch()
    (photos / "text.jpg").write_text("this is not a photo")
    whole = (photos / "p0.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    picture(50).save(photos / "really a png.jpg", format="PNG")
    shutil.copy(photos / "p1.jpg", photos / "z copy.jpg")
    picture(2).save(photos / "z recompressed.jpg", quality=90)
    picture(9, (900, 200)).save(photos / "pano.jpg")
    picture(9, (40, 30)).save(photos / "tiny.jpg")
    (photos / "layers.psd").write_bytes(b"8BPS")
    (photos / "notes.txt").write_text("x")
    result = new(photos, tmp_path / "p")
    reasons = {entry["file"]: entry["reason"] for entry in result["rejected"]}
    assert result["images"] == 5  # four good ones and the PNG with the wrong extension
    assert "empty" in reasons["empty.jpg"]
    assert "not an image" in reasons["text.jpg"]
    assert "truncated" in reasons["cut.jpg"]
    assert reasons["z copy.jpg"] == "the same picture as p1.jpg"
    assert reasons["z recompressed.jpg"] == "the same picture as p2.jpg"
    assert "panorama" in reasons["pano.jpg"]
    assert "too small" in reasons["tiny.jpg"]
    assert ".psd" in reasons["layers.psd"]
    assert set(reasons) == {
        "empty.jpg", "text.jpg", "cut.jpg", "z copy.jpg", "z recompressed.jpg", "pano.jpg", "tiny.jpg", "layers.psd",
    }  # fmt: skip


def test_huge_panorama_is_refused_without_much_memory(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    Image.new("RGB", (20000, 4000), (90, 120, 30)).save(photos / "pano.jpg", quality=60)
    Image.new("RGB", (20000, 10000), (90, 120, 30)).save(photos / "sphere.jpg", quality=60)
    result = new(photos, tmp_path / "p")
    assert result["rejected"] == [
        {"file": f"{name}.jpg", "reason": f"a panorama ({size}): poses need single photos, not stitched ones"}
        for name, size in (("pano", "20000×4000"), ("sphere", "20000×10000"))
    ]


def test_all_identical(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(5):
        picture().save(photos / f"{i}.jpg", quality=95)
    result = new(photos, tmp_path / "p")
    assert result["images"] == 1
    assert len(result["rejected"]) == 4


def test_blurred_photo_is_left_out_and_can_be_kept(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 9)
    picture(20).filter(ImageFilter.GaussianBlur(4)).save(photos / "shaky.jpg", quality=95)
    result = new(photos, tmp_path / "p")
    assert [entry["file"] for entry in result["rejected"]] == ["shaky.jpg"]
    assert result["rejected"][0]["reason"].startswith("blurred")
    assert new(photos, tmp_path / "q", keep_blurry=True)["images"] == 10


def test_empty_missing_and_useless_folders(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="There are no photos"):
        new(tmp_path / "empty", tmp_path / "p")
    with pytest.raises(InputError, match="does not exist"):
        new(tmp_path / "nowhere", tmp_path / "p")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.jpg").touch()
    with pytest.raises(InputError, match=r"None of the 1 files.*a\.jpg: the file is empty"):
        new(tmp_path / "bad", tmp_path / "p")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match="neither a folder of photos nor a video"):
        new(tmp_path / "a.txt", tmp_path / "p")
    assert not (tmp_path / "p" / "project.json").exists()


def test_projects_among_the_photos_are_left_out(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    new(photos, tmp_path / "other")
    shutil.copytree(tmp_path / "other", photos / "earlier")
    (photos / "p" / "frames").mkdir(parents=True)  # left by a run that was stopped before it had a project.json
    picture(9).save(photos / "p" / "frames" / "f0.png")
    for _ in range(2):
        assert new(photos, photos / "p")["images"] == 3
        assert [record.name for record in load_project(photos / "p").images] == ["p0", "p1", "p2"]
    assert ingest.ingested(NewParams(photos=photos, project=photos / "p")).result is not None


@pytest.mark.parametrize("inner", ["", "images"])
def test_photos_are_never_overwritten_by_working_copies(tmp_path: Path, inner: str) -> None:
    photos = folder_of(tmp_path / "p" / inner)
    before = {path: path.read_bytes() for path in photos.iterdir()}
    with pytest.raises(InputError, match=r"The photos in .* lie where the project .* keeps its own files"):
        new(photos, tmp_path / "p", max_size=64)
    assert {path: path.read_bytes() for path in photos.iterdir()} == before


def test_label_maps_are_never_overwritten_by_working_copies(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "p" / "photos")
    (tmp_path / "p" / "labels").mkdir()
    with pytest.raises(InputError, match="The labels in"):
        new(photos, tmp_path / "p", labels=tmp_path / "p" / "labels")


def test_unreadable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests may run as root, which reads everything: the refusal is simulated at os.scandir."""
    photos = folder_of(tmp_path / "photos")

    def refuse(path: str) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(InputError, match=r"cannot be read: Permission denied"):
        list_photos(photos)


@pytest.mark.parametrize("verb", ["new", "import"])
def test_unreadable_folder_for_real(tmp_path: Path, verb: str) -> None:
    """The command line without root's right to read everything."""
    photos = folder_of(tmp_path / "photos")
    photos.chmod(0)
    arguments = {
        "new": [str(tmp_path / "p"), "--photos", str(photos)],
        "import": [str(photos), str(tmp_path / "p")],
    }[verb]
    command = [sys.executable, "-m", "fieldwork.nerfcore", verb, *arguments, "--json"]
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root reads everything, and setpriv is not here to take that right")
        rights = "-dac_override,-dac_read_search"
        command = ["setpriv", "--bounding-set", rights, "--inh-caps", rights, *command]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    finally:
        photos.chmod(0o755)
    assert done.returncode == 1, done.stderr
    assert json.loads(done.stdout)["error"]["message"] == f"{photos} cannot be read: Permission denied."
    assert not (tmp_path / "p").exists()


def test_one_photo_is_taken_with_a_warning(tmp_path: Path) -> None:
    report = Reporter()
    result = ingest.new(NewParams(photos=folder_of(tmp_path / "photos", 1), project=tmp_path / "p"), report)
    assert result["images"] == 1
    assert any("at least three" in warning for warning in report.warnings)


# --- running again --------------------------------------------------------------------------------------------------


def count_decodes(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    decoded: list[str] = []

    def counted(path: Path, *rest: object) -> object:
        decoded.append(path.name)
        return read_photo(path, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(working_copies, "read_photo", counted)
    return decoded


def test_cancelled_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = folder_of(tmp_path / "photos", 12)
    decoded = count_decodes(monkeypatch)

    class Stops(Reporter):
        def progress(self, fraction: float, message: str = "") -> None:
            if fraction > 0.4:
                self.cancel()
            self.check()

    with pytest.raises(Cancelled):
        ingest.new(NewParams(photos=photos, project=tmp_path / "p"), Stops())
    first = len(decoded)
    assert 4 <= first < 12
    assert not (tmp_path / "p" / "project.json").exists()
    assert new(photos, tmp_path / "p")["images"] == 12
    # What was finished is not done again; those under way when the stop came may be.
    assert len(decoded) <= 12 + 4
    before = len(decoded)
    assert new(photos, tmp_path / "p")["images"] == 12
    assert len(decoded) == before


def test_killed_and_run_again(tmp_path: Path) -> None:
    """Cut off by SIGKILL at any moment: no half file, and the next run finishes."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(8):
        picture(i, (1600, 1000)).save(photos / f"p{i}.png", compress_level=1)
    code = (
        "import sys; from pathlib import Path; from fieldwork.nerfcore.capture.ingest import new\n"
        "from fieldwork.nerfcore.params import NewParams; from fieldwork.nerfcore.progress import Reporter\n"
        f"new(NewParams(photos=Path({str(photos)!r}), project=Path({str(tmp_path / 'p')!r})), Reporter())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and not list((tmp_path / "p").glob("images/p*.png")):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert list((tmp_path / "p").glob("images/p*.png"))
    assert new(photos, tmp_path / "p")["images"] == 8
    files = {record.file for record in load_project(tmp_path / "p").images}
    assert {f"images/{name}" for name in os.listdir(tmp_path / "p" / "images")} == files
    for file in files:
        with Image.open(tmp_path / "p" / file) as image:
            image.load()


def test_changed_photo_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = folder_of(tmp_path / "photos")
    new(photos, tmp_path / "p")
    old = load_project(tmp_path / "p").images[1].sha256
    decoded = count_decodes(monkeypatch)
    picture(77).save(photos / "p1.jpg", quality=95)
    new(photos, tmp_path / "p")
    assert decoded == ["p1.jpg"]
    assert load_project(tmp_path / "p").images[1].sha256 != old


def test_another_capture_is_not_overwritten_but_can_be_added(tmp_path: Path) -> None:
    new(folder_of(tmp_path / "a"), tmp_path / "p")
    more = tmp_path / "b"
    more.mkdir()
    picture(30).save(more / "p0.jpg")  # the same name as one that is there
    picture(1).save(more / "again.jpg", quality=95)  # the same picture
    with pytest.raises(ProjectError, match="--add"):
        new(more, tmp_path / "p")
    result = new(more, tmp_path / "p", add=True)
    assert result["images"] == 4
    assert result["rejected"] == [{"file": "again.jpg", "reason": "the same picture as p1.jpg"}]
    names = [record.name for record in load_project(tmp_path / "p").images if record.status == "ok"]
    assert names == ["p0", "p1", "p2", "p0_b"]


def test_full_disk(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 8)
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(disk)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False) if shutil.which("mount") else None
    if mounted is None or mounted.returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        with pytest.raises(DiskError, match="No space left"):
            new(photos, disk / "p")
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        assert new(photos, disk / "p")["images"] == 8
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_damaged_memory_of_earlier_runs_only_costs_time(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    new(photos, tmp_path / "p")
    (tmp_path / "p" / working_copies.CACHE_FILE).write_text('{"p0": 3')
    assert new(photos, tmp_path / "p")["images"] == 3


def test_a_sharp_photo_of_a_plain_wall_is_no_blur(tmp_path: Path) -> None:
    """Its fine structures are weak, but as strong beside its coarse ones as those of the other photos."""
    photos = folder_of(tmp_path / "photos", 9)
    sharp = np.asarray(picture(20)).astype(float)
    for name, pixels in {
        "wall": sharp,
        "shaky": np.asarray(picture(21).filter(ImageFilter.GaussianBlur(4))).astype(float),
    }.items():
        plain = 128 + (pixels - pixels.mean()) * 0.22
        Image.fromarray(plain.clip(0, 255).astype(np.uint8)).save(photos / f"{name}.png")
    rejected = new(photos, tmp_path / "p")["rejected"]
    assert [entry["file"] for entry in rejected] == ["shaky.png"]
    assert "--keep-blurry" in rejected[0]["reason"]


def test_added_photos_stay_when_it_runs_again(tmp_path: Path) -> None:
    photos, project = folder_of(tmp_path / "photos"), tmp_path / "p"
    (tmp_path / "more").mkdir()
    picture(30).save(tmp_path / "more" / "p0.jpg")
    new(photos, project)
    new(tmp_path / "more", project, add=True)
    before = load_project(project).images
    assert new(photos, project)["images"] == 4
    assert load_project(project).images == before
    (photos / "p2.jpg").unlink()  # what is missing in its own folder is gone
    new(photos, project)
    assert [record.name for record in load_project(project).images] == ["p0", "p1", "p0_b"]


def test_few_of_many_photos_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twins are found, the first one is kept, and not every photo is compared with every other one."""
    random, count = np.random.default_rng(0), 400
    pictures = {f"{i}": random.uniform(0, 40, (64, 64)).astype(np.float32) + 0.4 * i for i in range(count)}
    pictures["399"], pictures["200"] = pictures["7"] + 0.4, pictures["7"] - 0.4
    records = [ImageRecord(name=name, source=f"{name}.jpg", sha256=name, width=9, height=9) for name in pictures]
    asked = []
    same = select.same_picture
    monkeypatch.setattr(select, "same_picture", lambda a, b: asked.append(1) or same(a, b))
    select.reject_duplicates(records, pictures)
    rejected = {record.name: record.reason for record in records if record.status == "rejected"}
    assert rejected == {"200": "the same picture as 7.jpg", "399": "the same picture as 7.jpg"}
    assert len(asked) < 10 * count


def test_a_raw_file_beside_the_cameras_own_picture_is_left_out(tmp_path: Path) -> None:
    for name in ("A/x.JPG", "A/x.CR2", "B/x.dng", "y.NEF", "y.heic", "z.arw", "z.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    photos, skipped, root = list_photos(tmp_path)
    assert sorted(p.relative_to(root).as_posix() for p in photos) == ["A/x.JPG", "B/x.dng", "y.heic", "z.arw", "z.png"]
    assert {s["file"]: s["reason"].split(", ")[1] for s in skipped} == {"x.CR2": "x.JPG", "y.NEF": "y.heic"}


def test_photos_keep_their_names_when_others_of_the_same_come(tmp_path: Path) -> None:
    """Marks, poses and runs know photos by name."""
    photos, project = tmp_path / "photos", tmp_path / "p"
    folder_of(photos / "cam1")
    new(photos, project)
    folder_of(photos / "cam0", 1)
    picture(9).save(photos / "cam0" / "p0.jpg", quality=95)
    picture(8).save(photos / "cam1" / "p1.png")
    new(photos, project)
    names = {Path(r.source).relative_to(photos).as_posix(): r.name for r in load_project(project).images}
    assert names == {
        "cam1/p0.jpg": "p0", "cam1/p1.jpg": "p1", "cam1/p2.jpg": "p2", "cam0/p0.jpg": "cam0_p0_jpg", "cam1/p1.png": "cam1_p1_png",
    }  # fmt: skip
    assert all((project / record.file).is_file() for record in load_project(project).images)


def test_added_photos_that_were_left_out_can_be_added_again(tmp_path: Path) -> None:
    project, more = tmp_path / "p", folder_of(tmp_path / "more", 12)
    new(folder_of(tmp_path / "photos", 9), project)
    for i in range(12):
        picture(20 + i).save(more / f"p{i}.jpg", quality=95)
    picture(23).filter(ImageFilter.GaussianBlur(6)).save(more / "p3.jpg", quality=95)
    before = new(more, project, add=True)
    assert [item["file"] for item in before["rejected"]] == ["p3.jpg"]
    images, files = before["images"], sorted(p.name for p in (project / "images").iterdir())
    again = new(more, project, add=True, keep_blurry=True)
    assert again["images"] == images + 1
    assert {item["reason"] for item in again["rejected"]} == {"it is in the project already"}
    records = load_project(project).images
    assert [r.status for r in records] == ["ok"] * 21
    assert len({r.name for r in records}) == 21
    assert sorted(p.name for p in (project / "images").iterdir()) == files


def test_two_paths_to_one_photo_are_one_however_often_it_runs(tmp_path: Path) -> None:
    photos, project = folder_of(tmp_path / "photos"), tmp_path / "p"
    (photos / "z_again.jpg").symlink_to(photos / "p0.jpg")
    for _ in range(2):
        new(photos, project)
        records = {record.name: record.status for record in load_project(project).images}
        assert records == {"p0": "ok", "p1": "ok", "p2": "ok", "z_again": "rejected"}
