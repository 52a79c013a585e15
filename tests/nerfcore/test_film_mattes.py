"""Cryptomattes, and objects in front of fields."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.film.cryptomatte import Coverage, id_bits, id_of, manifest, murmur3
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.mesh.instances import Instance, write_instances

from .support.film import H, W, ball, lens, store, take, taken

__all__ = ["ball", "store"]


def test_ids_are_those_of_the_specification() -> None:
    assert murmur3(b"hello") == 0x248BFA47
    assert murmur3(b"bunny") == 0x13851A76
    assert murmur3(b"abcd") == 0x43ED676A
    assert murmur3(b"abc") == 0xB3DD93FA
    assert murmur3("Straße ü".encode()) == 0xB608E818
    for name in (f"name{n}" for n in range(3000)):
        assert id_bits(name) >> 23 & 255 not in (0, 255)
        assert np.isfinite(id_of(name))
    assert struct.pack("<f", id_of("bunny")) == struct.pack("<I", 0x13851A76)
    assert json.loads(manifest(["bunny"])) == {"bunny": "13851a76"}


def test_coverage_is_ranked_and_adds_up() -> None:
    coverage = Coverage(2)
    one, other = np.float32(id_of("one")), np.float32(id_of("other"))
    for number in range(4):
        ids = np.array([one if number else other, 0], np.float32)
        coverage.add(ids, np.array([0.25, 0.25], np.float32))
    first, second = coverage.ranked(4)
    assert first[0] == pytest.approx([one, 0.75, other, 0.25])
    assert (first[1] == 0).all()
    assert (second == 0).all()


def test_matte_of_a_class_is_its_share_of_the_pixel(ball: Path, store: FieldStore) -> None:
    passes = ["Combined", "CryptoMaterial00", "CryptoObject00", "CryptoAsset00"]
    found = take(ball, store, passes, samples=16)
    pixels = found["CryptoMaterial00"]
    top, bottom = (np.float32(id_of(name)) for name in ("top", "bottom"))
    matte = {name: sum(np.where(pixels[..., k] == i, pixels[..., k + 1], 0) for k in (0, 2)) for name, i in
             (("top", top), ("bottom", bottom))}  # fmt: skip
    assert matte["top"][H // 2 - 12, W // 2] > 0.95
    assert matte["bottom"][H // 2 - 12, W // 2] == 0
    solid = found["Combined"][..., 3] > 0.99
    assert (matte["top"] + matte["bottom"])[solid].mean() > 0.97
    assert (matte["top"] + matte["bottom"] <= found["Combined"][..., 3] + 1e-3).all()
    # Without a mesh that tells instances apart, a class of an object is one.
    assert found["CryptoObject00"][H // 2 - 12, W // 2, 0] == np.float32(id_of("Ball.top"))


def test_instances_are_those_of_the_mesh(ball: Path, store: FieldStore, tmp_path: Path) -> None:
    import shutil

    project = Path(shutil.copytree(ball, tmp_path / "p"))
    folder = project / "exports" / "main"
    folder.mkdir(parents=True)
    points = np.array([[x, -0.5, z] for x in (-0.3, 0.3) for z in (0.2, -0.2)])
    vertices = np.concatenate([points + shift for shift in ([0, 0, 0.02], [0.02, 0, -0.02], [-0.02, 0, -0.02])])
    arrays = {
        "vertices": vertices,
        "faces": np.arange(12).reshape(3, 4).T,
        "normals": vertices * 0,
        "colors": np.zeros((12, 3), np.uint8),
        "class_id": np.ones(12, np.int32),
        "face_class": np.array([1, 2, 1, 2]),
        "face_instance": np.array([1, 0, 2, 0], np.uint32),
    }
    np.savez(folder / "mesh.npz", **arrays)
    write_instances(folder, [Instance(n + 1, name, 1, 1.0, (0, 0, 0)) for n, name in enumerate(("left", "right"))])
    exposure = taken(project, store, ["CryptoObject00"])
    pixels = exposure.passes["CryptoObject00"][::-1]
    assert pixels[H // 2 - 10, W // 2 - 12, 0] == np.float32(id_of("left"))
    assert pixels[H // 2 - 10, W // 2 + 12, 0] == np.float32(id_of("right"))
    assert {"left", "right"} <= json.loads(exposure.manifests["CryptoObject"]).keys()


# Objects


def plate(folder: Path, y: float, edge: float, holdout: bool = False) -> Path:
    """A plate at a distance, left of a slanted edge."""
    vertices = np.array([[-5, y, -5], [edge - 0.2, y, -5], [edge + 0.2, y, 5], [-5, y, 5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    np.savez(folder / "plate.npz", vertices=vertices, faces=faces, holdout=np.full(2, holdout))
    return folder / "plate.npz"


def over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a + (1 - a[..., 3:]) * b


@pytest.mark.parametrize(
    ("y", "holdout", "samples"),
    [
        pytest.param(-1.0, False, 64, marks=pytest.mark.slow),
        pytest.param(-0.1, False, 64, marks=pytest.mark.slow),
        pytest.param(1.0, False, 64, marks=pytest.mark.slow),
        pytest.param(-0.1, True, 64, marks=pytest.mark.slow),
        (-0.1, True, 16),
    ],
)
def test_composited_objects_are_exact_at_edges(
    ball: Path, store: FieldStore, tmp_path: Path, y: float, holdout: bool, samples: int
) -> None:
    """Before, within and behind the field: against the mean over samples of what each shows, with as many. A holdout is
    in no picture, and nothing is behind it."""
    file, paint = plate(tmp_path, y, 0.05, holdout), np.array([0.9, 0.3, 0.1, 1.0]) * (not holdout)
    wanted = ["FieldFront", "FieldBehind"]
    found = take(ball, store, wanted, samples=samples, occluders=file)
    # What a renderer of objects gives with the same samples: the share of the samples that meet the plate.
    truth, objects, covered = np.zeros((H, W, 4)), np.zeros((H, W, 4)), np.zeros((H, W))
    from fieldwork.nerfcore.film.exposure import STEPS2

    for number in range(samples):
        dx, dy = ((0.5 + number * step) % 1 for step in STEPS2)
        moved = lens(center=(W / 2 + 0.5 - dx, H / 2 + 0.5 - dy))
        one = take(ball, store, [*wanted, "Combined"], lens=moved, occluders=file)
        x = (np.arange(W) + dx - W / 2) / 120 * (y + 2)
        z = (H / 2 - np.arange(H) - dy) / 120 * (y + 2)
        hit = x[None] < 0.05 + 0.04 * z[:, None]
        painted = np.where(hit[..., None], paint, 0)
        objects += painted / samples
        covered += hit / samples
        truth += over(one["Combined"], painted) / samples
    mixed = over(found["FieldFront"], over(objects, found["FieldBehind"]))
    edge = (covered > 0.02) & (covered < 0.98)
    assert edge.sum() > H / 2
    assert np.abs(mixed - truth)[..., :3][edge].mean() < 1 / 255
    assert np.abs(mixed - truth)[..., :3].mean() < 1 / 255
    if holdout:
        # Two layers cannot hold the alpha of a pixel where the field itself ends as well; its colour is exact.
        alone = take(ball, store, ["Combined"], samples=samples)["Combined"][..., 3]
        whole = edge & ((alone < 0.02) | (alone > 0.98))
        assert whole.sum() > H / 2
        assert np.abs(mixed - truth)[..., 3][whole].mean() < 1 / 255
    # Z Combine, which knows one depth a pixel, is worse: the pixel is one or the other.
    if y == -1.0:
        assert found["FieldBehind"][H // 2, W // 2 - 8, 3] > 0.9, "what is behind an object is kept for glass"
        assert found["FieldFront"][H // 2, W // 2 - 8, 3] < 0.05
