"""Kernels and torch's operations share one stream of a GPU, as docs/kernels.md says: shown without one."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp
from fieldwork.nerfcore.kernels import blocks, runtime

KERNELS = Path(runtime.__file__).parent
CUDA = torch.device("cuda", 1)
# Where kernels are launched without the functions that name the stream: on the CPU, and to see whether Warp works at all.
APART = {"encode.py": 1, "hash_grid.py": 1, "probe.py": 1}


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What Warp is asked to launch, on a GPU that is not there."""
    found: list[dict[str, Any]] = []
    monkeypatch.setattr(wp, "launch", lambda kernel, **given: found.append(given))
    monkeypatch.setattr(wp, "device_from_torch", lambda name: f"warp {name}")
    monkeypatch.setattr(wp, "stream_from_torch", lambda stream: f"warp {stream}")
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: f"stream of {device}")
    monkeypatch.setattr(runtime, "load", lambda kernel, device: None)
    monkeypatch.setattr(blocks, "load_blocks", lambda kernel, lanes, device: None)
    return found


def test_every_launch_takes_torchs_current_stream_of_its_device(launched: list[dict[str, Any]]) -> None:
    kernel: Any = SimpleNamespace()
    runtime.launch(kernel, 1000, ["a"], CUDA)
    blocks.launch_blocks(kernel, 3, 64, ["b"], CUDA)
    assert [given["stream"] for given in launched] == ["warp stream of cuda:1"] * 2
    assert [given["device"] for given in launched] == ["warp cuda:1"] * 2
    # A range is one launch: parts of it would only wait for each other.
    assert [given["dim"] for given in launched] == [1000, 3 * 64]


def test_the_stream_is_asked_for_at_each_launch(
    launched: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel: Any = SimpleNamespace()
    runtime.launch(kernel, 1, [], CUDA)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: "another")
    runtime.launch(kernel, 1, [], CUDA)
    assert [given["stream"] for given in launched] == ["warp stream of cuda:1", "warp another"]


def test_nothing_launches_copies_or_waits_by_itself() -> None:
    """No kernel is launched, no memory taken and nothing waited for but through the functions above and torch."""
    root = KERNELS.parent
    for path in sorted(root.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        launches = len(re.findall(r"\bwp\.launch(?:_tiled)?\(", text))
        allowed = 3 if path.name in ("runtime.py", "blocks.py") and path.parent == KERNELS else APART.get(path.name, 0)
        assert launches <= allowed, f"{path.relative_to(root)} launches {launches} times"
        assert not re.search(r"\bwp\.(zeros|empty|full|copy|synchronize\w*|Stream|ScopedStream|set_stream)\(", text), (
            path
        )
        assert not re.search(r"\btorch\.cuda\.(Stream|set_stream|ExternalStream)\(", text), path
