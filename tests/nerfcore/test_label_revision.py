"""Everything that has classes names the revision of the marks that they are from, where its readers find it."""

from __future__ import annotations

import csv
import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import OpenImageIO as oiio
import pytest
import trimesh
from fieldwork.nerfcore.bake.verb import bake
from fieldwork.nerfcore.blender.package import package
from fieldwork.nerfcore.evaluate.documentation import sections
from fieldwork.nerfcore.export.verb import export
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.labels.accept import accept
from fieldwork.nerfcore.labels.exchange import export_labels
from fieldwork.nerfcore.labels.formats import known
from fieldwork.nerfcore.measure.drawings import plan, section
from fieldwork.nerfcore.measure.epochs import compare
from fieldwork.nerfcore.mesh.verb import mesh
from fieldwork.nerfcore.params import (
    BakeParams,
    CompareParams,
    ExportParams,
    InstancesParams,
    LabelAcceptParams,
    LabelExportParams,
    MeshParams,
    PackageParams,
    PlanParams,
    RelationsParams,
    RenderParams,
    SectionParams,
    TrainParams,
)
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.run import load_info
from fieldwork.nerfcore.render.verb import render
from fieldwork.nerfcore.things.edit import instances
from fieldwork.nerfcore.things.graph import relate
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL
from fieldwork.tests.nerfcore.support.film import taken
from fieldwork.tests.nerfcore.test_labels import spread, two_strokes
from PIL import Image
from pxr import Usd

REVISION = 2


