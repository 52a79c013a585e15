"""Classes on a wall from computed label maps: outlines, void, doubt, what is hidden, and the field's say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fieldwork.nerfcore.mesh import surface_labels as module
from fieldwork.nerfcore.mesh.facelets import facelets
from fieldwork.nerfcore.mesh.photo_texture import Prepared, prepare
from fieldwork.nerfcore.mesh.photos import Photo
from fieldwork.nerfcore.mesh.surface_labels import (
    class_evidence,
    class_maps,
    class_picture,
    decided,
    surface_classes,
)
from fieldwork.nerfcore.mesh.visibility import DepthBuffers, observe, with_flat_views
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.flat import LENS, box_mesh, looking, on_plane, ring, wall_mesh, wall_photo

DISC, REST, VOID = 7, 3, 0
IDS = [REST, DISC]
RADIUS = 0.31


def painted(xy: np.ndarray) -> np.ndarray:
    """A disc on the wall, and nothing said about its left end."""
    ids = np.where(np.linalg.norm(xy, axis=1) < RADIUS, DISC, REST)
    return np.where(xy[:, 0] < -0.5, VOID, ids)


def labelled(pose: np.ndarray, sure: int = 255, of=painted) -> Photo:
    ids = of(on_plane(LENS, pose)[0][:, :2]).reshape(LENS.height, LENS.width)
    return wall_photo(pose, labels=lambda: (ids, np.full(ids.shape, sure, np.uint8)))


def evidence_of(photos: list[Photo], made: Prepared, field=None):
    return class_evidence(photos, made.pieces, made.seen, IDS, field, None, Reporter())


def truth(size: int) -> np.ndarray:
    x, y = np.meshgrid((np.arange(size) + 0.5) / size * 1.2 - 0.6, 0.6 - (np.arange(size) + 0.5) / size * 1.2)
    return painted(np.stack([x.ravel(), y.ravel()], 1)).reshape(size, size)


def test_where_label_maps_are_masked_the_field_stands_in() -> None:
    """Masked is not void: a label map says nothing there."""
    photos = []
    for pose in ring(4):
        ids = painted(on_plane(LENS, pose)[0][:, :2]).reshape(LENS.height, LENS.width)
        sure = np.full(ids.shape, 255, np.uint8)
        sure[LENS.height // 3 : -LENS.height // 3, LENS.width // 3 : -LENS.width // 3] = 0
        photos.append(wall_photo(pose, labels=lambda ids=ids, sure=sure: (ids, sure)))
    made = prepare(*wall_mesh(), photos, 128, Reporter())

    def field(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return np.tile(np.array([[1.0, 0.0]], np.float32), (len(points), 1))

    evidence = evidence_of(photos, made, field)
    maps = class_maps(photos, made.buffers, made.seen, evidence, IDS, VOID, 128, Reporter())
    left = (np.arange(128) + 0.5) / 128 * 1.2 - 0.6
    assert (maps.ids[:, left > -0.45] != VOID).all()
    assert (maps.ids[:, left < -0.55] == VOID).mean() > 0.9


def test_outlines_lie_within_two_texels_and_the_unlabelled_is_void() -> None:
    size = 256
    photos = [labelled(pose) for pose in ring(8)]
    made = prepare(*wall_mesh(), photos, size, Reporter())
    evidence = evidence_of(photos, made)
    maps = class_maps(photos, made.buffers, made.seen, evidence, IDS, VOID, size, Reporter())
    assert maps.ids.dtype == np.uint8
    assert set(np.unique(maps.ids)) == {VOID, REST, DISC}
    y, x = np.mgrid[:size, :size]
    radius = np.hypot((x + 0.5) / size * 1.2 - 0.6, 0.6 - (y + 0.5) / size * 1.2)
    texel = 1.2 / size
    right = x / size * 1.2 - 0.6 > -0.4
    clear = right & (np.abs(radius - RADIUS) > 2 * texel)
    assert (maps.ids == truth(size))[clear].all()
    assert (maps.ids[:, : int(0.05 / 1.2 * size)] == VOID).all()
    assert (maps.confidence[:, : int(0.05 / 1.2 * size)] == 0).all()
    # Void has its outline too.
    left = (x + 0.5) / size * 1.2 - 0.6
    assert (maps.ids[left < -0.5 - 2 * texel] == VOID).all()
    assert (maps.ids[(left > -0.5 + 2 * texel) & (left < -0.4)] == REST).all()
    # Sure inside, in doubt on the outline.
    assert maps.confidence[right & (np.abs(radius - RADIUS) > 8 * texel)].min() > 220
    assert np.median(maps.confidence[right & (np.abs(radius - RADIUS) < 0.5 * texel)]) < 235


def test_faces_and_vertices_have_the_class_of_most_of_their_area() -> None:
    photos = [labelled(pose) for pose in ring(8)]
    vertices, faces, corners = wall_mesh(24)
    made = prepare(vertices, faces, corners, photos, 128, Reporter())
    found = surface_classes(len(vertices), faces, made.pieces, evidence_of(photos, made), IDS, VOID)
    center = vertices[faces].mean(1)[:, :2]
    clear = (np.abs(np.linalg.norm(center, axis=1) - RADIUS) > 0.03) & (center[:, 0] > -0.4)
    assert (found.face_class == painted(center))[clear].all()
    assert found.face_confidence[clear].min() > 0.6
    area = (1.2 / 24) ** 2 / 2
    assert (found.face_class == DISC).sum() * area == pytest.approx(np.pi * RADIUS**2, rel=0.03)
    near = np.linalg.norm(vertices[:, :2], axis=1)
    assert (found.class_id[near < RADIUS - 0.05] == DISC).all()
    assert found.confidence[near < RADIUS - 0.05].min() > 0.8
    assert (found.class_id[vertices[:, 0] < -0.59] == VOID).all()


def test_what_no_photo_sees_has_the_classes_around_it_where_asked() -> None:
    """A square on the disc's outline, and one on that of what is unlabelled."""
    photos = [labelled(pose) for pose in ring(8)]
    vertices, faces, corners = wall_mesh(48)
    made = prepare(vertices, faces, corners, photos, 256, Reporter())
    x, y = made.pieces.centers[:, :2].T
    disc, bare = (np.maximum(np.abs(x - at), np.abs(y)) for at in (RADIUS, -0.5))
    hidden = np.minimum(disc, bare) < 0.08
    seen = replace(made.seen, view=np.where(hidden[:, None], np.int16(-1), made.seen.view))
    without, found = (
        decided(class_evidence(photos, made.pieces, seen, IDS, None, None, Reporter(), continued).mass, IDS, VOID)[0]
        for continued in (False, True)
    )
    assert (without[np.minimum(disc, bare) < 0.05] == VOID).all()
    assert (found[disc < 0.08] != VOID).all()
    # Of the outline only two places are known there, at the rim.
    assert (found == painted(made.pieces.centers[:, :2]))[disc < 0.08].mean() > 0.85
    assert 0.3 < (found[bare < 0.05] == VOID).mean() < 0.7
    assert (found == without)[~hidden].all()


