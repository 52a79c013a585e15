"""docs/reliability.md: the table of a campaign."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from fieldwork.nerfcore.bench.machine import checked_out, describe
from fieldwork.nerfcore.files import write_section

from .outcome import PROMPT, Case, Outcome

Done = list[tuple[Case, Outcome, float]]
HEADING = "What became of them"


def table(done: Done) -> list[str]:
    lines = [
        "| area | tried | clear error | accepted rightly | defects | not tried here |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    areas = list(dict.fromkeys(case.area for case, *_ in done))
    for area in [*areas, None]:
        kinds = Counter(found.kind for case, found, _ in done if area in (None, case.area))
        tried = sum(kinds.values()) - kinds["skipped"]
        counts = [tried, kinds["error"], kinds["accepted"], kinds["defect"], kinds["skipped"]]
        lines.append(f"| {area or '**together**'} | {' | '.join(map(str, counts))} |")
    return lines


def latencies(done: Done) -> str:
    found = np.array([found.latency for _, found, _ in done if found.latency is not None])
    if not len(found):
        return "No cancel was measured."
    middle, most = np.percentile(found, [50, 99])
    return (
        f"Cancels: {len(found)}; half of them were answered within {middle:.2f} s, 99 of 100 within {most:.2f} s, the "
        f"slowest in {found.max():.2f} s (asked for: {PROMPT:.0f} s)."
    )


def write_page(page: Path, done: Done, seed: int, seconds: float) -> None:
    """Write the section of figures anew; what else stands on the page stays."""
    commit, modified = checked_out()
    defects = [f"- {case.area}: `{case.what[:160]}`: {found.told}" for case, found, _ in done if found.kind == "defect"]
    text = [
        f"Seed {seed}, commit {commit}{' with changes' if modified else ''}, {seconds:.0f} s on {describe()}.",
        "",
        *table(done),
        "",
        latencies(done),
        *(["", "Defects:", "", *defects] if defects else []),
    ]
    write_section(page, HEADING, "\n".join(text))
