"""Fixtures of the engine's tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fieldwork.tests.nerfcore.support.backends import device
from fieldwork.tests.nerfcore.support.captures import ingest, poses
from fieldwork.tests.nerfcore.support.reconstructed import place, reconstructed
from fieldwork.tests.nerfcore.support.windows_files import each_file_system

__all__ = ["device", "each_file_system", "fountain", "place", "reconstructed"]

Data = Callable[[str], Path]


@pytest.fixture(scope="session")
def fountain(shared_data: Data, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fountain, ingested at 1000 pixels and posed; tests that change it copy it."""
    project = tmp_path_factory.mktemp("poses") / "Brunnen ü"
    ingest(shared_data("fountain_p11"), project, max_size=1000)
    poses(project)
    return project
