"""What the engine takes of the machine."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from fieldwork.nerfcore.engine.doctor import doctor
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.kernels.host import NICE, default_threads
from fieldwork.nerfcore.params import DoctorParams
from fieldwork.nerfcore.progress import Reporter

FAULTS = """
import resource, sys
import torch
from fieldwork.nerfcore.kernels import host
torch.set_num_threads(1)
if sys.argv[1] == "kept":
    assert host.keep_memory()
def step():
    arrays = [torch.zeros(6_000_000) for _ in range(3)]  # 24 MB each
    torch.cat(arrays)
for _ in range(6):
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""

PRIORITY = """
import psutil
from fieldwork.nerfcore.kernels.host import give_way
give_way()
give_way()
print(psutil.Process().nice())
"""


def output(code: str, *words: str) -> str:
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_every_core_computes_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FIELDWORK_THREADS", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    available = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count()
    assert default_threads() == available
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert default_threads() == 3
    monkeypatch.setenv("FIELDWORK_THREADS", "5")
    assert default_threads() == 5
    monkeypatch.setenv("FIELDWORK_THREADS", "")
    assert default_threads() == 3


@pytest.mark.parametrize("nonsense", ["0", "-2", "many", "2.5"])
def test_a_number_of_threads_that_is_none_is_told(nonsense: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDWORK_THREADS", nonsense)
    with pytest.raises(SettingError, match=f"FIELDWORK_THREADS is “{nonsense}”. Set it to a number above 0"):
        default_threads()
    assert any("FIELDWORK_THREADS" in problem for problem in doctor(DoctorParams(), Reporter())["problems"])


@pytest.mark.skipif(sys.platform != "linux" or os.confstr("CS_GNU_LIBC_VERSION") is None, reason="not glibc")
def test_arrays_are_made_of_memory_that_earlier_ones_left() -> None:
    assert int(output(FAULTS, "kept")) < 200
    assert int(output(FAULTS, "")) > 10_000  # as it would be


@pytest.mark.skipif(sys.platform == "win32", reason="priorities have other numbers")
def test_the_engine_lets_others_go_first() -> None:
    assert int(output(PRIORITY)) == max(NICE, os.nice(0))
