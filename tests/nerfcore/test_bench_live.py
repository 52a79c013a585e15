"""The suite `live`: what it measures of a baked field, and its table."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.bench import live, suites, tables
from fieldwork.nerfcore.params import BenchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.baked import texture_bytes, voxels_folder
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.test_bench import TINY
from fieldwork.tests.nerfcore.test_training import tiny_project  # noqa: F401


def test_a_baked_field_is_measured_and_stands_on_the_page(
    tiny_project: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.FINEST", 8)
    monkeypatch.setattr("fieldwork.nerfcore.bake.verb.RAYS", 5_000)
    monkeypatch.setattr("fieldwork.nerfcore.bake.fit.ROUNDS", 1)
    monkeypatch.setattr(live, "SIZES", {"400": (40, 40), "800": (60, 60), "1080": (96, 54)})
    monkeypatch.setitem(suites.SIDES, "live", (400,))
    monkeypatch.setattr(tables, "COUNTING_SIDE", 40)
    page = tmp_path / "page.md"
    params = BenchParams(
        suite="live", out=tmp_path, scenes=[str(tiny_project)], steps=20, preset="draft", set=TINY, page=page, keep=True
    )
    result = run_verb("bench", params, Reporter())
    assert result["failed"] == 0
    (row,) = result["rows"]
    assert set(live.COLUMNS) <= row.keys()
    assert row["field_400"] > 0
    assert row["baked_400"] > 0
    assert row["bake_seconds"] > 0
    assert 1 <= row["reads"] < 200
    (run,) = (tmp_path / "projects").glob("*/runs/*")
    folder = voxels_folder(run.parents[1], run.name)
    assert row["disk_mb"] == pytest.approx(sum(p.stat().st_size for p in folder.iterdir()) / 1e6, abs=0.06)
    assert row["cells"] == 64
    assert row["graphics_mb"] <= texture_bytes(8**3, 8) / 1e6 + 0.1
    assert row["lost_psnr"] is not None
    text = page.read_text("utf-8")
    assert "## Baked fields" in text
    assert "| " + " | ".join(live.COLUMNS.values()) + " |" in text
    assert "baked, 1920×1080 (frames/s)" in (tmp_path / "live" / "table.md").read_text("utf-8")
