"""A wall textured from computed photos, compared with photos it was not made from."""

from __future__ import annotations

import time

import numpy as np
import pytest
from fieldwork.nerfcore.errors import Cancelled, SettingError
from fieldwork.nerfcore.kernels import runtime
from fieldwork.nerfcore.mesh import painting, visibility
from fieldwork.nerfcore.mesh import photo_texture as module
from fieldwork.nerfcore.mesh.facelets import facelets
from fieldwork.nerfcore.mesh.painting import Jobs, crossings, texels_of
from fieldwork.nerfcore.mesh.photo_texture import PhotoTexture, one_of_each_square, photo_texture, prepare
from fieldwork.nerfcore.mesh.photos import Photo, sharpened
from fieldwork.nerfcore.mesh.surface_picture import surface_picture
from fieldwork.nerfcore.mesh.visibility import PosedCamera
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.flat import (
    LENS,
    looking,
    on_plane,
    pattern,
    ring,
    wall_mesh,
    wall_photo,
    wall_picture,
)
from skimage.color import rgb2lab

HELD_OUT = [looking((0, 0, 0), (0.3, 0.2, 1.9)), looking((0.1, 0, 0), (-0.5, 0.3, 2.2))]
POSES = ring(9)
EXPOSURES = [0.3, -0.3, 0.1, -0.2, 0.25, 0, -0.3, 0.15, 0]


def textured(photos: list[Photo], size: int = 512, fill=None, mesh=None) -> PhotoTexture:
    return photo_texture(prepare(*(mesh or wall_mesh()), photos, size, Reporter()), fill, Reporter())


def psnr(texture: PhotoTexture, pose: np.ndarray, gain: float = 1.0) -> float:
    """Against a photo of the bare wall, in its inner part."""
    picture, hit = surface_picture(PosedCamera(LENS, pose), *wall_mesh(), texture.image)
    inside = (np.abs(on_plane(LENS, pose)[0][:, :2]).max(1) < 0.55).reshape(hit.shape) & (hit > 0.99)
    error = (picture.astype(float) - wall_picture(pose)[..., :3])[inside]
    return float(10 * np.log10(255**2 / np.square(error).mean()))


@pytest.fixture(scope="module")
def plain() -> PhotoTexture:
    return textured([wall_photo(pose) for pose in POSES])


def test_held_out_photos_are_met(plain: PhotoTexture) -> None:
    assert plain.seen == pytest.approx(1)
    assert not plain.unseen.any()
    assert min(psnr(plain, pose) for pose in HELD_OUT) > 36
    # Detail is as strong as in the photos, not averaged away.
    for pose in HELD_OUT:
        picture, hit = surface_picture(PosedCamera(LENS, pose), *wall_mesh(), plain.image)
        photo = wall_picture(pose)[..., :3]
        energy = [np.hypot(*np.gradient(p.astype(float).mean(2)))[hit > 0.99].mean() for p in (picture, photo)]
        assert energy[0] / energy[1] > 0.95


def error(texture: PhotoTexture) -> np.ndarray:
    """Largest difference (S, S) of a channel from the wall's true colour, of 255."""
    size = len(texture.image)
    x, y = np.meshgrid((np.arange(size) + 0.5) / size * 1.2 - 0.6, 0.6 - (np.arange(size) + 0.5) / size * 1.2)
    truth = pattern(np.stack([x.ravel(), y.ravel()], 1)).reshape(size, size, 3) * 255
    return np.abs(texture.image - truth).max(2)


def test_texels_are_upright_and_in_place(plain: PhotoTexture) -> None:
    assert error(plain).max() < 4


def test_exposures_of_a_third_of_a_stop_cost_at_most_half_a_decibel(plain: PhotoTexture) -> None:
    changed = textured([wall_photo(pose, exposure=stops) for pose, stops in zip(POSES, EXPOSURES)])
    # All photos were exposed by what remains when their differences are taken away: compare up to that.
    stops = np.log2(changed.gains)
    left = np.array(EXPOSURES)[:, None] + stops
    assert np.abs(left - left.mean()).max() < 0.03
    assert abs(left.mean()) == pytest.approx(abs(np.mean(EXPOSURES)), abs=0.02)
    for pose in HELD_OUT:
        assert psnr(changed, pose) > psnr(plain, pose) - 0.5


