"""Runs of earlier versions, read as runs of this one. Nothing is written: a run keeps its files until it is trained."""

from __future__ import annotations

from typing import Any

import torch

from ..config import with_present_names

# Names of a model's buffers before version 3.
TENSORS = {
    "model.shown_share": "model.visible_share",
    "model.occupancy.interest": "model.occupancy.importance",
    "model.occupancy.reach": "model.occupancy.skip_distance",
    "model.occupancy.empty": "model.occupancy.empty_distance",
}
SEEN, UNKNOWN = "model.occupancy.seen", "model.occupancy.unknown"


def migrate_info(values: Any) -> Any:
    """What a run's config.json of version 2 holds, as version 3 has it; anything else as it is."""
    if not isinstance(values, dict) or values.get("version") != 2 or not isinstance(values.get("config"), dict):
        return values
    return {**values, "version": 3, "config": with_present_names(values["config"])}


def migrate_tensors(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A checkpoint's tensors under their present names. Before version 3 nothing was noted to be unknown: all that was
    not seen counted as empty, and stays so."""
    named = {TENSORS.get(name, name): value for name, value in tensors.items()}
    if SEEN in named and UNKNOWN not in named:
        named[UNKNOWN] = torch.zeros_like(named[SEEN])
    return named
