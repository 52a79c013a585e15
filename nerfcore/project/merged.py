"""Two changes of one project.json, made at two places at the same time, in one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .fingerprints import digest
from .migrate import migrated

# What tells the entries of a list apart; steps have no name.
KEYS = {"images": lambda image: image["name"], "classes": lambda one: one["id"], "provenance": digest}
WORLD = ("world_from_sfm", "marks_from_sfm", "up_confidence", "scale_known")  # of the frame: they go together
GONE = object()


def merged_project(before: dict[str, Any], mine: dict[str, Any], theirs: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """`theirs` with what I changed of `before`, and whether my alignment is left out: poses there are new, so it is of others.

    Args:
        all three: contents of project.json of any version.
    """
    old, own, new = (_by_key(migrated(value)) for value in (before, mine, theirs))
    moved = [_world(value) != _world(old) for value in (own, new)]
    clash = all(moved) and _world(own) != _world(new)
    if clash:
        own = {**own, "frame": {**own.get("frame", {}), **_world(old)}}
    both = with_changes(old, own, new)
    return {**both, **{name: list(both[name].values()) for name in KEYS if name in both}}, clash


def with_changes(before: Any, mine: Any, theirs: Any) -> Any:
    """`theirs` with what differs between `before` and `mine`; of a value that both changed, mine stays."""
    if mine == before:
        return theirs
    if not all(isinstance(value, dict) for value in (before, mine, theirs)):
        return mine
    names = dict.fromkeys((*theirs, *mine))
    both = {name: with_changes(*(value.get(name, GONE) for value in (before, mine, theirs))) for name in names}
    return {name: value for name, value in both.items() if value is not GONE}


def _by_key(project: dict[str, Any]) -> dict[str, Any]:
    """A project with mappings instead of lists."""
    lists = {name: {key(entry): entry for entry in project[name]} for name, key in KEYS.items() if name in project}
    return {**project, **lists}


def _world(project: Mapping[str, Any]) -> dict[str, Any]:
    frame = project.get("frame", {})
    return {name: frame[name] for name in WORLD if name in frame}