def test_where_the_photo_changes_colours_do_not_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[np.ndarray] = []

    def spy(pieces, view, column, keep, log_factor):
        chosen.append(view[np.arange(len(view)), column])
        return crossings(pieces, view, column, keep, log_factor)

    monkeypatch.setattr(module, "crossings", spy)
    photos = [wall_photo(pose, exposure=stops) for pose, stops in zip(POSES, EXPOSURES)]
    prepared = prepare(*wall_mesh(), photos, 512, Reporter())
    made = photo_texture(prepared, None, Reporter())
    texels = texels_of(prepared.pieces, 512, (0, 0, 512, 512))
    view = np.full(512 * 512, -1)
    view[texels.place] = np.repeat(chosen[0], np.diff(texels.first))
    lab = rgb2lab(made.image)
    for axis in (0, 1):
        difference = np.linalg.norm(np.diff(lab, axis=axis), axis=2)
        seam = np.diff(view.reshape(512, 512), axis=axis) != 0
        assert seam.sum() > 100
        assert difference[seam].mean() < 1.5 * difference[~seam].mean()


def test_around_a_sharp_edge_both_photos_paint_its_vertices() -> None:
    corners = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1.0]])
    pieces = facelets(corners, np.array([[0, 1, 3], [1, 0, 2]]))
    column, log_factor = np.zeros(2, np.int8), np.log(np.array([[[2.0] * 3], [[3.0] * 3]]))
    jobs = crossings(pieces, np.array([[5], [7]]), column, np.ones((2, 1), bool), log_factor)
    assert jobs.beside.tolist() == [False, True, True, False]
    assert jobs.face.tolist() == [0, 0, 1, 1]
    assert jobs.view.tolist() == [5, 7, 5, 7]
    assert jobs.weight.tolist() == [[0.5, 0.5, 1], [0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, 0.5, 1]]
    for factor, view in zip(jobs.factor[:, :2, 0], jobs.view):
        assert factor == pytest.approx({5: 2, 7: 3}[view])


def test_a_photo_that_shows_something_else_paints_no_border_either() -> None:
    corners = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1.0]])
    pieces = facelets(corners, np.array([[0, 1, 3], [1, 0, 2]]))
    keep = np.array([[True, False], [False, True]])  # each facelet's other view has something before it
    column = np.array([0, 1], np.int8)
    jobs = crossings(pieces, np.array([[5, 7], [5, 7]]), column, keep, np.zeros((2, 2, 3)))
    assert list(zip(jobs.face.tolist(), jobs.view.tolist())) == [(0, 5), (1, 7)]


def test_without_gains_the_same_photos_would_cost_more(plain: PhotoTexture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "photo_gains", lambda view, looks, count: np.ones((count, 3), np.float32))
    monkeypatch.setattr(module, "towards_common", lambda pieces, same, looks, keep, weight: np.zeros((*keep.shape, 3)))
    changed = textured([wall_photo(pose, exposure=stops) for pose, stops in zip(POSES, EXPOSURES)])
    assert psnr(changed, HELD_OUT[0]) < psnr(plain, HELD_OUT[0]) - 3


def test_what_stood_before_one_photo_leaves_no_ghost(monkeypatch: pytest.MonkeyPatch) -> None:
    near = looking((0, 0, 0), (0.05, 0, 1.2))  # the best view of the middle, were it not for the board
    photos = [wall_photo(near, board=(0.15, 0.3, 0.95)), *(wall_photo(pose) for pose in POSES)]
    made = textured(photos)
    assert (error(made) > 10).mean() < 1e-4
    assert min(psnr(made, pose) for pose in HELD_OUT) > 36
    monkeypatch.setattr(module, "agreeing", lambda pieces, view, looks: looks.worth > 0)
    assert (error(textured(photos)) > 10).mean() > 0.02


def test_masked_pixels_never_paint() -> None:
    photos = []
    for pose in POSES:
        rgba = wall_picture(pose)
        points = on_plane(LENS, pose)[0][:, :2].reshape(*rgba.shape[:2], 2)
        hidden = points[..., 0] > 0.2
        rgba[hidden] = [255, 0, 255, 0]
        photos.append(wall_photo(pose, rgba=rgba))
    made = textured(photos, fill=lambda points, normals: np.tile(np.uint8([10, 200, 30]), (len(points), 1)))
    size = len(made.image)
    edge = int((0.2 + 0.6) / 1.2 * size)
    assert (made.image[:, edge + 8 :] == [10, 200, 30]).all()
    assert (made.unseen[:, edge + 8 :] == 255).all()
    assert not made.unseen[:, : edge - 16].any()
    magenta = (made.image[..., 0] > 200) & (made.image[..., 1] < 60) & (made.image[..., 2] > 200)
    assert not magenta.any()
    assert made.seen == pytest.approx(edge / size, abs=0.03)


def test_unseen_surface_without_a_field_takes_what_is_beside() -> None:
    made = textured([wall_photo(looking((0, 0, 0), (0, 0.01, 0.8)))])
    assert 0.05 < made.seen < 0.95
    assert made.unseen.max() == 255
    assert (made.image[made.unseen > 0].sum(1) > 0).all()


