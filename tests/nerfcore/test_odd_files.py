"""Odd files among photos: each is left out by name, the others go on."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.data.readers import llff
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.images.arrays import read_array
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.photos import folder_of, picture
from PIL import Image


def latin(folder: Path) -> str:
    path = os.fsencode(folder) + b"/caf\xe9.jpg"
    with open(path, "wb") as file:
        picture(7).save(file, "JPEG")
    return "caf?.jpg"


def latin_folder(folder: Path) -> str:
    os.mkdir(os.fsencode(folder) + b"/caf\xe9")
    with open(os.fsencode(folder) + b"/caf\xe9/a.jpg", "wb") as file:
        picture(7).save(file, "JPEG")
    return "caf?"


def dangling(folder: Path) -> str:
    (folder / "gone.jpg").symlink_to(folder / "nowhere.jpg")
    return "gone.jpg"


def circular(folder: Path) -> str:
    (folder / "self.jpg").symlink_to("self.jpg")
    return "self.jpg"


def directory(folder: Path) -> str:
    (folder / "x.jpg").mkdir()
    return "x.jpg"


def pipe(folder: Path) -> str:
    os.mkfifo(folder / "pipe.jpg")
    return "pipe.jpg"


def linked_folder(folder: Path) -> str:
    folder_of(folder.parent / "elsewhere", 1)
    (folder / "more").symlink_to(folder.parent / "elsewhere")
    return "more"


def damaged(folder: Path) -> str:
    picture(7).save(folder / "b.avif")
    whole = (folder / "b.avif").read_bytes()
    (folder / "b.avif").write_bytes(whole.replace(b"av01", b"xx01"))
    return "b.avif"


def thin(folder: Path) -> str:
    Image.new("RGB", (20_000, 3)).save(folder / "line.jpg")
    return "line.jpg"


ODD = {
    latin: "not UTF-8",
    latin_folder: "not UTF-8",
    dangling: "leads nowhere",
    circular: "leads to itself",
    directory: "a folder",
    pipe: "not a file",
    linked_folder: "a link to a folder",
    damaged: "damaged",
    thin: "a panorama",
}


@pytest.mark.parametrize("write", ODD, ids=lambda write: write.__name__)
def test_an_odd_file_is_left_out_by_name(tmp_path: Path, write) -> None:
    photos = folder_of(tmp_path / "photos", 3)
    name = write(photos)
    params = NewParams(photos=photos, project=tmp_path / "p")
    result = ingest.new(params, Reporter())
    assert result["images"] == 3
    assert [item["file"] for item in result["rejected"]] == [name]
    assert ODD[write] in result["rejected"][0]["reason"]
    json.loads((tmp_path / "p" / "project.json").read_text(encoding="utf-8"))
    assert ingest.ingested(params).result is not None


def test_a_long_name_is_no_obstacle(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 3)
    labels, masks = photos / "labels", photos / "masks"
    for folder in (labels, masks):
        folder.mkdir()
    name = "n" * 251  # with its suffix as long as file systems take
    picture(7).save(photos / f"{name}.jpg", quality=95)
    Image.new("L", (320, 200), 1).save(labels / f"{name}.png")
    Image.new("L", (320, 200), 255).save(masks / f"{name}.png")
    result = ingest.new(NewParams(photos=photos, project=tmp_path / "p"), Reporter())
    assert (result["images"], result["labelled"], result["masked"], result["rejected"]) == (4, 1, 1, [])


def lying(shape: tuple[int, ...]) -> bytes:
    """The header of an .npy file that claims more than there is."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


@pytest.mark.parametrize("suffix", ["npy", "npz"])
@pytest.mark.parametrize("shape", [(10**6, 10**6, 4), (200, 320, 4)])
def test_an_array_that_claims_more_than_there_is(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    photos = folder_of(tmp_path / "photos", 3)
    (photos / "labels").mkdir()
    path = photos / "labels" / f"p1.{suffix}"
    if suffix == "npy":
        path.write_bytes(lying(shape))
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.npy", lying(shape))
    report = Reporter()
    result = ingest.new(NewParams(photos=photos, project=tmp_path / "p"), report)
    assert (result["images"], result["labelled"]) == (3, 0)
    assert any(f"p1.{suffix}" in text and "bytes" in text for text in report.warnings)


def test_poses_that_claim_more_than_there_are(tmp_path: Path) -> None:
    (tmp_path / "poses_bounds.npy").write_bytes(lying((10**12, 17)))
    with pytest.raises(InputError, match=r"poses_bounds\.npy claims"):
        llff.read(tmp_path)


def test_arrays_are_read(tmp_path: Path) -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.save(tmp_path / "a.npy", np.asfortranarray(values))
    np.savez_compressed(tmp_path / "a.npz", values=values)
    assert (read_array(tmp_path / "a.npy") == values).all()
    assert (read_array(tmp_path / "a.npz") == values).all()
    np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "none.npz")
    for name in ("o.npy", "none.npz", "nowhere.npy"):
        with pytest.raises(InputError, match=name):
            read_array(tmp_path / name)


def test_black_masks_are_named_as_such(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 4)
    (photos / "masks").mkdir()
    for i in range(4):
        Image.new("L", (320, 200), 0 if i < 2 else 255).save(photos / "masks" / f"p{i}.png")
    result = ingest.new(NewParams(photos=photos, project=tmp_path / "p"), Reporter())
    assert result["images"] == 2
    assert [item["file"] for item in result["rejected"]] == ["p0.jpg", "p1.jpg"]
    assert "mask p0.png is black everywhere" in result["rejected"][0]["reason"]
    for i in range(4):
        Image.new("L", (320, 200), 0).save(photos / "masks" / f"p{i}.png")
    with pytest.raises(InputError, match=r"None of the 4 files.*black everywhere"):
        ingest.new(NewParams(photos=photos, project=tmp_path / "q"), Reporter())


def test_a_folder_named_like_a_label_map_is_named(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 3)
    (photos / "labels" / "p1.png").mkdir(parents=True)
    report = Reporter()
    result = ingest.new(NewParams(photos=photos, project=tmp_path / "p"), report)
    assert (result["images"], result["labelled"]) == (3, 0)
    assert any("p1.png" in text for text in report.warnings)
