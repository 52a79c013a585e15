"""Questions such as “everything on the table”, answered from a scene graph."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import InputError
from .relations import KINDS

WORDS = "|".join((*KINDS, "under"))
QUESTION = re.compile(rf"^(?P<what>.*?)\s*\b(?P<kind>{WORDS})\b\s+(?:the\s+|a\s+|an\s+)?(?P<of>.+?)[.?]?$", re.I)
ALL = {"", "everything", "all", "anything", "things", "objects", "what is", "what"}
CARRIED = ("on", "in", "part of", "hangs on")  # what is moved with a thing
HINT = (
    f"Ask for “everything on the table”, “vase next to wall.001” or a name; words are {', '.join((*KINDS, 'under'))}."
)


def answer(graph: Mapping[str, Any], question: str) -> list[str]:
    """Names of the things of a scene graph (see `graph.py`) that a question means, in the graph's order.

    A question is a name (of a class: all of its things), or [class or “everything”] RELATION NAME. What stands on something
    that is on the table is on the table as well; “next to” goes either way, “under” is “on” turned around.

    Raises:
        InputError: it is no such question, or names something that is not there.
    """
    things: Sequence[Mapping[str, Any]] = graph["things"]
    question = " ".join(question.split())
    called = any(thing["name"].lower() == question.lower() for thing in things)  # “mug on shelf” may be a name
    asked = None if called else QUESTION.match(question)
    if asked is None:
        chosen = {thing["id"] for thing in things} if question.lower() in ALL - {""} else named(things, question)
        return [thing["name"] for thing in things if thing["id"] in chosen]
    kind, goal = asked["kind"].lower(), named(things, asked["of"])
    found = related(graph["relations"], kind, goal)
    what = re.sub(
        r"^((the|all|every)\s+)+|\s+(that|which)?\s*(is|are|stands?|lies)?$", "", asked["what"].strip().lower()
    )
    if what not in ALL:
        found &= named(things, what)
    return [thing["name"] for thing in things if thing["id"] in found]


def named(things: Sequence[Mapping[str, Any]], name: str) -> set[int]:
    """Ids of the things of this name, or of a class of this name, whatever the case and an s at the end. Raises InputError."""
    wanted = name.strip().strip("“”\"'").lower()
    bare = re.sub(r"^((the|a|an|all|every)\s+)+", "", wanted)
    for form in dict.fromkeys((wanted, bare, bare.removesuffix("s"))):
        found = {thing["id"] for thing in things if thing["name"].lower() == form}
        found = found or {t["id"] for t in things if form in (t["class"].lower(), t["class"].lower().split("/")[-1])}
        if found:
            return found
    known = ", ".join(dict.fromkeys([thing["class"] for thing in things])) or "none: the mesh has no instances"
    raise InputError(f"There is no thing and no class “{name}”.", f"{HINT} Classes are {known}.")


def related(relations: Sequence[Mapping[str, Any]], kind: str, goal: set[int]) -> set[int]:
    """Ids of the things that stand in this relation to one of the goal."""
    if kind == "next to":
        pairs = [(r["subject"], r["object"]) for r in relations if r["relation"] == kind]
        return {a for a, b in pairs if b in goal} | {b for a, b in pairs if a in goal}
    if kind == "under":
        return {r["object"] for r in relations if r["relation"] == "on" and r["subject"] in goal}
    found = {r["subject"] for r in relations if r["relation"] == kind and r["object"] in goal}
    while True:
        more = {r["subject"] for r in relations if r["relation"] in CARRIED and r["object"] in found} - found
        if not more:
            return found
        found |= more
