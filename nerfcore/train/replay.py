"""Training steps recorded once and replayed: on CUDA, hundreds of launches become one (a CUDA graph).

What is recorded keeps the numbers that the host gave it and the memory that it used, so a step is only replayed while
all of these stay the same: they make up its key. With another key steps run as usual until the key has come twice in a
row, and then a recording is made.

FIELDWORK_GRAPHS (auto, on, off): auto, unless something else is asked for, records where it can and goes on without where
that fails; on: a failure is an error; off: every step runs as usual.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import torch
import warp as wp

from ..errors import SettingError
from ..kernels.runtime import current_stream

log = logging.getLogger("fieldwork")
Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)
MODES = ("auto", "on", "off")  # the first one where nothing is asked for


class Recording(Protocol[Result_co]):
    """What was recorded: `result` is written anew by each `replay`, in the same memory."""

    @property
    def result(self) -> Result_co: ...

    def replay(self) -> None:
        """Do what was recorded."""


Recorder = Callable[[Callable[[], Result]], Recording[Result]]


class CudaRecording(Generic[Result]):
    """A CUDA graph of what `work` launches, with torch and Warp on one stream; recording it computes nothing.

    `work` must have run before, so that kernels are loaded and small tables uploaded; `generator`: whose random numbers
    it draws.

    Raises:
        RuntimeError: `work` does what cannot be recorded, such as waiting for the device.
    """

    def __init__(self, work: Callable[[], Result], device: torch.device, generator: torch.Generator) -> None:
        self.graph = torch.cuda.CUDAGraph()
        self.graph.register_generator_state(generator)
        # The autograd engine launches from a thread of its own, on the stream that is recorded.
        with (
            torch.cuda.graph(self.graph, capture_error_mode="thread_local"),  # makes another stream the current one
            wp.ScopedCapture(stream=current_stream(device), force_module_load=False, external=True),
        ):
            self.result = work()

    def replay(self) -> None:
        self.graph.replay()


@dataclass
class _Kept(Generic[Result]):
    key: Hashable
    recording: Recording[Result]


def asked_mode() -> str:
    """FIELDWORK_GRAPHS.

    Raises:
        SettingError: it is none of the modes.
    """
    mode = os.environ.get("FIELDWORK_GRAPHS", "") or MODES[0]
    if mode not in MODES:
        raise SettingError(f"FIELDWORK_GRAPHS is “{mode}”.", "Set it to auto, on or off, or leave it out.")
    return mode


class Replay(Generic[Result]):
    """Runs work, or replays a recording of it. Without a `recorder` work always runs as usual."""

    def __init__(self, recorder: Recorder[Result] | None, mode: str = "auto") -> None:
        self.mode = "off" if recorder is None else mode
        self._recorder = recorder
        self._last: Hashable = None
        self._kept: _Kept[Result] | None = None
        self.recorded = self.replayed = 0

    @property
    def active(self) -> bool:
        """Whether steps are recorded at all."""
        return self.mode != "off"

    def forget(self) -> None:
        """Give the recording's memory back."""
        self._kept = None

    def run(self, key: Hashable, work: Callable[[], Result]) -> Result:
        """The result of `work`, all of whose numbers from the host `key` names; None: it must not be recorded. It holds
        until the next call."""
        if not self.active or self._recorder is None or key is None:
            self._last = None
            self.forget()
            return work()
        if self._kept is None or self._kept.key != key:
            repeated, self._last = key == self._last, key
            self.forget()
            if not repeated or not self._record(self._recorder, key, work):
                return work()
        assert self._kept is not None
        self._kept.recording.replay()
        self.replayed += 1
        return self._kept.recording.result

    def _record(self, recorder: Recorder[Result], key: Hashable, work: Callable[[], Result]) -> bool:
        try:
            self._kept = _Kept(key, recorder(work))
        except RuntimeError as error:
            if self.mode == "on":
                raise
            first = (str(error).splitlines() or [type(error).__name__])[0]
            log.warning(
                "Training steps are not recorded as CUDA graphs (FIELDWORK_GRAPHS=off asks for none): %s", first
            )
            self.mode = "off"
            return False
        self.recorded += 1
        return True
