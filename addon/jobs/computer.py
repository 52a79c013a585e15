"""What is known of the computer that trains, before anything was trained on it."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

from .. import machine
from ..engine import place
from ..project.snapshot import cached_json

FILE = "computer.json"  # of the machine: what the doctor found last
STEPS = {"draft": 4000, "standard": 20000, "high": 60000}  # of the presets
# Seconds of one core that a step takes on a CPU: standard of 5 185 steps on replica_room (docs/benchmarks.md), the others by
# their ratio to it in 150 steps there (0.78 and 1.68, AMD EPYC, one thread).
CORE_SECONDS = {"draft": 0.36, "standard": 0.46, "high": 0.77}


def known() -> dict[str, Any]:
    """What the doctor found last on this computer, when it was asked or the engine was installed; empty where it never
    looked."""
    found = cached_json(machine.user_folder() / FILE)
    if isinstance(found, dict):
        return found
    return (place.installed(machine.engine_folder()) or {}).get("doctor") or {}


def remember(found: dict[str, Any]) -> None:
    """Keep what the doctor found, where the disk takes it; he can be asked again."""
    # Not at the top: enabling the extension must be quick.
    from ...nerfcore.errors import DiskError
    from ...nerfcore.files import write_json

    with suppress(DiskError):
        write_json(machine.user_folder() / FILE, found)


def title(facts: dict[str, Any]) -> str:
    """The device in a few words: “CPU, 4 cores”, “NVIDIA H100, 80 GB”."""
    if facts.get("device") == "cpu":
        return f"CPU, {facts.get('cores') or os.cpu_count()} cores"
    name = facts.get("device_name") or str(facts.get("device", "?")).upper()
    memory = facts.get("gpu_memory_gb")
    return f"{name}, {memory:.0f} GB" if memory else name


def rough_seconds(facts: dict[str, Any], preset: str, steps: int = 0) -> float | None:
    """About how long a training takes on a CPU that none was timed on; None for graphics cards.

    Args:
        steps: of the training; 0: as many as the preset has.
    """
    if facts.get("device") != "cpu":
        return None
    return (steps or STEPS[preset]) * CORE_SECONDS[preset] / max(1, facts.get("cores") or os.cpu_count() or 1)
