"""A process that unwraps and stands still is started anew."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.mesh import uv
from fieldwork.nerfcore.progress import Reporter


@pytest.mark.skipif(os.name == "nt", reason="stops a process by a signal")
def test_a_process_that_stands_still_is_started_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    started: list[subprocess.Popen[bytes]] = []
    worker = uv._worker

    def stopping(folder: Path, numbers: list, log) -> subprocess.Popen[bytes]:
        process = worker(folder, numbers, log)
        if not started:
            os.kill(process.pid, signal.SIGSTOP)
        started.append(process)
        return process

    monkeypatch.setattr(uv, "_worker", stopping)
    monkeypatch.setattr(uv, "STANDSTILL", 0.5)
    made = uv.unwrap(np.asarray(ball.vertices), np.asarray(ball.faces), 256, Reporter())
    assert started[0].poll() == -signal.SIGKILL
    assert np.isfinite(made.corners).all()
