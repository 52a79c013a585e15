"""Where a campaign stands: a JSON file that anybody may read, and a page for a browser.

LIST-campaign/status.json    see `status`; written every two seconds
LIST-campaign/index.html     a picture, the verdict and figures of each capture, what failed first
LIST-campaign/pictures/      small pictures of finished captures
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from PIL import Image

from ..errors import disk_refusal
from ..files import atomic_path, write_json, write_text
from ..progress import log

STATUS_FILE, PAGE, PICTURES = "status.json", "index.html", "pictures"
TEMPLATE = Path(__file__).parent / "campaign.html.j2"
PICTURE_SIDE = 320
# What is shown of the result of a stage: stage, key, name, format.
FIGURES = (
    ("new", "images", "photos", "{:.0f}"),
    ("poses", "registered", "placed", "{:.0f}"),
    ("poses", "reprojection_px", "error (px)", "{:.2f}"),
    ("train", "psnr_train", "training (dB)", "{:.1f}"),
    ("evaluate", "psnr", "held out (dB)", "{:.1f}"),
    ("evaluate", "miou", "mIoU", "{:.2f}"),
    ("mesh", "faces", "triangles", "{:.0f}"),
)
ORDER = ("failed", "running", "waiting", "done")
LEVELS = ("failed", "weak", "good")  # of the verdict on a result
STATES = {"running": "running", "done": "done", "failed": "done, with failures", "cancelled": "cancelled"}


def figures(results: dict[str, Any]) -> dict[str, str]:
    """What a capture's stages found, as name → text."""
    found = {}
    for stage, key, name, text in FIGURES:
        value = (results.get(stage) or {}).get(key)
        if isinstance(value, (int, float)):
            found[name] = text.format(value)
    return found


def capture_row(key: str, state: str, **known: Any) -> dict[str, Any]:
    """One capture as the status tells of it; `known` has what is not empty."""
    row = {"project": key, "name": Path(key).name, "state": state, "stage": "", "fraction": 0.0, "eta_s": None}
    row |= {"error": "", "hint": "", "verdict": None, "figures": {}, "picture": "", "seconds": None}
    return {**row, **known}


def status(
    name: str, state: str, started: float, rows: list[dict[str, Any]], nodes: list[dict[str, Any]], eta_s: float | None
) -> dict[str, Any]:
    """Where the campaign stands: {"campaign", "state": running, done, failed or cancelled, "started", "updated", "eta_s",
    "workers", "cores", "counts": {state: captures}, "captures": [rows, failed ones first, of those done the worst first]}."""
    counts = dict.fromkeys(ORDER, 0)
    for row in rows:
        counts[row["state"]] += 1
    return {
        "campaign": name,
        "state": state,
        "started": started,
        "updated": time.time(),
        "eta_s": eta_s,
        "workers": len(nodes),
        "cores": sum(node["cores"] for node in nodes),
        "counts": counts,
        "captures": sorted(rows, key=_rank),
    }


def _rank(row: dict[str, Any]) -> tuple[int, int]:
    """What somebody has to look at comes first."""
    level = (row["verdict"] or {}).get("level", "good")
    return ORDER.index(row["state"]), LEVELS.index(level) if level in LEVELS else len(LEVELS)


def write_status(folder: Path, value: dict[str, Any], page: bool) -> None:
    """Write the status, and with `page` the page. What cannot be written is logged: the campaign goes on."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / STATUS_FILE, value)
        if page:
            import jinja2

            when = time.strftime("%Y-%m-%d %H:%M:%S")
            template = jinja2.Template(TEMPLATE.read_text(encoding="utf-8"), autoescape=True)
            write_text(folder / PAGE, template.render(**value, told=STATES, link=_link, when=when))
    except Exception as error:
        if not isinstance(error, OSError) or disk_refusal(error, folder) is None:
            raise
        log.warning("The status of the campaign cannot be written to %s: %s", folder, error)


def _link(path: str) -> str:
    return Path(path).absolute().as_uri()


def add_picture(folder: Path, project: Path, number: int) -> str:
    """Make a small picture of a capture that has ended: a render, else one of its photos; its path relative to `folder`, empty
    where there is nothing to show."""
    renders = sorted((project / "exports" / "main" / "renders").glob("*.png"))
    candidates = [path for path in renders if not path.stem.endswith(("_depth", "_labels"))]
    candidates += [project / "runs" / "main" / "preview.png", *sorted((project / "images").glob("*"))[:1]]
    source = next((path for path in candidates if path.is_file()), None)
    if source is None:
        return ""
    target = folder / PICTURES / f"{number:05d}.jpg"
    try:
        with Image.open(source) as picture, atomic_path(target) as temporary:
            small = picture.convert("RGB")
            small.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
            small.save(temporary, "JPEG", quality=85)
    except OSError as error:
        log.warning("No picture of %s: %s", project, error)
        return ""
    return target.relative_to(folder).as_posix()
