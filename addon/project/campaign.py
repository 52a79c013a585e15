"""A campaign of many captures as its status file tells of it, whoever runs it and wherever."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ..paths import absolute
from .snapshot import cached_json

STATUS_FILE, PAGE = "status.json", "index.html"
STALE = 60.0  # seconds without a word after which a campaign that says it is running has stopped

_seen: dict[Path, int] = {}  # status file → its time when it was last looked at


def folder_of(settings: Any) -> Path | None:
    """The folder of the campaign that a scene follows: LIST-campaign, also where the list itself was chosen."""
    if not settings.campaign:
        return None
    path = absolute(settings.campaign)
    return path.with_name(f"{path.stem}-campaign") if path.suffix.lower() in (".csv", ".json") else path


def status(settings: Any) -> dict[str, Any] | None:
    """What the campaign says of itself; None where nothing can be read."""
    folder = folder_of(settings)
    value = cached_json(folder / STATUS_FILE) if folder else None
    return value if isinstance(value, dict) and isinstance(value.get("captures"), list) else None


def state(value: dict[str, Any], now: float | None = None) -> str:
    """running, done, failed, cancelled, or stopped: it says that it runs and has been silent for long."""
    silent = (time.time() if now is None else now) - value.get("updated", 0.0) > STALE
    return "stopped" if value.get("state") == "running" and silent else str(value.get("state", ""))


def fraction(value: dict[str, Any]) -> float:
    """How much of the campaign is done."""
    captures = value["captures"]
    done = sum(1.0 if c["state"] in ("done", "failed") else c.get("fraction") or 0.0 for c in captures)
    return done / max(len(captures), 1)


def changed(settings: Any) -> bool:
    """Whether the status was written since this was asked last."""
    folder = folder_of(settings)
    if folder is None:
        return False
    path = folder / STATUS_FILE
    try:
        stamp = path.stat().st_mtime_ns
    except OSError:
        stamp = 0
    before = _seen.get(path)
    _seen[path] = stamp
    return before is not None and before != stamp
