"""What the Label panel says, in words and numbers. No layout here."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from bpy.types import Context

from ..addon.labels import journal, pending, session
from ..addon.project import runs, snapshot
from ..addon.text import t
from .states import State, project_folder


class Facts(NamedTuple):
    """revision: that is shown. computed: whose labels are shown, None for none. strokes: number of marks by class id.
    shares: by class id. told: what the propagation said. working: what the engine does for it, empty for nothing."""

    revision: int = 0
    newest: int = 0
    computed: int | None = None
    strokes: dict[int | None, int] = {}
    shares: dict[int, Any] = {}
    void: float = 0.0
    told: dict[str, Any] = {}
    working: str = ""
    accepted: int | None = None

    @property
    def stale(self) -> bool:
        """Whether what is shown was not propagated."""
        return self.revision != (self.computed or 0)


_shares: dict[tuple[Any, ...], tuple[dict[int, Any], float]] = {}
KEPT = 4
NO_MARKS = ("carried", "confirmed")  # shapes in the journal of what nobody drew


def facts(context: Context) -> Facts:
    """What is known of the labelling of the scene's project."""
    folder, run = project_folder(context), context.scene.fieldwork.run
    if folder is None or not runs.has_run(folder, run):
        return Facts()
    from ..addon.labels import results  # not at the top: it needs numpy, and enabling the extension must be quick

    revision = pending.shown(folder)
    marks = [*journal.marks_at(folder, revision), *pending.marks_of(folder)]
    computed = results.nearest_computed(folder, run, revision)
    found = results.labelling(folder, run, computed)
    shares, void = ({}, 0.0) if found is None else _shares_of(folder, found)
    job = session.job_of(folder)
    info = snapshot.cached_json(folder / "runs" / run / "config.json")
    return Facts(
        revision,
        len(journal.marks(folder)),
        None if found is None else computed,
        dict(
            Counter(
                mark.get("class_id") for mark in marks if not mark.get("erase") and mark.get("shape") not in NO_MARKS
            )
        ),
        shares,
        void,
        {} if found is None else found.told,
        "" if job is None else job.title,
        ((info or {}).get("accepted") or {}).get("revision"),
    )


def _shares_of(folder: Path, found: Any) -> tuple[dict[int, Any], float]:
    from ..addon.labels import results

    key = (folder, found.made, found.revision)
    if key not in _shares:
        while len(_shares) >= KEPT:
            del _shares[next(iter(_shares))]
        _shares[key] = results.shares(found, results.void_of(folder))
    return _shares[key]


def label(context: Context) -> State:
    """What the header says: how much of the surface has a class."""
    known = facts(context)
    if known.working:
        return State(False, "…")
    if known.computed is None:
        return State(False)
    return State(True, t("{:.0%} labeled", 1 - known.void))


def class_text(known: Facts, class_id: int) -> str:
    """Number of marks and share of the surface of a class, as short as can be."""
    strokes, share = known.strokes.get(class_id, 0), known.shares.get(class_id)
    told = [f"{strokes} ✎"] if strokes > 0 else []
    if share is not None:
        told.append(f"{share.share:.0%}")
    return "  ".join(told)


def class_line(known: Facts, name: str, class_id: int) -> str:
    """The same in words, and how sure the class is."""
    strokes, share = known.strokes.get(class_id, 0), known.shares.get(class_id)
    told = t("{}: {} marks", name, strokes) if strokes != 1 else t("{}: 1 mark", name)
    if share is not None:
        told += t(", {:.0%} of the surface", share.share)
    if share is not None and share.confidence is not None:
        told += t(", {:.0%} sure", share.confidence)
    return told


def lines(known: Facts) -> list[str]:
    """Which revision is shown, and how it stands with it: a sentence each."""
    if known.revision == 0 and not known.working:
        return [t("Choose a class and draw over what belongs to it.")]
    told = [t("Revision {} of {} is shown.", known.revision, known.newest)]
    if known.working:
        told.append(t("{}: it is being computed.", known.working))
    elif known.stale:
        told.append(t("It was not propagated yet."))
    if known.computed is not None:
        told.append(t("{:.0%} of the surface is void: nothing like it is marked.", known.void))
    if known.told.get("carried"):
        told.append(t("{:.0%} is carried from the earlier epoch: look at it, then confirm.", known.told["carried"]))
    if known.told.get("seconds") is not None:
        told.append(t("The last propagation took {:.1f} s.", known.told["seconds"]))
    if known.told.get("self_check") is not None:
        told.append(t("Self-check: from the other photos {:.0%} of the marks are guessed.", known.told["self_check"]))
    unused = len(known.told.get("unused", []))
    if unused:
        why = t("there is no surface under it, or its class or photo is gone")
        told.append(
            t("{} marks do not count: {}.", unused, why) if unused > 1 else t("1 mark does not count: {}.", why)
        )
    if known.accepted is not None:
        told.append(t("The field has the classes of revision {}.", known.accepted))
    return told


def conflict_text(conflict: dict[str, int], marks: list[dict[str, Any]]) -> str:
    """Two marks that contradict each other, with the photos on which they are."""
    photos = [photo_of(conflict["revision"], marks), photo_of(conflict["other"], marks)]
    return t("Mark {} on {} contradicts mark {} on {}.", conflict["revision"], photos[0], conflict["other"], photos[1])


def doubt_text(doubt: dict[str, int], marks: list[dict[str, Any]], names: dict[int, str]) -> str:
    """A mark that looks like those of another class, by the names of the classes."""
    name = names.get(doubt["looks_like"], "?")
    return t("Mark {} on {} looks like {}: is it right?", doubt["revision"], photo_of(doubt["revision"], marks), name)


def photo_of(revision: int, marks: list[dict[str, Any]]) -> str:
    """The photo that a mark is on."""
    return marks[revision - 1]["photo"] or t("the surface") if 0 < revision <= len(marks) else "?"
