"""Camera exports of Metashape whose photos were aligned in several groups, each in a frame of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy
from fieldwork.nerfcore.data.importer import read_dataset
from fieldwork.nerfcore.geometry.similarity import make_similarity, transform_pose
from fieldwork.tests.nerfcore.support.ball import camera_poses
from PIL import Image

TURN = scipy.spatial.transform.Rotation.from_euler("xyz", [0.3, -0.5, 1.1]).as_matrix()
FRAMES = {"0": make_similarity(3.0, TURN, np.array([5.0, -2.0, 1.0])), "1": make_similarity(0.5, TURN.T, np.ones(3))}


def transform(matrix: np.ndarray | None, scaled: bool = True) -> str:
    if matrix is None:
        return ""
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    numbers = [" ".join(map(repr, map(float, values))) for values in ((matrix[:3, :3] / scale).ravel(), matrix[:3, 3])]
    size = f"<scale>{float(scale)!r}</scale>" if scaled else ""
    return f"<transform><rotation>{numbers[0]}</rotation><translation>{numbers[1]}</translation>{size}</transform>"


def export(folder: Path, members: str, texts: dict[str, str], whole: str = "") -> Path:
    """Cameras of the ball: the n-th is given in the frame of the component members[n], of which `texts` has the transform."""
    folder.mkdir()
    cameras = ""
    for number, (pose, member) in enumerate(zip(camera_poses(len(members)), members)):
        Image.new("RGB", (40, 30)).save(folder / f"p{number}.png")
        own = transform_pose(np.linalg.inv(FRAMES[member]), pose)
        numbers = " ".join(repr(float(v)) for v in own.ravel())
        cameras += (
            f'<camera id="{number}" sensor_id="0" component_id="{member}" label="p{number}">'
            f"<transform>{numbers}</transform></camera>"
        )
    size = '<resolution width="40" height="30"/>'
    components = "".join(f'<component id="{member}">{text}</component>' for member, text in texts.items())
    (folder / "cameras.xml").write_text(
        f'<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame">{size}<calibration>{size}<f>40</f>'
        f"</calibration></sensor></sensors><components>{components}</components><cameras>{cameras}</cameras>{whole}"
        "</chunk></document>"
    )
    return folder


@pytest.mark.parametrize("whole", [False, True], ids=["components", "and the chunk"])
def test_components_are_brought_into_one_frame(tmp_path: Path, whole: bool) -> None:
    texts = {member: transform(matrix) for member, matrix in FRAMES.items()}
    dataset = read_dataset(export(tmp_path / "d", "011010", texts, texts["0"] if whole else ""))
    assert dataset.scale_known
    for view, pose in zip(dataset.views, camera_poses(6)):
        assert np.allclose(np.linalg.det(view.camera_to_world[:3, :3]), 1)
        world = transform_pose(dataset.world_from_sfm, view.camera_to_world)
        assert np.allclose(world, pose, atol=1e-6)


@pytest.mark.parametrize(
    ("members", "placed", "kept"),
    [("101011", "1", "1"), ("101000", "1", "0"), ("101000", "", "0"), ("011110", "", "1")],
)
def test_components_that_lie_nowhere_are_left_out(tmp_path: Path, members: str, placed: str, kept: str) -> None:
    """Their photos would stand among those of the others, anywhere."""
    texts = {member: transform(FRAMES[member]) if member == placed else "" for member in "01"}
    dataset = read_dataset(export(tmp_path / "d", members, texts))
    assert [view.name for view in dataset.views] == [f"p{i}" for i, member in enumerate(members) if member == kept]
    warning = dataset.warnings[0]
    assert f"{len(members) - members.count(kept)} photos are left out" in warning
    assert "cameras.xml" in warning
    assert dataset.scale_known == (placed == kept)


@pytest.mark.parametrize(
    "text",
    ["", transform(np.eye(4)), transform(FRAMES["0"], scaled=False)],
    ids=["none", "of nothing", "without a scale"],
)
def test_scale_is_known_only_where_the_export_says_so(tmp_path: Path, text: str) -> None:
    assert not read_dataset(export(tmp_path / "d", "0000", {"0": text})).scale_known
    assert read_dataset(export(tmp_path / "e", "0000", {"0": transform(FRAMES["0"])})).scale_known
