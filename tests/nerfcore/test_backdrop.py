"""Masks of objects before dark surroundings: made where photos leave no doubt, and only there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy
import torch
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.capture.backdrop import all_before_dark, before_dark, object_mask
from fieldwork.nerfcore.data.importer import import_dataset
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.evaluate.verb import compared_with
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.images.labels import read_mask
from fieldwork.nerfcore.images.working import MASK_UNKNOWN, read_picture
from fieldwork.nerfcore.params import ImportParams, NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.photos import new, picture
from PIL import Image

WIDTH, HEIGHT = 480, 320


def velvet(seed: int, around: float = 25.0) -> tuple[np.ndarray, np.ndarray]:
    """A photo (H, W, 3) uint8 of a speckled egg, lit from the left so that its right side is nearly as dark as what is
    around it, with a lamp far from it, and where the egg is (H, W) bool."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    middle = WIDTH / 2 + 20 * rng.uniform(-1, 1)
    across = (x - middle) / 100
    egg = across**2 + ((y - HEIGHT / 2) / 70) ** 2 < 1
    light = 200 - 65 * (across + 1)  # 200 to 70
    speckles = scipy.ndimage.gaussian_filter(rng.uniform(-1, 1, x.shape), 1.5) * 80
    shown = np.where(egg, light + speckles, around + 3 * rng.normal(size=x.shape))
    shown[20:32, 20:34] = 255
    return np.repeat(np.clip(shown, 0, 255).astype(np.uint8)[..., None], 3, 2), egg


