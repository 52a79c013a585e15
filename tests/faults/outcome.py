"""What becomes of one case: a sentence, a result, or a defect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

PROMPT = 2.0  # seconds within which a cancel is answered
SHORTEST = 12  # characters of an error that says something

Kind = Literal["error", "accepted", "defect", "skipped"]


class Outcome(NamedTuple):
    """`told`: the error's sentence, what was accepted, or what is wrong. `latency`: seconds from a cancel to its answer."""

    kind: Kind
    told: str = ""
    latency: float | None = None


class Case(NamedTuple):
    """`what` says what is done, well enough to do it again; `attempt` does it."""

    area: str
    what: str
    attempt: Callable[[], Outcome]


@dataclass
class Reply:
    """How a request ended. `code` is that of the error, "" where there was a result.

    `warnings` are the lines of warning on the way; `output` what a command printed; `latency` as in `Outcome`.
    """

    code: str = ""
    message: str = ""
    result: Any = None
    warnings: tuple[str, ...] = ()
    output: str = ""
    latency: float | None = None

    @property
    def all_told(self) -> str:
        return "\n".join([self.message, str(self.result), *self.warnings])


def outcome(reply: Reply, wrong: str = "") -> Outcome:
    """The outcome of a reply.

    wrong: what was found to be wrong afterwards; for a result it is a silent acceptance, for an error a loss.
    """
    if wrong:
        return Outcome("defect", wrong, reply.latency)
    if "Traceback (most recent call last)" in reply.output + reply.message:
        return Outcome("defect", f"a traceback is shown: {reply.output.strip().splitlines()[-1:]}", reply.latency)
    if reply.code in ("internal", "died", "silent"):
        return Outcome("defect", f"{reply.code}: {reply.message}", reply.latency)
    if reply.latency is not None and reply.latency > PROMPT:
        return Outcome("defect", f"the cancel took {reply.latency:.1f} s", reply.latency)
    if reply.code == "cancelled" or not reply.code:
        return Outcome("accepted", reply.message, reply.latency)
    if len(reply.message) < SHORTEST:
        return Outcome("defect", f"the error says nothing: “{reply.message}”", reply.latency)
    return Outcome("error", reply.message, reply.latency)
