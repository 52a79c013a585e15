"""Settings of a run with any text as their value: refused with a sentence, or trained with as they stand."""

from __future__ import annotations

import json
import math

from fieldwork.nerfcore.config import RunConfig
from fieldwork.nerfcore.project.runs import INFO, run_folder
from fieldwork.tests.nerfcore.support.ball import SMALL
from hypothesis import strategies as st

from .draw import drawn
from .outcome import Case, Outcome, outcome
from .scene import Scene

AREA = "settings"
SECONDS = 3.0  # after which an accepted training is cancelled, however large it was set
FIELDS = {
    f"{stage}.{name}": field
    for stage, info in RunConfig.model_fields.items()
    for name, field in type(info.default).model_fields.items()
}
ANY_TEXT = st.one_of(
    st.sampled_from(["0", "-1", "1e30", "nan", "inf", "-inf", "", "null", "true", "[]", "{}", "0x10", "1_000", "١"]),
    st.sampled_from(["auto", "none", "off", "float32", "bfloat16", "empty", "1e-300", "0.5", "2"]),
    st.text(max_size=12),
)
WRONG_NAMES = st.one_of(
    st.sampled_from(["train.stepz", "train", ".", "a.b.c", "train.", "__class__.x"]), st.text(max_size=9)
)


def near(name: str) -> list[str]:
    """Values of a number at its limits, beyond them, and around its default."""
    field = FIELDS[name]
    limits = [getattr(m, key) for m in field.metadata for key in ("ge", "gt", "le", "lt") if hasattr(m, key)]
    usual = [field.default] if isinstance(field.default, (int, float)) and not isinstance(field.default, bool) else []
    whole = all(isinstance(value, int) for value in usual)
    values = [
        *limits,
        *(v + d for v in limits for d in (-1, 1, 1e-6)),
        *(v * f for v in usual for f in (0.1, 0.5, 2, 10)),
    ]
    return [str(round(value)) if whole else repr(float(value)) for value in values] or ["0", "1"]


def valued(name: str) -> st.SearchStrategy[tuple[str, str]]:
    return st.tuples(st.just(name), st.one_of(st.sampled_from(near(name)), st.sampled_from(near(name)), ANY_TEXT))


KNOWN = st.sampled_from(sorted(FIELDS)).flatmap(valued)
SETTINGS = st.lists(st.one_of(KNOWN, KNOWN, KNOWN, st.tuples(WRONG_NAMES, ANY_TEXT)), min_size=1, max_size=2).map(dict)


def attempt(scene: Scene, settings: dict[str, str]) -> Outcome:
    project = scene.copy(scene.posed)
    values = {"preset": "draft", "steps": 6, "set": {**SMALL, **settings}}
    reply = scene.engine.ask("train", project=project, cancel_after=SECONDS, **values)
    if reply.code or reply.result is None:
        return outcome(reply)
    psnr = reply.result["psnr_train"]
    if psnr is None or not math.isfinite(psnr):
        return outcome(reply, f"training ended with a PSNR of {psnr}, without a word")
    return outcome(reply, taken(project, settings))


def taken(project, settings: dict[str, str]) -> str:
    """Which setting of the run is not what was asked for."""
    stored = json.loads((run_folder(project, "main") / INFO).read_text())["config"]
    for name, text in settings.items():
        stage, _, key = name.strip().partition(".")
        if key not in stored.get(stage, {}):
            return f"“{name}” is no setting, and was taken"
        value = stored[stage][key]
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if not math.isfinite(value):
                return f"{name} is {value}"
            try:
                asked = float(text)
            except ValueError:
                return f"{name} became {value} of “{text}”"
            if key != "steps" and not math.isclose(asked, value, rel_tol=1e-6, abs_tol=1e-12):
                return f"{name} became {value}, though {text} was asked for"
    return ""


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [
        Case(AREA, repr(value), lambda value=value: attempt(scene, value)) for value in drawn(SETTINGS, count, seed)
    ]