def test_without_any_label_map_all_is_void_and_the_field_may_say_more() -> None:
    photos = [wall_photo(pose) for pose in ring(4)]
    vertices, faces, corners = wall_mesh()
    made = prepare(vertices, faces, corners, photos, 64, Reporter())
    found = surface_classes(len(vertices), faces, made.pieces, evidence_of(photos, made), IDS, VOID)
    assert (found.face_class == VOID).all()
    assert (found.face_confidence == 0).all()
    assert (found.class_id == VOID).all()
    none = class_evidence(photos, made.pieces, made.seen, [], None, None, Reporter())
    assert (surface_classes(len(vertices), faces, made.pieces, none, [], 255).face_class == 255).all()

    def field(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        assert (normals[:, 2] > 0.99).all()
        return np.where(points[:, :1] > 0, [[0.1, 0.9]], [[0.8, 0.2]]).astype(np.float32)

    found = surface_classes(len(vertices), faces, made.pieces, evidence_of(photos, made, field), IDS, VOID)
    center = vertices[faces].mean(1)
    assert (found.face_class[center[:, 0] > 0.1] == DISC).all()
    assert (found.face_class[center[:, 0] < -0.1] == REST).all()


def test_few_labelled_places_do_not_make_the_rest_void() -> None:
    """Label maps with strokes only: the field says what the rest is. Beside full ones the unlabelled stays void."""
    vertices, faces, corners = wall_mesh()
    field_says = np.float32([0.1, 0.9])
    for share, expected in ((0.2, DISC), (0.8, VOID)):

        def strokes(xy: np.ndarray, share: float = share) -> np.ndarray:
            return np.where(xy[:, 0] < -0.6 + 1.2 * share, REST, VOID)

        photos = [labelled(pose, 255, strokes) for pose in ring(6)]
        made = prepare(vertices, faces, corners, photos, 64, Reporter())
        evidence = evidence_of(photos, made, lambda points, normals: np.tile(field_says, (len(points), 1)))
        found = surface_classes(len(vertices), faces, made.pieces, evidence, IDS, VOID)
        x = vertices[faces].mean(1)[:, 0]
        assert (found.face_class[x > -0.5 + 1.2 * share] == expected).all()
        assert (found.face_class[x < -0.65 + 1.2 * share] == REST).all()


def test_surface_that_no_photo_sees_is_void_whatever_the_field_says() -> None:
    vertices, faces = box_mesh(0.4)
    pieces = facelets(vertices, faces, limit=0.1)
    photos = [labelled(looking((0, 0, 0), (0.2, 0.1, 2.5))), labelled(looking((0, 0, 0), (-0.2, 0.1, 2.5)))]
    seen = observe(DepthBuffers([p.view for p in photos], pieces), Reporter())
    sure = class_evidence(
        photos, pieces, seen, IDS, lambda p, n: np.tile(np.float32([0, 1]), (len(p), 1)), None, Reporter()
    )
    found = surface_classes(len(vertices), faces, pieces, sure, IDS, VOID)
    back = (vertices[faces][..., 2] < 0).all(1)
    front = (vertices[faces][..., 2] > 0).all(1)
    assert (found.face_class[back] == VOID).all()
    assert (found.face_class[front] != VOID).all()


def test_what_is_only_seen_at_a_flat_angle_has_a_class_and_no_colour() -> None:
    vertices, faces, _ = wall_mesh()
    pieces = facelets(vertices, faces, limit=0.1)
    for angle, known in ((70, True), (80, True), (87, False)):
        away = 2.5 * np.array([np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))])
        photos = [labelled(looking((0, 0, 0), tuple(away)), of=lambda xy: np.full(len(xy), DISC))]
        buffers = DepthBuffers([photo.view for photo in photos], pieces)
        well = observe(buffers, Reporter())
        seen = with_flat_views(well, buffers, Reporter())
        assert bool((well.view >= 0).any()) is (angle < 75)
        evidence = class_evidence(photos, pieces, seen, IDS, None, None, Reporter())
        found = surface_classes(len(vertices), faces, pieces, evidence, IDS, VOID).face_class
        middle = np.abs(vertices[faces].mean(1)[:, 0]) < 0.3
        assert (found[middle] == (DISC if known else VOID)).all()
        if angle < 75:  # what is seen well is asked as before
            assert (seen.view[(well.view >= 0).any(1)] == well.view[(well.view >= 0).any(1)]).all()


