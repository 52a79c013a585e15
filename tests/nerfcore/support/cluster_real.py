"""The real stages of a capture for workers of a test cluster, but for the poses: those that the photos were drawn with."""

from __future__ import annotations

from typing import Any

import pytest
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows.stage_task import run_stage as real
from fieldwork.tests.nerfcore.support import reconstructed

NAME = f"{__name__}:run_stage"


def run_stage(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        reconstructed.fake(patch)
        return real(values, report)