class Notes(Reporter):
    """Remembers what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[str] = []

    def note(self, message: str) -> None:
        self.heard.append(message)


def photos_of(folder: Path, pictures: list[np.ndarray]) -> Path:
    folder.mkdir()
    for number, pixels in enumerate(pictures):
        Image.fromarray(pixels).save(folder / f"p{number:02}.png")
    return folder


def test_a_mask_keeps_the_dark_side_and_leaves_lamps_out() -> None:
    for seed in range(3):
        photo, egg = velvet(seed)
        mask = object_mask(photo) > 0
        assert (mask & egg).sum() / (mask | egg).sum() > 0.96
        assert (egg & ~mask).sum() < 0.01 * egg.sum()
        assert not mask[:40, :40].any()


def test_an_outline_runs_where_brightness_is_halfway() -> None:
    """As wide as the object is, though a lens blurs its edge: neither a rim of what is around it, nor less of it."""
    for seed in range(3):
        photo, egg = velvet(seed)
        blurred = scipy.ndimage.gaussian_filter(photo, (1.5, 1.5, 0))
        mask = object_mask(blurred) > 0
        assert (mask & egg).sum() / (mask | egg).sum() > 0.99
        assert abs(mask.sum() / egg.sum() - 1) < 0.005


def test_dark_places_within_an_object_are_part_of_it() -> None:
    photo, egg = velvet(0)
    photo[150:154, 220:224] = 0
    assert (egg & (object_mask(photo) < 255)).sum() < 0.01 * egg.sum()


def test_what_may_be_an_opening_is_left_open(tmp_path: Path) -> None:
    """Neither empty nor something: training takes either, and no held-out photo is judged there."""
    photo, egg = velvet(0)
    photo[150:170, 220:250] = 20
    mask = object_mask(photo)
    assert (mask[151:169, 221:249] == MASK_UNKNOWN).all()
    assert np.count_nonzero(mask == MASK_UNKNOWN) < 30 * 20 * 1.1
    assert (egg & (mask == 0)).sum() < 0.01 * egg.sum()
    for name, pixels in (("photo", photo), ("mask", mask)):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    camera = Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, fx=400, fy=400, cx=WIDTH / 2, cy=HEIGHT / 2)
    view = View("photo", camera, np.eye(4), tmp_path / "photo.png", mask=tmp_path / "mask.png")
    scene = Scene([view], [0], [], mask_mode="empty")
    store = PixelStore(scene, [0], [], np.eye(4), WIDTH, torch.device("cpu"), Reporter())
    batch = store.batch(torch.arange(mask.size))
    assert batch.unknown is not None
    assert np.array_equal(batch.unknown.numpy(), (mask == MASK_UNKNOWN).reshape(-1))
    ends = batch.part(slice(1000, None)).before(torch.ones(mask.size - 1000, 3))
    assert torch.equal(ends, torch.where(batch.unknown[:, None], batch.rgb, torch.ones(1))[1000:])
    assert np.array_equal(store.rgba[:, 3].numpy() > 0, (mask == 255).reshape(-1))
    _, counted, _ = compared_with(view, scene, WIDTH, HEIGHT, 1.0)
    assert counted is not None
    assert np.array_equal(counted, mask != MASK_UNKNOWN)


@pytest.mark.parametrize(
    ("why", "changed"),
    [
        ("nothing is there", lambda photo: np.full_like(photo, 20)),
        ("black", np.zeros_like),
        ("bright surroundings", lambda photo: 255 - photo),
        ("grey surroundings", lambda photo: np.maximum(photo, 100)),
        ("a lit floor", lambda photo: np.where((np.arange(HEIGHT) > 200)[:, None, None], 180, photo)),
    ],
)
def test_other_photos_are_no_objects_before_dark_surroundings(
    why: str, changed: Callable[[np.ndarray], np.ndarray]
) -> None:
    photo, _ = velvet(1)
    assert before_dark(photo)
    assert not before_dark(changed(photo).astype(np.uint8)), why


def test_new_cuts_the_object_out(tmp_path: Path) -> None:
    shown = [velvet(seed) for seed in range(10)]
    photos = photos_of(tmp_path / "photos", [photo for photo, _ in shown])
    report = Notes()
    result = ingest.new(NewParams(photos=photos, project=tmp_path / "p"), report)
    assert result["masked"] == 10
    project = load_project(tmp_path / "p")
    assert project.mask_mode == "empty"
    for record, (_, egg) in zip(project.images, shown):
        assert record.mask is not None
        mask = read_mask(tmp_path / "p" / record.mask)
        assert (mask & egg).sum() / (mask | egg).sum() > 0.96
    assert any("--keep-backdrop" in note for note in report.heard)
    assert new(photos, tmp_path / "p")["masked"] == 10  # again, from the working copies that are there


def test_masks_that_were_made_and_edited_are_kept(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "photos", [velvet(seed)[0] for seed in range(10)])
    masks = tmp_path / "p/masks"
    new(photos, tmp_path / "p")
    edited = np.zeros((HEIGHT, WIDTH), np.uint8)
    edited[100:200, 100:200] = 255
    for name in ("p00", "p01"):
        Image.fromarray(edited).save(masks / f"{name}.png")
    Image.fromarray(velvet(20)[0]).save(photos / "p01.png")  # another photo: another mask
    Image.fromarray(velvet(21)[0]).save(photos / "p10.png")
    report = Notes()
    assert ingest.new(NewParams(photos=photos, project=tmp_path / "p"), report)["masked"] == 11
    assert np.array_equal(read_mask(masks / "p00.png"), edited > 0)
    assert not np.array_equal(read_mask(masks / "p01.png"), edited > 0)
    assert any("2 masks were made, 9 are there already" in note for note in report.heard)
    given = tmp_path / "given"
    given.mkdir()
    for number in range(11):
        Image.fromarray(edited).save(given / f"p{number:02}.png")
    new(photos, tmp_path / "p", masks=given)
    new(photos, tmp_path / "p")
    assert not np.array_equal(read_mask(masks / "p00.png"), edited > 0), (
        "masks that were given are gone with their folder"
    )


def test_photos_that_are_added_are_as_the_others(tmp_path: Path) -> None:
    dark = photos_of(tmp_path / "dark", [velvet(seed)[0] for seed in range(4)])
    more = photos_of(tmp_path / "more", [velvet(seed)[0] for seed in range(4, 6)])
    new(dark, tmp_path / "cut")
    assert new(more, tmp_path / "cut", add=True)["masked"] == 6
    new(dark, tmp_path / "whole", keep_backdrop=True)
    assert new(more, tmp_path / "whole", add=True)["masked"] == 0


def test_nothing_is_cut_out_against_what_is_known_or_asked(tmp_path: Path) -> None:
    pictures = [velvet(seed)[0] for seed in range(10)]
    photos = photos_of(tmp_path / "photos", pictures)
    assert new(photos, tmp_path / "kept", keep_backdrop=True)["masked"] == 0
    assert new(photos, tmp_path / "ignored", mask_mode="ignore")["masked"] == 0
    labels = tmp_path / "maps"
    labels.mkdir()
    Image.fromarray(np.ones((HEIGHT, WIDTH), np.uint8)).save(labels / "p00.png")
    assert new(photos, tmp_path / "labelled", labels=labels)["masked"] == 0
    masks = tmp_path / "given"
    masks.mkdir()
    Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(masks / "p00.png")
    assert new(photos, tmp_path / "masked", masks=masks)["masked"] == 1
    mixed = photos_of(tmp_path / "mixed", [*pictures[:8], *(np.asarray(picture(k, (WIDTH, HEIGHT))) for k in range(2))])
    assert new(mixed, tmp_path / "some")["masked"] == 0
    see_through = tmp_path / "alpha"
    see_through.mkdir()
    for seed in range(4):
        photo, egg = velvet(seed)
        Image.fromarray(np.concatenate([photo, egg[..., None].astype(np.uint8) * 255], 2)).save(
            see_through / f"{seed}.png"
        )
    assert new(see_through, tmp_path / "transparent")["masked"] == 0


@pytest.mark.slow
def test_a_data_set_is_cut_out_too(tmp_path: Path, shared_data: Callable[[str], Path]) -> None:
    temple = shared_data("temple_ring")
    import_dataset(ImportParams(dataset=temple, project=tmp_path / "p"), Reporter())
    project = load_project(tmp_path / "p")
    assert project.mask_mode == "empty"
    assert all(record.mask for record in project.images)
    import_dataset(ImportParams(dataset=temple, project=tmp_path / "q", keep_backdrop=True), Reporter())
    assert not any(record.mask for record in load_project(tmp_path / "q").images)


@pytest.mark.parametrize(
    ("capture", "dark"), [("skull", True), ("banana", False), ("fox", False), ("fountain_p11", False)]
)
def test_which_captures_are_before_dark_surroundings(
    capture: str, dark: bool, shared_data: Callable[[str], Path]
) -> None:
    photos = sorted((shared_data(capture) / "images").iterdir())[::4]
    assert all_before_dark(photos, Reporter()) == dark


def test_masks_match_those_drawn_by_hand(shared_data: Callable[[str], Path]) -> None:
    """Photos of the tankard, black outside of its masks."""
    tankard = shared_data("mary_rose_tankard")
    for photo in sorted((tankard / "images").iterdir())[::20]:
        pixels = read_picture(photo).pixels.copy()
        drawn = read_mask(next((tankard / "masks").glob(f"{photo.stem}*")))
        drawn = np.asarray(Image.fromarray(drawn).resize(pixels.shape[1::-1]))
        pixels[~drawn] = 0
        mask = object_mask(pixels) > 0
        assert (mask & drawn).sum() / (mask | drawn).sum() > 0.97
        assert (drawn & ~mask).sum() < 0.01 * drawn.sum()
