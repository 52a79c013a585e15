"""The page of the evidence, written wholly from records: `python -m fieldwork.nerfcore.bench.evidence.page docs/evidence.md`.

The records lie in the folder `evidence` beside it, one a profile, with their plots.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import write_json, write_text
from ..results import Taken
from .plots import write_plots
from .protocol import protocol
from .summary import Row, distinct, finished, over_seeds, published, title_of, trial_of

MARK = "This page is made by `make evidence-page` from the files in `evidence/`; it is not edited by hand."
HEAD = f"""# Evidence

{MARK}
Each table stands beside the published one: what was published, what was measured here, what differs and why. How to
measure: [the command line](cli.md#evidence). Where ours is worse, the table shows it.
"""
PROFILES = ("gpu", "cpu", "evening", "quick")  # in the order of the page
FIGURES = {  # key: heading, digits
    "psnr": ("PSNR (dB)", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "miou": ("mIoU", 3),
    "boundary_iou": ("boundary IoU", 3),
    "ece": ("calibration error", 3),
    "depth_error": ("depth error", 3),
    "steps": ("steps", 0),
    "rays": ("rays trained on", 0),
}
COSTS = {
    "params_m": ("parameters (M)", 2),
    "memory_training_mb": ("memory, training (MiB)", 0),
    "memory_rendering_mb": ("memory, rendering (MiB)", 0),
    "ms_frame": ("a frame with classes (ms)", 0),
    "ms_frame_plain": ("without classes (ms)", 0),
    "ms_sampling": ("of it sampling (ms)", 0),
    "ms_network": ("of it networks (ms)", 0),
}
ASKED = ("lpips", "memory_training_mb", "memory_rendering_mb")  # where they are missing the table says so
WHY_MAIN = """What differs: the published figures are means over a mix of scenes that is not named, at 800×800 on one RTX 4090 after
trainings of unnamed length; here every method gets the same photos, cube, rays or time, on the machine named above. Its table
cannot be right in one place: its NeRF row has about 18 times the parameters of NeRF (1.19 M: two networks of 8 × 256, counted
by a test here), so that some other network was timed and compared under that name. Baselines run their published sizes (tests
hold parameter counts, cone moments, sampling and hashing); their products are in the same half precision as ours. Mip-NeRF and
NeRF were trained for days in their publications: at a budget in which they see some thousand rays their figures say what they
can do in that time, nothing else. S-NeRF++ is its field alone, without its data pipeline."""
WHY_RAYS = """The same number of training rays instead of the same time: what a ray costs does not count here, what it teaches does.
Ours takes more rays a step, made for time: where the budget is some thousand rays these are few steps, and it is behind."""
WHY_COST = """Published: sampling 4.6 ms and networks 19.1 ms of a frame of 800×800, 15.6 M parameters, 1230 MB, on an RTX 4090. Here a
frame's time is that of the held-out pictures, scaled to 800×800 pixels; memory is measured on GPUs alone, since on a CPU one
process runs all trials. Energy is not measured."""
WHY_NOISE = "Gaussian noise on the training photos, held-out photos clean; mean and half of the range over the seeds."
WHY_ABLATION = """Ours with one part changed, same budget and seeds. The publication's boundary cases are the first rows. A knob whose
difference is smaller than the spread over the seeds has not earned its place at this budget."""
WHY_EXTRAS = (
    "What the publication does not compare with: appearance codes as NeRF-W has them, and our field baked into voxels."
)


def folder_of(page: Path) -> Path:
    return page.parent / "evidence"


def check_page(page: Path) -> None:
    """Raise InputError where `page` is a file that `write_page` did not make."""
    if page.is_file() and MARK not in page.read_text(encoding="utf-8"):
        raise InputError(f"{page} was not made by this command.", "Give the page another name; it is written wholly.")


def add_results(page: Path, record: dict[str, Any], pictures: Path) -> list[Path]:
    """Store a record with its plots beside the page, in the place of that of the same profile; returns the files."""
    path = folder_of(page) / f"{record['profile']}.json"
    write_json(path, record)
    return [path, *write_plots(record, pictures, folder_of(page))]


def read_records(folder: Path) -> list[dict[str, Any]]:
    """The records of a page, the strongest machine first. Raises InputError naming a file that is none."""
    found = []
    for profile in PROFILES:
        path = folder / f"{profile}.json"
        if not path.is_file():
            continue
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            found.append({**record, "rows": list(record["rows"]), "profile": record["profile"]})
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is not a record of the evidence: {error}.", "Remove or measure it again."
            ) from error
    return found


def page_text(folder: Path) -> str:
    """The whole page from the records in a folder. Raises InputError."""
    records = read_records(folder)
    parts = [HEAD]
    for profile in PROFILES:
        record = next((r for r in records if r["profile"] == profile), None)
        about = protocol().profiles[profile].about
        parts.append(f"## Profile {profile}: {about}\n")
        if record is None:
            parts.append(f"`fieldwork bench --suite evidence --profile {profile}`: not measured.\n")
        else:
            parts.append(_record_text(record, folder))
    return "\n".join(parts)


def write_page(page: Path) -> None:
    """Write the page anew. Raises InputError."""
    check_page(page)
    write_text(page, page_text(folder_of(page)))


def _record_text(record: dict[str, Any], folder: Path) -> str:
    lines = ["```", record["command"], "```", "", origin(record["rows"]), ""]
    own = next((row["trial"]["settings"] for row in record["rows"] if row["trial"]["variant"] == "ours"), {})
    changed = [f"`{name}={value}`" for name, value in own.items()]
    notes = [*([f"Ours is the preset standard with {', '.join(changed)}."] if changed else []), *record["notes"]]
    lines += [*(f"- {note}" for note in notes), ""] if notes else []
    for heading, table, text in (
        ("Quality at equal time", "time", WHY_MAIN),
        ("Quality at equal rays", "rays", WHY_RAYS),
    ):
        rows = finished(record, table)
        if rows:
            lines += [f"### {heading}: profile {record['profile']}", "", _quality(rows), "", text, ""]
            lines += _plots(record, folder, ("time", "parameters", "crops") if table == "time" else ())
    rows = finished(record, "time")
    if rows:
        lines += [f"### Cost: profile {record['profile']}", "", _costs(rows), "", WHY_COST, ""]
    for heading, table, text, make in (
        ("Noise", "noise", WHY_NOISE, _noise),
        ("Ablation", "ablation", WHY_ABLATION, _ablation),
        ("Not in the publication", "extras", WHY_EXTRAS, _quality),
    ):
        rows = finished(record, table)
        if rows:
            lines += [f"### {heading}: profile {record['profile']}", "", make(rows), "", text, ""]
            lines += _plots(record, folder, (table,))
    return "\n".join(lines + _failures(record))


def origin(rows: list[Row]) -> str:
    """The sentences on machines, commits, clock and other load that stand above the tables."""
    known = [row for row in rows if "taken" in row]
    taken = [Taken.model_validate(row["taken"]) for row in known]
    machines = list(dict.fromkeys(t.machine.sentence() for t in taken))
    commits = list(dict.fromkeys(f"{t.commit or 'not recorded'}{' with changes' if t.modified else ''}" for t in taken))
    dates = sorted({t.date for t in taken})
    text = (
        f"{'; '.join(machines)}. Commit {', '.join(commits)}, {' to '.join(dict.fromkeys((dates[0], dates[-1])))}."
        if dates
        else ""
    )
    loads = [row["load"] for row in known if row.get("load") is not None]
    cores = min((t.machine.cores for t in taken if t.machine.cores), default=None)
    if loads and cores and max(loads) > cores:
        text += (
            f" **Other programs ran beside it** (up to {max(loads):.0f} processes for {cores} cores): clock times would "
            "mean little, so budgets and times are those of the processor, and even these are longer than on a quiet machine."
        )
    trial = rows[0]["trial"]
    seeds = ", ".join(map(str, distinct(rows, "seed")))
    text += f" Pictures have {trial['image_size']} pixels on their longest side, {trial['held_out']} held-out photos are compared, "
    return text + f"seeds {seeds}: mean ± half of the range."


def _cell(rows: list[Row], key: str, digits: int, **fields: Any) -> str:
    """A figure over the seeds; – where there is nothing that could be measured, classes without labels for instance."""
    found = over_seeds(rows, key, **fields)
    if found is None:
        return "not measured" if key in ASKED else "–"
    return found.text(digits)


def _table(headings: list[str], cells: list[list[str]]) -> str:
    lines = ["| " + " | ".join(headings) + " |", "|" + " --- |" * len(headings)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in cells])


def _present(rows: list[Row], keys: dict[str, tuple[str, int]]) -> dict[str, tuple[str, int]]:
    """The figures that some row has, and those that say that they were not measured."""
    return {key: told for key, told in keys.items() if key in ASKED or any(row.get(key) is not None for row in rows)}


def _quality(rows: list[Row]) -> str:
    """Published value, then ours, of each method on each scene."""
    keys, cells, main = _present(rows, FIGURES), [], published()["main"]
    for scene in distinct(rows, "scene"):
        for variant in distinct([r for r in rows if r["trial"]["scene"] == scene], "variant"):
            told = main.get(variant, {})
            stands = [f"{told[key]:g} {unit}" for key, unit in (("psnr", "dB"), ("miou", "points mIoU")) if key in told]
            values = [_cell(rows, key, digits, scene=scene, variant=variant) for key, (_, digits) in keys.items()]
            budget = trial_of(next(r for r in rows if r["trial"]["variant"] == variant)).budget
            cells.append([scene, title_of(variant), ", ".join(stands) or "–", budget, *values])
    return _table(["scene", "method", "published", "budget", *(heading for heading, _ in keys.values())], cells)


def _costs(rows: list[Row]) -> str:
    keys, cells, main = _present(rows, COSTS), [], published()["main"]
    for variant in distinct(rows, "variant"):
        fps = main.get(variant, {}).get("fps")
        values = [_cell(rows, key, digits, variant=variant) for key, (_, digits) in keys.items()]
        cells.append([title_of(variant), "–" if fps is None else f"{fps:g}", *values])
    return _table(["method", "published frames/s", *(heading for heading, _ in keys.values())], cells)


def _noise(rows: list[Row]) -> str:
    told, cells = published()["noise"], []
    for scene in distinct(rows, "scene"):
        for variant in distinct(rows, "variant"):
            for noise in distinct(rows, "noise"):
                fields = {"scene": scene, "variant": variant, "noise": noise}
                stands = told.get(f"{noise:g}", {}) if variant == "ours" else {}
                text = f"{stands['psnr']} dB, {stands['miou']} points" if stands else "–"
                values = [_cell(rows, key, FIGURES[key][1], **fields) for key in ("psnr", "ssim", "miou")]
                cells.append([scene, title_of(variant), f"{noise:g}", text, *values])
    return _table(["scene", "method", "σ", "published, ours", "PSNR (dB)", "SSIM", "mIoU"], cells)


def _ablation(rows: list[Row]) -> str:
    """Each variant with its difference from ours, and whether that is more than the spread over the seeds."""
    keys, cells = ("psnr", "ssim", "miou", "boundary_iou"), []
    for scene in distinct(rows, "scene"):
        base = over_seeds(rows, "psnr", scene=scene, variant="ours")
        for variant in distinct(rows, "variant"):
            own = {"scene": scene, "variant": variant}
            gain, psnr = "–", over_seeds(rows, "psnr", **own)
            if base is not None and psnr is not None and variant != "ours":
                difference = psnr.value - base.value
                gain = f"{difference:+.2f}" + (
                    "" if abs(difference) > base.half + psnr.half else " (within the spread)"
                )
            cells.append([scene, title_of(variant), *(_cell(rows, key, FIGURES[key][1], **own) for key in keys), gain])
    return _table(["scene", "variant", "PSNR (dB)", "SSIM", "mIoU", "boundary IoU", "Δ PSNR to ours"], cells)


def _plots(record: dict[str, Any], folder: Path, names: tuple[str, ...]) -> list[str]:
    files = [(name, f"{record['profile']}-{name}.png") for name in names]
    return [f"![{name}]({folder.name}/{file})\n" for name, file in files if (folder / file).is_file()]


def _failures(record: dict[str, Any]) -> list[str]:
    rows = {(row["trial"]["scene"], row["trial"]["variant"], row["error"]) for row in record["rows"] if "error" in row}
    return [f"- {scene}, {title_of(variant)}: not measured: {error}" for scene, variant, error in sorted(rows)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="page", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("page", type=Path, help="Markdown page; its records lie in the folder evidence beside it")
    write_page(parser.parse_args().page)


if __name__ == "__main__":
    main()
