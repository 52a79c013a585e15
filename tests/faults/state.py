"""Projects of which a file is damaged, foreign or gone, to every verb: nothing else is lost, and what is wrong is named."""

from __future__ import annotations

import json
import os
from pathlib import Path

from fieldwork.tests.nerfcore.support.ball import SMALL
from hypothesis import strategies as st

from .draw import DAMAGES, MUTATIONS, damage, drawn, mutated
from .outcome import Case, Outcome, outcome
from .scene import Scene, content, lost

AREA = "project state"
RUN = "runs/main/"
FILES = [
    *("project.json", "project.json", "poses/poses.json", "poses/points.npz", f"{RUN}config.json"),
    *(f"{RUN}field.safetensors", f"{RUN}field.safetensors", f"{RUN}metrics.json", f"{RUN}events.jsonl"),
    *("exports/main/mesh.npz", "images/03.png", "labels/03.png"),
]
VERBS = {
    "classes": {},
    "region": {"bounds": [[-1, -1, -1], [1, 1, 1]]},
    "align": {"up": "z"},
    "train": {"preset": "draft", "steps": 12, "set": SMALL, "resume": True},
    "evaluate": {},
    "render": {"orbit": 1, "size": [24, 16]},
    "mesh": {"resolution": 24},
    "measure": {},
    "package": {},
    "report": {},
    "export": {"to": "ply"},
}
# What a verb cannot do without: where one of these is not whole, a result would be made of nothing.
FIELD = {f"{RUN}config.json", f"{RUN}field.safetensors"}
NEEDED = {
    "align": {"poses/poses.json"},
    "train": {"poses/poses.json"},
    "evaluate": FIELD,
    "render": FIELD,
    "mesh": {"poses/poses.json", *FIELD},
    "measure": {"exports/main/mesh.npz"},
    "export": {"exports/main/mesh.npz"},
}
BROKEN = ("truncate", "empty", "noise", "folder", "gone")  # damages after which nothing can be read rightly

DAMAGED = st.tuples(
    st.sampled_from(FILES),
    st.one_of(
        st.tuples(st.just("damage"), DAMAGES),
        st.tuples(st.just("damage"), DAMAGES),
        st.tuples(st.just("json"), MUTATIONS),
        st.tuples(st.just("foreign"), st.sampled_from(["project.json", "poses/poses.json", f"{RUN}config.json"])),
        st.tuples(st.just("link"), st.sampled_from(["nowhere", "itself"])),
    ),
    st.sampled_from(sorted(VERBS)),
)


def needed(verb: str) -> set[str]:
    return {"project.json", *NEEDED.get(verb, ())}


def make_wrong(path: Path, kind: str, value, scene: Scene) -> bool:
    """Whether the file is certainly not whole any more."""
    if kind == "damage":
        damage(path, value)
        return value[0] in BROKEN
    if kind == "json" and path.suffix == ".json":
        path.write_text(mutated(path.read_text(), *value)[0])
        return False
    if kind == "json":
        damage(path, ("truncate", 0.5))
        return True
    if kind == "foreign":
        path.write_bytes((scene.trained / value).read_bytes())
        return False
    path.unlink()
    path.symlink_to("/nowhere/at/all" if value == "nowhere" else path.name)
    return True


def attempt(scene: Scene, damaged: tuple) -> Outcome:
    file, (kind, value), verb = damaged
    project = scene.copy(scene.trained)
    before = content(project)
    broken = make_wrong(project / file, kind, value, scene)
    given = (project / "project.json").read_bytes() if (project / "project.json").is_file() else None
    out = {"out": scene.empty("out")} if verb == "render" else {}
    reply = scene.engine.ask(verb, project=project, **VERBS[verb], **out)
    wrong = lost(project, before, but=file)
    if not wrong and reply.code and file == "project.json" and given is not None:
        now = (project / "project.json").read_bytes() if os.path.isfile(project / "project.json") else None
        wrong = "" if now == given else "the damaged project.json was written over"
    if not wrong and not reply.code and broken and file in needed(verb):
        wrong = f"{verb} did without {file}"
    if not wrong and not reply.code and kind == "foreign" and value == "project.json" != file and file in needed(verb):
        wrong = f"{verb} took {value} for {file}"
    return outcome(reply, wrong or unreadable(reply.result))


def unreadable(result) -> str:
    try:
        json.dumps(result, allow_nan=False)
    except ValueError:
        return "the result holds what is no number"
    return ""


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [Case(AREA, repr(value), lambda value=value: attempt(scene, value)) for value in drawn(DAMAGED, count, seed)]
