"""Instances: which faces belong together, which names they get, and that these stay the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.mesh.instances import (
    Instance,
    find_instances,
    read_instances,
    with_class_names,
    write_instances,
)
from fieldwork.tests.nerfcore.support.flat import box_mesh, wall_mesh

NAMES = {1: "plinth", 2: "vase"}


def scattered(*parts: tuple[float, tuple[float, float, float], int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cubes of a half side, at a place, of a class, as one mesh: vertices, faces, face_class."""
    box, triangles = box_mesh(1.0)
    vertices = np.concatenate([half * box + at for half, at, _ in parts])
    faces = np.concatenate([triangles + len(box) * k for k in range(len(parts))])
    return vertices, faces, np.repeat([c for *_, c in parts], len(triangles))


def test_each_thing_of_a_class_has_a_name_by_size() -> None:
    mesh = scattered((0.2, (0, 0, 0), 1), (0.5, (3, 0, 0), 1), (0.3, (6, 0, 0), 2), (0.1, (9, 0, 0), 0))
    face_instance, found = find_instances(*mesh, NAMES, 0, 0.01)
    assert [(i.name, i.class_id) for i in found] == [("plinth.001", 1), ("plinth.002", 1), ("vase.001", 2)]
    assert face_instance.dtype == np.uint32
    assert face_instance.reshape(4, -1)[:, 0].tolist() == [2, 1, 3, 0]
    assert (face_instance.reshape(4, -1) == face_instance.reshape(4, -1)[:, :1]).all()
    assert found[0].area == pytest.approx(6.0)
    np.testing.assert_allclose(found[0].center, (3, 0, 0), atol=1e-12)


def test_names_do_not_depend_on_the_order_of_faces_nor_on_a_little_noise() -> None:
    mesh = scattered((0.5, (4, 0, 0), 1), (0.5, (0, 0, 0), 1), (0.5, (2, 0, 0), 1))
    shuffled = np.random.default_rng(0).permutation(len(mesh[1]))
    noisy = mesh[0] + np.random.default_rng(1).normal(size=mesh[0].shape) * 1e-3
    for vertices, order in ((mesh[0], np.arange(len(mesh[1]))), (mesh[0], shuffled), (noisy, shuffled)):
        _, found = find_instances(vertices, mesh[1][order], mesh[2][order], NAMES, 0, 0.05)
        assert [round(i.center[0]) for i in found] == [0, 2, 4]


def test_a_crack_does_not_part_a_thing_and_crumbs_are_none() -> None:
    vertices, faces, _ = wall_mesh(12, 0.6)
    crumb = vertices[faces[0]] * 0.2 + (0, 0, 5)
    torn = np.concatenate([vertices, vertices + (1.22, 0, 0), crumb])
    both = np.concatenate([faces, faces + len(vertices), [[2 * len(vertices) + k for k in range(3)]]])
    classes = np.ones(len(both), int)
    face_instance, found = find_instances(torn, both, classes, NAMES, 0, 0.05)
    assert len(found) == 1
    assert (face_instance == [1] * 2 * len(faces) + [0]).all()
    assert len(find_instances(torn, both, classes, NAMES, 0, 0.01)[1]) == 2


def test_new_names_of_classes_do_not_make_two_things_one_name() -> None:
    called = ("chair.001", "seat.002", "chair.002", "chair.001.2", "chairman", "mine")
    known = [Instance(n, name, 1, 1.0, (n, 0, 0)) for n, name in enumerate(called, 1)]
    found = with_class_names(known, {"chair"}, {1: "seat"})
    assert [one.name for one in found] == ["seat.001", "seat.002", "chair.002", "seat.001.2", "chairman", "mine"]
    assert with_class_names(known, (), {1: "seat"}) == known
    mine = [Instance(1, "chair.left", 2, 1.0, (0, 0, 0))]
    assert with_class_names(mine, {"chair"}, {1: "seat", 2: "table"}) == mine, "nobody numbered it"


def test_nothing_labelled_has_no_instances() -> None:
    vertices, faces, classes = scattered((0.5, (0, 0, 0), 0))
    face_instance, found = find_instances(vertices, faces, classes, NAMES, 0, 0.05)
    assert found == []
    assert not face_instance.any()


def test_they_are_written_beside_the_mesh_and_read_again(tmp_path: Path) -> None:
    _, found = find_instances(*scattered((0.5, (1, 2, 3), 1)), NAMES, 0, 0.05)
    assert read_instances(tmp_path) == []
    path = write_instances(tmp_path, found)
    (again,) = read_instances(tmp_path)
    assert (again.name, again.id, list(again.center)) == ("plinth.001", 1, list(found[0].center))
    path.write_text('[{"id": 1}]')
    with pytest.raises(ProjectError, match=r"instances\.json is damaged"):
        read_instances(tmp_path)