def test_doubtful_label_maps_count_less() -> None:
    def other(xy: np.ndarray) -> np.ndarray:
        return np.full(len(xy), DISC)

    def rest(xy: np.ndarray) -> np.ndarray:
        return np.full(len(xy), REST)

    poses = ring(5)
    photos = [labelled(pose, 60, other) for pose in poses[:3]] + [labelled(pose, 255, rest) for pose in poses[3:]]
    vertices, faces, corners = wall_mesh()
    made = prepare(vertices, faces, corners, photos, 64, Reporter())
    found = surface_classes(len(vertices), faces, made.pieces, evidence_of(photos, made), IDS, VOID)
    # 3 · 60/255 against 2.
    middle = np.abs(vertices[faces].mean(1)).max(1) < 0.4
    assert (found.face_class[middle] == REST).all()
    assert np.median(found.face_confidence[middle]) == pytest.approx(0.4, abs=0.03)


def test_one_wrong_photo_is_outvoted_and_creases_stop_sharing(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = labelled(ring(8)[0], 255, lambda xy: np.full(len(xy), DISC))
    photos = [wrong, *(labelled(pose, 255, lambda xy: np.full(len(xy), REST)) for pose in ring(8)[1:])]
    vertices, faces, corners = wall_mesh()
    made = prepare(vertices, faces, corners, photos, 64, Reporter())
    found = surface_classes(len(vertices), faces, made.pieces, evidence_of(photos, made), IDS, VOID)
    assert (found.face_class == REST).all()

    pieces = facelets(*box_mesh(), limit=0.3)
    own = np.where(pieces.normals[:, 2:] > 0.9, [[1.0, 0.0]], [[0.0, 0.0]]).astype(np.float32)
    top, none = pieces.normals[:, 2] > 0.9, np.zeros(len(pieces), bool)
    assert module._shared(pieces, own, None, none)[~top].sum(1).max() < 1e-4
    half = top & (pieces.centers[:, 0] > 0)
    own[half] = 0
    assert (module._shared(pieces, own, None, none)[half].sum(1) > module.LEAST).any()
    colors = np.where(half[:, None], 0.9, 0.1) * np.ones(3)
    assert module._shared(pieces, own, colors, none)[half].sum(1).max() < 1e-3


def test_maps_are_the_same_in_tiles_and_have_their_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    photos = [labelled(pose) for pose in ring(6)]
    made = prepare(*wall_mesh(), photos, 128, Reporter())
    evidence = evidence_of(photos, made)
    whole = class_maps(photos, made.buffers, made.seen, evidence, IDS, VOID, 128, Reporter())
    monkeypatch.setattr(module, "TILE", 50)
    tiled = class_maps(photos, made.buffers, made.seen, evidence, IDS, VOID, 128, Reporter())
    assert (whole.ids == tiled.ids).all()
    assert (whole.confidence == tiled.confidence).all()
    large = class_maps(photos, made.buffers, made.seen, evidence, [3, 700], VOID, 128, Reporter())
    assert large.ids.dtype == np.uint16
    picture = class_picture(whole.ids, {DISC: (1, 0, 0), REST: (0, 0.5, 0)})
    assert (picture[whole.ids == DISC] == [255, 0, 0]).all()
    assert (picture[whole.ids == VOID] == 38).all()
