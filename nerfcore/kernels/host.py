"""What this process takes of the machine: threads, memory that is used again, and its turn after other programs."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
from functools import cache

import psutil

from ..errors import SettingError

log = logging.getLogger("fieldwork")

# Of glibc's mallopt, see malloc.h.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX, M_ARENA_MAX = -1, -2, -4, -8
KEPT = 512 << 20  # bytes of free memory above which it goes back to the system
MORE = 64 << 20  # bytes that the heap grows by at once
NICE = 10  # of Unix: about a tenth of the processor time of a program at 0 that wants it as well


def default_threads() -> int:
    """Threads to compute with: one for each core that this process may use.

    FIELDWORK_THREADS overrides it, and so does OMP_NUM_THREADS.

    Raises:
        SettingError: FIELDWORK_THREADS is no number above 0.
    """
    available = len(os.sched_getaffinity(0)) if sys.platform == "linux" else (os.cpu_count() or 1)
    for name in ("FIELDWORK_THREADS", "OMP_NUM_THREADS"):
        text = os.environ.get(name, "")
        if text.isdecimal() and int(text) > 0:
            return int(text)
        if text and name == "FIELDWORK_THREADS":
            raise SettingError(f"{name} is “{text}”.", "Set it to a number above 0, or leave it out.")
    return available


@cache
def keep_memory() -> bool:
    """Let arrays be made of memory that earlier ones have left, whether this system's allocator can be told so.

    glibc asks the system for each large array anew, which must clear every page of it at its first use: 18 % of a
    training's processor time on a server with two cores. One heap for all threads, for theirs hold 64 MB each.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        return False
    settings = ((M_ARENA_MAX, 1), (M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, KEPT), (M_TOP_PAD, MORE))
    # All of them, whatever the first ones answer.
    answers = [mallopt(name, value) for name, value in settings]
    return all(answers)


def give_back_memory() -> None:
    """Give free memory back to the system: for when work is done and more may not come soon."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def give_way() -> None:
    """Compute when other programs do not: Blender's window then stays as quick as it is while every core is used."""
    try:
        process = psutil.Process()
        if sys.platform == "win32":
            process.nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)
        elif process.nice() < NICE:
            process.nice(NICE)
    except psutil.Error as error:
        log.info("the engine keeps its priority: %s", error)
