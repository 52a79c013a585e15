"""What a caller may write to `serve`: garbage, nesting, half lines, many requests at once. It answers, and lives on."""

from __future__ import annotations

import json
import queue
import time

from fieldwork.nerfcore.verbs import VERBS
from hypothesis import strategies as st

from .draw import ODD_VALUES, drawn
from .engine import Engine
from .outcome import Case, Outcome, Reply, outcome
from .scene import Scene

AREA = "requests"
CODES = {-32700, -32600, -32601, -32602, -32000, -32001}
QUIET = 5.0  # seconds in which a request must be answered that asks for no work

ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=4)),
    max_leaves=12,
)
METHODS = st.one_of(st.sampled_from([*VERBS, "cancel", "detach", "ping", "status"]), st.text(max_size=10), ANYTHING)
PARAMS = st.dictionaries(
    st.sampled_from(["project", "photos", "out", "run", "job", "detach", "set", "classes", "bounds", "size", "list"]),
    st.one_of(ANYTHING, st.sampled_from([v for v in ODD_VALUES if v == v])),
    max_size=4,
)
WRITTEN = st.one_of(
    st.tuples(st.just("bytes"), st.binary(max_size=200).map(lambda b: b.replace(b"\n", b" "))),
    st.tuples(st.just("value"), ANYTHING),
    st.tuples(st.just("request"), st.tuples(METHODS, PARAMS)),
    st.tuples(st.just("request"), st.tuples(METHODS, PARAMS)),
    st.tuples(st.just("nested"), st.tuples(st.sampled_from(["[", '{"a":', '[{"a":']), st.integers(10, 300_000))),
    st.tuples(st.just("halves"), st.lists(st.integers(1, 60), min_size=1, max_size=5)),
    st.tuples(st.just("many"), st.integers(20, 300)),
    st.tuples(st.just("long"), st.integers(10_000, 3_000_000)),
    st.tuples(st.just("end"), st.integers(0, 40)),
)
# Verbs that work wherever they are asked, so that a drawn request may begin them.
WORKING = {"doctor", "simulate", "bench"}


def attempt(engine: Engine, written: tuple) -> Outcome:
    kind, value = written
    request = json.dumps({"jsonrpc": "2.0", "id": "asked", "method": "ping"}).encode() + b"\n"
    if kind == "request" and isinstance(value[0], str) and value[0] in WORKING:
        return Outcome("skipped")
    if kind == "bytes":
        engine.write(value + b"\n")
    elif kind == "value":
        engine.write(json.dumps(value).encode() + b"\n")
    elif kind == "request":
        made = {"jsonrpc": "2.0", "id": "drawn", "method": value[0], "params": value[1]}
        engine.write(json.dumps(made).encode() + b"\n")
    elif kind == "nested":
        engine.write(value[0].encode() * value[1] + b"\n")
    elif kind == "long":
        engine.write(b'{"jsonrpc": "2.0", "id": 1, "method": "' + b"x" * value + b'"}\n')
    elif kind == "halves":
        at = 0
        for step in value:
            engine.write(request[at : at + step])
            at = min(at + step, len(request))
            time.sleep(0.01)
        engine.write(request[at:])
    elif kind == "many":
        engine.write(request * value)
    elif kind == "end":
        return ended(engine, request[: min(value, len(request) - 1)])
    return answered(engine, expected=value if kind == "many" else 0)


def answered(engine: Engine, expected: int) -> Outcome:
    """Read until the answer of a last ping."""
    number = engine.send("ping")
    deadline, told, pongs = time.monotonic() + QUIET, Reply(), 0
    while time.monotonic() < deadline:
        try:
            message = engine.next(0.1)
        except queue.Empty:
            continue
        if message is None:
            return outcome(Reply("died", "the engine ended"))
        if "error" in message:
            error = message["error"]
            if error["code"] not in CODES:
                return outcome(Reply("internal", error["message"]))
            told = Reply("request", error["message"])
        pongs += message.get("id") == "asked" and "result" in message
        if message.get("id") == number:
            return outcome(told, f"{pongs} of {expected} requests were answered" if pongs < expected else "")
    return outcome(Reply("silent", f"no answer within {QUIET:.0f} s"))


def ended(engine: Engine, half: bytes) -> Outcome:
    """The caller goes in the middle of a line."""
    process = engine.start()
    engine.write(half)
    assert process.stdin
    process.stdin.close()
    begin = time.monotonic()
    code = process.wait(20)
    return (
        Outcome("accepted", latency=time.monotonic() - begin) if code == 0 else outcome(Reply("died", f"exit {code}"))
    )


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [Case(AREA, repr(w)[:300], lambda w=w: attempt(scene.engine, w)) for w in drawn(WRITTEN, count, seed)]