def test_tiles_make_the_same_picture(plain: PhotoTexture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TILE", 200)
    tiled = textured([wall_photo(pose) for pose in POSES])
    assert np.abs(tiled.image.astype(int) - plain.image).max() <= 1


def test_two_triangles_take_more_than_one_photo() -> None:
    """No photo shows the whole wall, which is two triangles."""
    poses = [looking((x, y, 0), (x, y + 0.01, 0.7)) for x in (-0.35, 0, 0.35) for y in (-0.35, 0, 0.35)]
    mesh = wall_mesh(1)
    made = textured([wall_photo(pose) for pose in poses], mesh=mesh)
    assert made.seen > 0.99
    assert min(psnr(made, pose) for pose in HELD_OUT) > 33


def test_no_memory_is_said_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    class Little:
        available = 1_000_000_000

    monkeypatch.setattr(module.psutil, "virtual_memory", lambda: Little)
    with pytest.raises(SettingError, match=r"16384×16384 needs .* GB of memory, and 1\.0 GB are free"):
        prepare(*wall_mesh(), [], 16384, Reporter())


def test_cancelled_at_every_stage() -> None:
    photos = [wall_photo(pose) for pose in POSES[:4]]

    class Stops(Reporter):
        def __init__(self, at: int) -> None:
            super().__init__()
            self.left = at

        def stage(self, name: str) -> None:
            self.left -= 1
            if self.left == 0:
                self.cancel()

    for at in (1, 2, 3, 4):
        report = Stops(at)
        with pytest.raises(Cancelled):
            photo_texture(prepare(*wall_mesh(), photos, 128, report), None, report)


def test_the_blur_of_a_pixel_is_half_taken_back():
    fine = np.sin(2 * np.pi * np.arange(64 * 16) / (16 * 8)) * 80 + 128  # 16 points a pixel, 8 pixels a wave
    photo = np.full((64, 64, 4), 255, np.uint8)
    photo[..., :3] = np.round(fine.reshape(64, 16).mean(1))[None, :, None]
    middle = (fine[7::16] + fine[8::16]) / 2
    before, after = (np.abs(p[5, 1:-1] - middle[1:-1]) for p in (photo[..., 0], sharpened(photo)[0].numpy() * 255))
    peak = np.abs(middle[1:-1] - 128) > 60
    assert after[peak].mean() < 0.7 * before[peak].mean()


def test_sharpening_asks_nothing_of_what_is_masked():
    photo = np.full((8, 8, 4), 255, np.uint8)
    photo[..., :3] = 100
    assert np.allclose(sharpened(photo).numpy() * 255, 100)
    photo[:, 4:] = 0
    assert np.allclose(sharpened(photo)[:, :, :4].numpy() * 255, 100)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_texels_of_a_square_share_one_of_them(step: int) -> None:
    random = np.random.default_rng(step)
    width, height = 17, 12
    place = random.permutation(width * height)[:90].astype(np.int32)
    chosen, shared = one_of_each_square(place, width, step)
    assert len(shared) == len(place)
    row, column = np.divmod(place, width)
    own = np.stack([row // step, column // step])
    row, column = np.divmod(place[chosen][shared], width)
    assert (own == np.stack([row // step, column // step])).all()
    assert len(chosen) == len(np.unique(own, axis=1).T)
    if step == 1:
        assert (place[chosen][shared] == place).all()


def test_photos_are_mixed_in_the_same_order_whichever_is_done_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The colours are so large that single precision gives another sum in another order."""
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    pieces = facelets(vertices, faces, np.array([[[0.0, 0], [1, 0], [0, 1]]]))
    texels = texels_of(pieces, 8, (0, 0, 8, 8))
    ones = np.ones((3, 3), np.float32)
    jobs = Jobs(np.zeros(3, int), np.arange(3), ones, np.ones((3, 3, 3), np.float32), np.zeros(3, bool))
    light, delay = {0: 1e8, 1: 1.0, 2: -1e8}, {0: 0.0, 1: 0.2, 2: 0.1}

    def paint(number: int, *_: object) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        time.sleep(delay[number])
        value = np.full((len(texels), 4), light[number], np.float32)
        value[:, 3] = 1
        return np.arange(len(texels)), value, np.ones(len(texels), bool)

    monkeypatch.setattr(painting, "paint", paint)
    for place in (visibility, runtime):
        monkeypatch.setattr(place, "worker_count", lambda: 3)
    buffers = visibility.DepthBuffers([], pieces)
    color, painted = painting.paint_all([0, 1, 2], buffers, texels, jobs, np.zeros(1, bool), Reporter())  # type: ignore[arg-type]
    assert painted.all()
    assert (color == 0).all()
