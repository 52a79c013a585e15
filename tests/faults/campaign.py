"""`make faults`: hundreds of faults against every door of the engine, and a page that says what became of them.

python -m fieldwork.tests.faults.campaign [--seed N] [--share F] [--areas A,B] [--page FILE]
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from . import clocks, folders, imports, ingest, limits, rpc, settings, sharing, state, stops
from .outcome import Case, Outcome
from .page import write_page
from .scene import Scene


class Area(NamedTuple):
    """`count` cases in a whole campaign, `few` in the tests, which take `quick` ones where whole ones start processes."""

    cases: Callable[[Scene, int, int], list[Case]]
    count: int
    few: int
    quick: Callable[[Scene, int, int], list[Case]] | None = None


AREAS = {
    "ingest": Area(ingest.cases, 60, 12),
    "import": Area(imports.cases, 60, 12),
    "settings": Area(settings.cases, 40, 4),
    "state": Area(state.cases, 60, 10),
    "requests": Area(rpc.cases, 60, 25),
    "stops": Area(stops.cases, 54, 3, stops.quick_cases),
    "limits": Area(limits.cases, 30, 3, limits.quick_cases),
    "sharing": Area(sharing.cases, 14, 0),
    "clocks": Area(clocks.cases, 8, 2, clocks.quick_cases),
    "folders": Area(folders.cases, 20, 4),
}


def attempted(case: Case) -> Outcome:
    """What becomes of a case; what the campaign itself raises is a defect too, to be looked at."""
    try:
        return case.attempt()
    except Exception as error:  # noqa: BLE001 - one case must not end the campaign
        return Outcome("defect", f"the case failed: {type(error).__name__}: {error}")


def run(folder: Path, seed: int, share: float, names: list[str]) -> list[tuple[Case, Outcome, float]]:
    """Do `share` of each area's cases in turn; each with what became of it and its seconds."""
    scene, done = Scene(folder), []
    try:
        for name in names:
            area = AREAS[name]
            for case in area.cases(scene, max(1, round(area.count * share)), seed):
                begin = time.monotonic()
                found = attempted(case)
                done.append((case, found, time.monotonic() - begin))
                print(
                    f"{case.area}: {case.what[:200]}\n  {found.kind} {done[-1][2]:.1f} s {found.told[:300]}", flush=True
                )
    finally:
        scene.engine.kill()
    return done


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--areas", default=",".join(AREAS))
    parser.add_argument("--page", type=Path)
    parser.add_argument("--out", type=Path, help="file for every case, as JSON lines")
    given = parser.parse_args()
    # A shell that starts this in the background has it ignored, which the commands would inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        done = run(Path(folder), given.seed, given.share, given.areas.split(","))
    seconds = time.monotonic() - begin
    if given.out:
        lines = [json.dumps([case.area, case.what, *found, round(took, 2)]) for case, found, took in done]
        given.out.write_text("\n".join(lines) + "\n")
    if given.page:
        write_page(given.page, done, given.seed, seconds)
    defects = [(case, found) for case, found, _ in done if found.kind == "defect"]
    for case, found in defects:
        print(f"DEFECT {case.area}: {case.what}\n  {found.told}", file=sys.stderr)
    print(f"{len(done)} cases in {seconds:.0f} s, {len(defects)} defects")
    return 1 if defects else 0


if __name__ == "__main__":
    raise SystemExit(main())
