"""A few cases of every area of `make faults`."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fieldwork.tests.faults.campaign import AREAS, attempted
from fieldwork.tests.faults.scene import Scene

SEED = 7
LONG = ("limits", "clocks")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    made = Scene(tmp_path_factory.mktemp("faults"))
    yield made
    made.engine.kill()


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name, area in AREAS.items() if area.few],
)
def test_faults_are_told_and_nothing_is_lost(scene: Scene, name: str) -> None:
    area = AREAS[name]
    cases = (area.quick or area.cases)(scene, area.few, SEED)
    found = [(case.what, attempted(case)) for case in cases]
    assert [(what, outcome.told) for what, outcome in found if outcome.kind == "defect"] == []
    assert any(outcome.kind in ("error", "accepted") for _, outcome in found)
