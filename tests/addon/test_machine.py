"""What belongs to the machine, and where it lies."""

from __future__ import annotations

import os
from functools import partial

import pytest

pytest.importorskip("bpy")

from fieldwork.addon import machine
from fieldwork.nerfcore import __version__


@pytest.fixture
def user(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "user_folder", lambda *parts: tmp_path.joinpath("user", *parts))
    return tmp_path / "user"


@pytest.mark.parametrize(
    ("system", "place"), [("win32", "Fieldwork/engine-1.20"), ("linux", "user/engine"), ("darwin", "user/engine")]
)
def test_the_engine_has_a_short_path_on_windows(user, tmp_path, monkeypatch, system, place):
    manifest = tmp_path / "blender_manifest.toml"
    manifest.write_text('schema_version = "1.0.0"\nversion = "1.20.3"\n')
    monkeypatch.setattr(machine.place, "feature_version", partial(machine.place.feature_version, manifest))
    monkeypatch.setattr(machine, "AS_EXTENSION", True)
    monkeypatch.setattr(machine.sys, "platform", system)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert machine.engine_folder() == tmp_path / place


def test_the_feature_version_is_that_of_the_extension():
    assert machine.place.feature_version() == __version__.rpartition(".")[0]


def test_each_blender_has_a_log_of_its_engine(user, monkeypatch):
    mine = machine.engine_log()
    number = os.getpid()
    monkeypatch.setattr(machine.os, "getpid", lambda: number + 1)
    others = machine.engine_log()
    assert mine.parent == others.parent == user / "logs"
    assert mine != others
