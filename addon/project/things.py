"""The things of a project's mesh and how they stand to each other, as the engine left them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from . import snapshot

HOLDING = ("part of", "in", "on", "hangs on")  # the first of them says under what a thing is listed


class Line(NamedTuple):
    """One line of the list: how deep it stands, the thing, how it stands to the one above, and what is next to it."""

    depth: int
    id: int
    name: str
    relation: str
    beside: tuple[str, ...]


def graph(folder: Path | None, run: str) -> dict[str, Any] | None:
    """The scene graph of a run's mesh; None where there is none of its present instances."""
    if folder is None:
        return None
    exports = folder / "exports" / run
    value, known = snapshot.cached_json(exports / "scene_graph.json"), snapshot.cached_json(exports / "instances.json")
    if not isinstance(value, dict) or not {"things", "relations"} <= set(value) or not isinstance(known, list):
        return None
    names = {entry["id"]: entry["name"] for entry in known}
    fresh = all(names.get(thing["id"]) == thing["name"] for thing in value["things"])
    return value if fresh else None


def outline(graph: dict[str, Any]) -> list[Line]:
    """The things of a scene graph as a list in which each stands below what holds it."""
    names = {thing["id"]: thing["name"] for thing in graph["things"]}
    above: dict[int, tuple[int, str]] = {}
    for kind in HOLDING:
        for entry in graph["relations"]:
            if entry["relation"] == kind and not _leads_to(above, entry["object"], entry["subject"]):
                above.setdefault(entry["subject"], (entry["object"], kind))
    beside: dict[int, list[str]] = {}
    for entry in graph["relations"]:
        if entry["relation"] == "next to":
            beside.setdefault(entry["subject"], []).append(names[entry["object"]])
            beside.setdefault(entry["object"], []).append(names[entry["subject"]])
    lines: list[Line] = []
    waiting = [(0, number) for number in reversed(list(names)) if number not in above]
    while waiting:
        depth, number = waiting.pop()
        relation = above[number][1] if number in above else ""
        lines.append(Line(depth, number, names[number], relation, tuple(beside.get(number, ()))))
        waiting += [(depth + 1, other) for other in reversed(list(names)) if above.get(other, (None,))[0] == number]
    return lines


def _leads_to(above: dict[int, tuple[int, str]], number: int, goal: int) -> bool:
    """Whether a thing is held by another one, over however many."""
    while number != goal and number in above:
        number = above[number][0]
    return number == goal


def held(lines: list[Line], number: int) -> list[int]:
    """The things that stand below one in the list."""
    begin = next((i for i, line in enumerate(lines) if line.id == number), None)
    found: list[int] = []
    for line in lines[begin + 1 :] if begin is not None else []:
        if line.depth <= lines[begin].depth:
            break
        found.append(line.id)
    return found
