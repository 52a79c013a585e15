"""What the Campaign panel shows, while a campaign runs and when it has ended. Each function is a generator over a
`Screen` (see driver.py)."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import bpy
from steps import PHOTOS, alias, finish

CAPTURES = ["bowl", "jug", "mask", "relief", "statue"]


def campaign(screen):
    """A campaign of five captures: the panel follows its status, failures first, with pictures of what is done."""
    folder = Path(alias(screen.folder / "objects-campaign", "objects-campaign"))
    (folder / "pictures").mkdir(exist_ok=True)
    for number, photo in enumerate(sorted(Path(PHOTOS).glob("*.*"))[: len(CAPTURES)]):
        shutil.copy(photo, folder / "pictures" / f"{number}.jpg")
    write_status(folder, "running", {"bowl": "done", "jug": "failed", "mask": "running"})
    bpy.context.scene.fieldwork.campaign = str(folder)
    panel = bpy.types.FIELDWORK_PT_campaign
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()  # open
    bpy.utils.register_class(panel)
    yield from screen.show_sidebar()
    yield 1.0
    screen.shot("running")
    write_status(folder, "failed", {name: "failed" if name == "jug" else "done" for name in CAPTURES})
    yield 3.0
    screen.shot("ended")
    yield from finish(screen)


def write_status(folder: Path, state: str, states: dict[str, str]) -> None:
    """What a campaign writes of its captures; those not named wait."""
    rows = []
    for number, name in enumerate(CAPTURES):
        now = states.get(name, "waiting")
        row = {"project": str(folder.parent / name), "name": name, "state": now, "stage": "", "fraction": 0.0}
        row |= {"eta_s": None, "error": "", "hint": "", "verdict": None, "figures": {}, "picture": "", "seconds": None}
        if now == "failed":
            row |= {"error": "The photos do not overlap enough to find their poses.", "hint": "Take more."}
        if now == "running":
            row |= {"stage": "train", "fraction": 0.4, "eta_s": 150.0}
        if now == "done":
            row |= {"fraction": 1.0, "picture": f"pictures/{number}.jpg", "seconds": 300.0}
        rows.append(row)
    order = ["failed", "running", "waiting", "done"]
    value = {
        "campaign": "objects",
        "state": state,
        "started": time.time() - 600,
        "updated": time.time(),
        "eta_s": 900.0 if state == "running" else None,
        "workers": 2,
        "cores": 2.0,
        "counts": {key: sum(row["state"] == key for row in rows) for key in order},
        "captures": sorted(rows, key=lambda row: order.index(row["state"])),
    }
    (folder / "status.json").write_text(json.dumps(value))
