"""The Campaign panel: what it reads of a campaign's status, and what it says of it."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fieldwork.tests.addon.support import SETUP, make_project

pytest.importorskip("bpy")


def write_status(folder: Path, **values: Any) -> Path:
    folder.mkdir(exist_ok=True)
    row = {"stage": "", "fraction": 0.0, "eta_s": None, "error": "", "hint": "", "verdict": None, "picture": ""}
    value = {
        "campaign": "list",
        "state": "running",
        "updated": time.time(),
        "eta_s": 200.0,
        "workers": 2,
        "counts": {"failed": 1, "running": 1, "waiting": 0, "done": 1},
        "captures": [
            {**row, "project": str(folder / "a"), "name": "a", "state": "failed", "error": "No poses."},
            {**row, "project": str(folder / "b"), "name": "b", "state": "running", "stage": "train", "fraction": 0.5},
            {**row, "project": str(folder / "c"), "name": "c", "state": "done", "fraction": 1.0},
        ],
        **values,
    }
    (folder / "status.json").write_text(json.dumps(value))
    return folder


def test_a_campaign_is_found_by_its_list_or_its_folder(tmp_path):
    from fieldwork.addon.project import campaign

    folder = write_status(tmp_path / "list-campaign")
    for chosen in (tmp_path / "list.csv", tmp_path / "list.json", folder):
        settings = SimpleNamespace(campaign=str(chosen))
        assert campaign.folder_of(settings) == folder
        assert campaign.status(settings)["workers"] == 2
    for chosen in ("", str(tmp_path / "other.csv")):
        assert campaign.status(SimpleNamespace(campaign=chosen)) is None
    (folder / "status.json").write_text("{")
    assert campaign.status(SimpleNamespace(campaign=str(folder))) is None


def test_a_campaign_that_fell_silent_has_stopped(tmp_path):
    from fieldwork.addon.project import campaign

    now = time.time()
    assert campaign.state({"state": "running", "updated": now}, now) == "running"
    assert campaign.state({"state": "running", "updated": now - 61}, now) == "stopped"
    assert campaign.state({"state": "done", "updated": now - 900}, now) == "done"


def test_a_change_is_noticed_once(tmp_path):
    from fieldwork.addon.project import campaign

    folder = write_status(tmp_path / "list-campaign")
    settings = SimpleNamespace(campaign=str(folder))
    assert not campaign.changed(settings)
    assert not campaign.changed(settings)
    stamp = time.time_ns() + 1_000_000_000
    os.utime(folder / "status.json", ns=(stamp, stamp))
    assert campaign.changed(settings)
    assert not campaign.changed(settings)


def test_what_the_panel_says_and_opens(bpy_script, tmp_path):
    folder = write_status(tmp_path / "list-campaign")
    (folder / "index.html").write_text("")
    make_project(folder / "c")
    facts = bpy_script(
        SETUP
        + """
from unittest.mock import MagicMock
from types import SimpleNamespace
from fieldwork.panels import campaign as panel
from fieldwork.addon.project import campaign
settings.campaign = folder
said, opened = [], []
class Layout:
    def __getattr__(self, name):
        return lambda *a, **k: self
    def label(self, text="", **k): said.append(text)
    def progress(self, factor=0.0, text="", **k): said.append([round(factor, 3), text])
    def operator(self, name, **k):
        button = SimpleNamespace(filepath="", folder="")
        opened.append([name, button])
        return button
context = SimpleNamespace(scene=scene, region=None, preferences=bpy.context.preferences)
panel.FIELDWORK_PT_campaign.draw(SimpleNamespace(layout=Layout()), context)
header = panel.header(context)
bpy.ops.fieldwork.open_recent(folder=folder + "/c")
answer({
    "said": said, "header": list(header), "project": settings.project,
    "buttons": [[name, button.filepath or button.folder] for name, button in opened],
})
""",
        folder=folder,
    )
    assert facts["said"][0] == [0.833, "Running · 2 workers · 3:20 min left"]
    assert facts["said"][1] == "1 failed · 1 running · 0 waiting"
    assert [text for text in facts["said"][2:] if text] == ["a", "No poses.", "b · train 50%", "c"]
    assert facts["header"] == [False, "1/3"]
    assert facts["buttons"] == [
        ["fieldwork.batch", ""],
        ["wm.path_open", str(folder / "index.html")],
        ["fieldwork.open_recent", str(folder / "c")],
    ]
    assert facts["project"] == str(folder / "c")