@pytest.fixture(scope="module")
def labelled(unlabelled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball with the classes of two strokes, its mesh, and its field baked."""
    folder = Path(shutil.copytree(unlabelled, tmp_path_factory.mktemp("labelled") / "p"))
    two_strokes(folder)
    spread(folder)
    accept(LabelAcceptParams(project=folder, seconds=1), Reporter())
    mesh(MeshParams(project=folder, resolution=48), Reporter())
    assert bake(BakeParams(project=folder), Reporter())["label_revision"] == REVISION
    return folder


def header(path: Path) -> list[str]:
    """The lines of a PLY file's header."""
    return path.read_bytes().split(b"end_header")[0].decode().splitlines()


def gltf(path: Path) -> dict[str, Any]:
    """The JSON part of a GLB file."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length])


@pytest.mark.slow
def test_exported_meshes_and_fields_name_it_in_their_files(labelled: Path, tmp_path: Path) -> None:
    def written(to: str, ending: str, **values: Any) -> Path:
        told = export(ExportParams(project=labelled, to=to, out=tmp_path / f"{to}{ending}", **values), Reporter())  # type: ignore[arg-type]
        assert told["label_revision"] == REVISION, to
        return Path(told["files"][0])

    assert f"comment label_revision {REVISION}" in header(written("ply", ".ply"))
    assert trimesh.load(tmp_path / "ply.ply", process=False).faces.shape[1] == 3, "it is still read"  # type: ignore[union-attr]
    assert gltf(written("glb", ".glb"))["asset"]["extras"] == {"label_revision": REVISION}
    assert written("obj", ".obj").read_text().splitlines()[0] == f"# label_revision {REVISION}"
    stage = Usd.Stage.Open(str(written("usd", ".usda")))  # pyright: ignore[reportAttributeAccessIssue]
    assert stage.GetDefaultPrim().GetCustomDataByKey("label_revision") == REVISION
    written("stl", ".stl")
    written("masks", "")
    assert json.loads(written("transforms", ".json").read_text())["label_revision"] == REVISION
    model = onnx.load(str(written("onnx", ".onnx")))
    assert {p.key: p.value for p in model.metadata_props}["label_revision"] == str(REVISION)
    with np.load(written("voxels", ".npz", resolution=16)) as data:
        assert data["label_revision"] == REVISION
    splats = written("splats", ".ply")
    assert f"comment label_revision {REVISION}" in header(splats)
    assert gltf(splats.with_name(f"{splats.stem}-splats.glb"))["asset"]["extras"] == {"label_revision": REVISION}
    assert b"label_revision\x05\x00\x00\x00int32\x04\x00\x00\x00\x02\x00\x00\x00" in written("vdb", ".vdb").read_bytes()
    voxels = json.loads((labelled / "runs" / "main" / "voxels" / "meta.json").read_text())
    assert voxels["label_revision"] == REVISION


def test_renders_and_frames_name_it(labelled: Path, tmp_path: Path) -> None:
    wanted = RenderParams(project=labelled, out=tmp_path, test=True, passes=["rgb", "semantic"])
    assert render(wanted, Reporter())["label_revision"] == REVISION
    picture = next(tmp_path.glob("*.exr"))
    spec = oiio.ImageInput.open(str(picture)).spec()
    assert spec.get_int_attribute("label_revision") == REVISION
    with Image.open(picture.with_name(f"{picture.stem}_labels.png")) as image:
        assert image.info["label_revision"] == str(REVISION)
    assert taken(labelled, FieldStore(), ["Combined"]).label_revisions == {"Ball": REVISION}


def test_drawings_and_tables_name_it(labelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.measure.drawings.DPI", 40)  # what is drawn is not looked at
    wanted = PlanParams(project=labelled, views=["front"], conditions=["top"], out=tmp_path / "plan")
    assert plan(wanted, Reporter())["label_revision"] == REVISION
    for name in ("front", "front_classes", "front_conditions"):
        with Image.open(tmp_path / "plan" / f"{name}.png") as image:
            assert image.info["Description"] == f"labels of revision {REVISION}", name
        assert f"labels of revision {REVISION}" in (tmp_path / "plan" / f"{name}.svg").read_text(), name
        assert f"/Subject (labels of revision {REVISION})".encode() in (tmp_path / "plan" / f"{name}.pdf").read_bytes()
    cut = SectionParams(project=labelled, plane="z=0", out=tmp_path / "section")
    assert section(cut, Reporter())["label_revision"] == REVISION
    for table in (tmp_path / "plan" / "conditions.csv", tmp_path / "section" / "section_z_0.csv"):
        with open(table, newline="") as file:
            rows = list(csv.DictReader(file))
        assert {row["label_revision"] for row in rows} == {str(REVISION)}
    compare(CompareParams(project=labelled, other=labelled, views=["front"], out=tmp_path / "compare"), Reporter())
    told = json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert (told["label_revision"], told["other_label_revision"]) == (REVISION, REVISION)


def test_things_and_the_package_for_blender_name_it(labelled: Path) -> None:
    assert instances(InstancesParams(project=labelled), Reporter())["label_revision"] == REVISION
    told = relate(RelationsParams(project=labelled), Reporter())
    assert told["label_revision"] == REVISION
    assert json.loads(Path(told["file"]).read_text())["label_revision"] == REVISION
    folder = Path(package(PackageParams(project=labelled), Reporter())["folder"])
    assert json.loads((folder / "package.json").read_text())["label_revision"] == REVISION


@pytest.mark.parametrize("source", ["maps", "marks"])
@pytest.mark.parametrize("kind", sorted(known.WRITERS))
def test_labels_for_other_tools_name_it(labelled: Path, tmp_path: Path, kind: str, source: str) -> None:
    out = tmp_path / f"out{known.FILES.get(kind, '')}"
    wanted = LabelExportParams.model_validate({"project": labelled, "out": out, "format": kind, "source": source})
    told = export_labels(wanted, Reporter())
    assert told["revision"] == REVISION
    files = [Path(file) for file in told["files"] if Path(file).suffix in (".json", ".xml")]
    texts = [file.read_text() for file in files]
    assert any("label_revision" in text for text in texts)


def test_a_training_with_accepted_labels_names_their_revision(labelled: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(labelled, tmp_path / "p"))
    train(TrainParams(project=folder, run="second", preset="draft", steps=5, set=SMALL), Reporter())
    assert load_info(folder, "second").accepted is None
    assert load_info(folder, "second").label_revision == REVISION
    (settings,) = (found for found in sections(folder, "second", {}) if found.title == "Settings of the run")
    assert ["labels", f"label maps of revision {REVISION} of the marks"] in [list(row) for row in settings.rows]


def test_what_has_no_marks_names_none(unlabelled: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(unlabelled, tmp_path / "p"))
    mesh(MeshParams(project=folder, resolution=32), Reporter())
    told = export(ExportParams(project=folder, to="ply", out=tmp_path / "a.ply"), Reporter())
    assert told["label_revision"] is None
    assert not any("label_revision" in line for line in header(tmp_path / "a.ply"))
