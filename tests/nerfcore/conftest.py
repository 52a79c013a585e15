"""Fixtures of the engine's tests."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from fieldwork.tests.nerfcore.support.backends import device
from fieldwork.tests.nerfcore.support.captures import ingest, poses
from fieldwork.tests.nerfcore.support.once import made_once
from fieldwork.tests.nerfcore.support.reconstructed import place, reconstructed
from fieldwork.tests.nerfcore.support.unlabelled import unlabelled
from fieldwork.tests.nerfcore.support.windows_files import each_file_system

__all__ = ["device", "each_file_system", "fountain", "place", "reconstructed", "unlabelled"]

Data = Callable[[str], Path]


@pytest.fixture(scope="session")
def unposed_fountain(shared_data: Data, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fountain, ingested at 1000 pixels; tests copy it."""
    photos = shared_data("fountain_p11")
    return made_once(tmp_path_factory, "ingested", lambda folder: ingest(photos, folder / "p", max_size=1000))


@pytest.fixture(scope="session")
def fountain(unposed_fountain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fountain with poses; tests that change it copy it."""
    return made_once(tmp_path_factory, "posed", lambda folder: _posed(unposed_fountain, folder / "Brunnen ü"))


def _posed(photos: Path, project: Path) -> Path:
    shutil.copytree(photos, project)
    poses(project)
    return project
