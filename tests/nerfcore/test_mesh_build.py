"""What the verb `mesh` is asked for and warns of, and what points of the surface are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.box import Box
from fieldwork.nerfcore.data.scene import Scene
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.geometry.similarity import make_similarity, transform_points
from fieldwork.nerfcore.mesh.appearance import bilinear, blend
from fieldwork.nerfcore.mesh.build import check_parts, no_surface, wanted_bounds, wanted_sides, wanted_voxel
from fieldwork.nerfcore.mesh.region import outside
from fieldwork.nerfcore.params import MeshParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Project

BOX = Box(make_similarity(2.0, np.eye(3), np.array([1.0, 0, 0])), False)
HERE = Path("project")


def scene(bounds: np.ndarray | None = None) -> Scene:
    return Scene([], [], [], bounds=bounds)


def test_the_region_is_the_projects_or_what_is_given() -> None:
    inner = np.array([[0.0, -1, -1], [2, 1, 1]])
    assert wanted_bounds(MeshParams(project=HERE), scene(), BOX) is None
    found = wanted_bounds(MeshParams(project=HERE), scene(inner), BOX)
    np.testing.assert_allclose(found, [[-0.5] * 3, [0.5] * 3])
    assert wanted_bounds(MeshParams(project=HERE, region="photos"), scene(inner), BOX) is None
    found = wanted_bounds(MeshParams(project=HERE, region="1,0,0,3,2,1"), scene(inner), BOX)
    np.testing.assert_allclose(found, [[0, 0, 0], [1, 1, 0.5]])


def test_a_region_at_an_angle_to_the_field_has_sides() -> None:
    turned = Box(
        BOX.world_from_box @ make_similarity(1.0, np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]), np.zeros(3)),
        False,
    )
    params = MeshParams(project=HERE, region="1,0,0,3,2,1")
    assert wanted_sides(params, scene(), BOX) is None
    assert wanted_sides(MeshParams(project=HERE), scene(), turned) is None
    sides = wanted_sides(params, scene(), turned)
    assert sides is not None
    world = np.array([[2.0, 1, 0.5], [3.5, 1, 0.5], [2, -0.25, 0.5], [2, 1, 1.75]])
    off = outside(sides, *transform_points(turned.box_from_world, world).T)
    np.testing.assert_allclose(off, [-0.25, 0.25, 0.125, 0.375])  # in units of the cube's frame


@pytest.mark.parametrize("text", ["here", "1,2,3", "0,0,0,1,1,0", "0,0,0,1,1,nan", "0,0,0,inf,1,1"])
def test_impossible_regions_are_named(text: str) -> None:
    with pytest.raises(SettingError, match="region"):
        wanted_bounds(MeshParams(project=HERE, region=text), scene(), BOX)


def test_a_detail_larger_than_what_is_there_is_named() -> None:
    assert "in cells of 50000 mm" in no_surface(MeshParams(project=HERE, detail=50_000)).message
    assert "cells" not in no_surface(MeshParams(project=HERE)).message


def test_a_detail_in_millimetres_needs_a_scale() -> None:
    project = Project()
    assert wanted_voxel(MeshParams(project=HERE), project, BOX) is None
    with pytest.raises(SettingError, match="scale"):
        wanted_voxel(MeshParams(project=HERE, detail=5), project, BOX)
    project.frame.scale_known = True
    assert wanted_voxel(MeshParams(project=HERE, detail=5), project, BOX) == pytest.approx(0.0025)


def test_what_one_photo_alone_says_does_not_show() -> None:
    grey = np.full((1, 6, 3), 0.4, np.float32)
    grey[0, 2] = 1.0  # a highlight
    found = blend(grey, np.ones((1, 6), np.float32))
    assert np.abs(found - 0.4).max() < 0.01
    assert (blend(np.zeros((2, 0, 3), np.float32), np.zeros((2, 0), np.float32)) == 0).all()


def test_colours_between_pixels_are_interpolated_from_their_centres() -> None:
    image = np.array([[[0], [100]], [[50], [150]]], np.uint8).repeat(3, 2)
    pixel = np.array([[0.5, 0.5], [1.0, 1.0], [1.5, 0.5], [0.0, 2.0]])
    np.testing.assert_allclose(bilinear(image, pixel)[:, 0] * 255, [0, 75, 100, 50], atol=1e-4)


def test_a_surface_in_scraps_is_said_to_be_one() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vertices = np.concatenate([corners + [3 * k, 0, 0] for k in range(3)])
    faces = np.arange(9).reshape(3, 3)
    report = Reporter()
    check_parts(vertices, faces, report)
    assert "3 parts" in report.warnings[0]
    whole = Reporter()
    check_parts(vertices, faces[:1], whole)
    assert whole.warnings == []
