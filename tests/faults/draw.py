"""Drawing cases by hypothesis: the same seed draws the same ones. Strategies for what is damaged, and how."""

from __future__ import annotations

import json
import math
import random
import shutil
from pathlib import Path
from typing import Any, TypeVar

import hypothesis
from hypothesis import HealthCheck, Phase, given
from hypothesis import strategies as st

T = TypeVar("T")

ODD_VALUES: list[Any] = [
    *(math.nan, math.inf, -math.inf, -1, 0, 1e-30, 1e308, 2**70, -0.5, True, None),
    *("", "text", "../../x", "\x00", "ü" * 300, "NaN", "1e400", [], {}, [[]], [math.nan] * 4, {"a": {"b": []}}),
]

DAMAGES = st.one_of(
    st.tuples(st.just("truncate"), st.floats(0.02, 0.98)),
    st.tuples(st.just("empty"), st.just(0)),
    st.tuples(st.just("zeros"), st.floats(0, 0.9)),
    st.tuples(st.just("noise"), st.integers(0, 2**31)),
    st.tuples(st.just("text"), st.text(max_size=80)),
    st.tuples(st.just("folder"), st.just(0)),
    st.tuples(st.just("gone"), st.just(0)),
)


def drawn(strategy: st.SearchStrategy[T], count: int, seed: int) -> list[T]:
    """`count` examples of a strategy, all different; fewer where there are no more."""
    found: dict[str, T] = {}

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=2 * count,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def collect(value: T) -> None:
        found.setdefault(repr(value), value)

    collect()
    return list(found.values())[:count]


def damage(path: Path, how: tuple[str, Any]) -> None:
    """Damage a file as an example of `DAMAGES` says."""
    kind, value = how
    content = path.read_bytes()
    if kind == "truncate":
        path.write_bytes(content[: int(len(content) * value)])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "zeros":
        start = int(len(content) * value)
        path.write_bytes(content[:start] + bytes(len(content) - start))
    elif kind == "noise":
        path.write_bytes(random.Random(value).randbytes(len(content)))
    elif kind == "text":
        path.write_text(value, encoding="utf-8", errors="replace")
    else:
        path.unlink()
        if kind == "folder":
            path.mkdir()


def places(value: Any, at: tuple = ()) -> list[tuple]:
    """Keys that lead to everything inside a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, item in inside for place in ((*at, key), *places(item, (*at, key)))]


def mutated(text: str, where: float, odd: Any) -> tuple[str, str]:
    """JSON text with the value at a place replaced, and what was done. `where` in [0, 1] chooses the place.

    odd: an index into ODD_VALUES; "drop" and "twice" leave the value out and repeat it (in a list).
    """
    value = json.loads(text)
    every = places(value)
    place = every[min(int(where * len(every)), len(every) - 1)]
    holder = value
    for key in place[:-1]:
        holder = holder[key]
    if odd == "drop":
        del holder[place[-1]]
    elif odd == "twice" and isinstance(holder, list):
        holder.append(holder[place[-1]])
    else:
        holder[place[-1]] = ODD_VALUES[odd if isinstance(odd, int) else 0]
    return json.dumps(
        value
    ), f"{'.'.join(map(str, place))}: {odd if isinstance(odd, str) else repr(ODD_VALUES[odd])[:40]}"


MUTATIONS = st.tuples(
    st.floats(0, 1), st.one_of(st.integers(0, len(ODD_VALUES) - 1), st.sampled_from(["drop", "twice"]))
)


def fresh(folder: Path) -> Path:
    """The folder's place, empty: what an earlier case left there is removed, also while an engine lets go of it."""
    while folder.is_dir():
        shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
