"""The database of features while another process holds it."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
from fieldwork.nerfcore.poses import features

HOLD = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("PRAGMA locking_mode=EXCLUSIVE")
connection.execute("BEGIN EXCLUSIVE")
print("held", flush=True)
time.sleep(float(sys.argv[2]))
"""


def held(path: Path, seconds: float) -> subprocess.Popen[str]:
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(path), str(seconds)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    return holder


def test_a_database_in_other_hands_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "features.db"
    with features.database(path):
        pass
    begin = time.monotonic()
    with held(path, 0.7) as holder, features.database(path) as db:
        assert db.num_images() == 0
        assert time.monotonic() - begin > 0.5
    assert holder.wait() == 0


def test_one_that_stays_in_other_hands_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "features.db"
    with features.database(path):
        pass
    monkeypatch.setattr(features, "BUSY_SECONDS", 0.2)
    with held(path, 2) as holder, pytest.raises(RuntimeError, match="factory"), features.database(path):
        pass
    assert holder.wait() == 0


def test_a_damaged_one_is_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "features.db"
    path.write_bytes(b"not a database" * 100)
    begin = time.monotonic()
    with pytest.raises(RuntimeError, match="factory"), features.database(path):
        pass
    assert time.monotonic() - begin < 1
