"""What the verb `blend` says is missing from a .blend, and what it keeps of one that is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.blender import blend as module
from fieldwork.nerfcore.data.importer import import_dataset
from fieldwork.nerfcore.params import BlendParams, ImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_points, load_poses, save_poses
from fieldwork.tests.nerfcore.support.writers import data_set


def written(package: Path, out: Path, *given: object) -> dict[str, Any]:
    """In place of Blender."""
    out.write_bytes(b"as written")
    return {"cameras": 3, "points": 0, "warnings": []}


@pytest.mark.parametrize(("source", "said"), [("sfm", True), ("transforms", False)])
def test_missing_sparse_points_are_told_only_of_estimated_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, said: bool
) -> None:
    project = tmp_path / "p"
    import_dataset(ImportParams(dataset=data_set(tmp_path / "d"), project=project), Reporter())
    save_poses(project, load_poses(project).model_copy(update={"source": source}), load_points(project))
    monkeypatch.setattr(module, "write_in_blender", written)
    result = module.blend(BlendParams(project=project, out=tmp_path / "scene.blend"), Reporter())
    assert any("sparse points" in text for text in result["warnings"]) == said


def test_a_file_that_somebody_worked_in_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project, out = tmp_path / "p", tmp_path / "scene.blend"
    kept = out.with_name("scene.blend1")
    import_dataset(ImportParams(dataset=data_set(tmp_path / "d"), project=project), Reporter())
    monkeypatch.setattr(module, "write_in_blender", written)
    for _ in range(2):
        module.blend(BlendParams(project=project, out=out), Reporter())
    assert not kept.exists()
    out.write_bytes(b"with lights of my own")
    result = module.blend(BlendParams(project=project, out=out), Reporter())
    assert any("scene.blend1" in text for text in result["warnings"])
    assert out.read_bytes() == b"as written"
    module.blend(BlendParams(project=project, out=out), Reporter())
    assert kept.read_bytes() == b"with lights of my own"


def test_a_file_of_unknown_origin_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project, out = tmp_path / "p", tmp_path / "scene.blend"
    import_dataset(ImportParams(dataset=data_set(tmp_path / "d"), project=project), Reporter())
    monkeypatch.setattr(module, "write_in_blender", written)
    out.write_bytes(b"another scene")
    module.blend(BlendParams(project=project, out=out), Reporter())
    assert out.with_name("scene.blend1").read_bytes() == b"another scene"
