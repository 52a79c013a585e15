"""What the verb `blend` says is missing from a .blend."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.blender import blend as module
from fieldwork.nerfcore.data.importer import import_dataset
from fieldwork.nerfcore.params import BlendParams, ImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_points, load_poses, save_poses
from fieldwork.tests.nerfcore.support.writers import data_set


@pytest.mark.parametrize(("source", "said"), [("sfm", True), ("transforms", False)])
def test_missing_sparse_points_are_told_only_of_estimated_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, said: bool
) -> None:
    project = tmp_path / "p"
    import_dataset(ImportParams(dataset=data_set(tmp_path / "d"), project=project), Reporter())
    save_poses(project, load_poses(project).model_copy(update={"source": source}), load_points(project))
    monkeypatch.setattr(module, "write_in_blender", lambda *given: {"cameras": 3, "points": 0, "warnings": []})
    result = module.blend(BlendParams(project=project, out=tmp_path / "scene.blend"), Reporter())
    assert any("sparse points" in text for text in result["warnings"]) == said
