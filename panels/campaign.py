"""The Campaign panel: follows a batch on a cluster, what failed first, and opens what is finished."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bpy.types import Context, UILayout

from ..addon.pictures import thumbnails
from ..addon.project import campaign, snapshot
from ..addon.text import t
from .base import StepPanel, draw_wrapped, duration, text_width
from .states import State

MOST = 12  # captures of each state that are listed
ICONS = {"failed": "ERROR", "running": "PLAY", "waiting": "TIME", "done": "CHECKMARK"}
STATES = {
    "running": "Running",
    "done": "Done",
    "failed": "Done, with failures",
    "cancelled": "Cancelled",
    "stopped": "Not running any more",
}


def header(context: Context) -> State:
    value = campaign.status(context.scene.fieldwork)
    if value is None:
        return State(False)
    counts = value.get("counts", {})
    text = f"{counts.get('done', 0)}/{len(value['captures'])}"
    return State(campaign.state(value) == "done", text)


class FIELDWORK_PT_campaign(StepPanel):
    bl_label = "Campaign"
    state = staticmethod(header)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        row = layout.row(align=True)
        row.operator("fieldwork.batch", text=t("Reconstruct Many…"), icon="PRESET")
        layout.prop(settings, "campaign", text="")
        folder, value = campaign.folder_of(settings), campaign.status(settings)
        if folder is None:
            return
        if value is None:
            draw_wrapped(layout, t("No campaign in {} yet.", folder.name), text_width(context), icon="INFO")
            return
        layout.progress(factor=campaign.fraction(value), text=summary(value), type="BAR")
        counts = value.get("counts", {})
        text = t("{} failed · {} running · {} waiting", *(counts.get(k, 0) for k in ("failed", "running", "waiting")))
        layout.label(text=text)
        if (folder / campaign.PAGE).is_file():
            button = layout.operator("wm.path_open", text=t("Open Page"), icon="URL")
            button.filepath = str(folder / campaign.PAGE)
        for state in ICONS:
            some = [capture for capture in value["captures"] if capture["state"] == state]
            for capture in some[:MOST]:
                draw_capture(layout, context, folder, capture)
            if len(some) > MOST:
                layout.label(text=t("{} more on the page", len(some) - MOST), icon=ICONS[state])


def summary(value: dict[str, Any]) -> str:
    """How the campaign stands, in a line."""
    state = campaign.state(value)
    parts = [t(STATES.get(state, state)), t("{} workers", value.get("workers", 0))]
    if state == "running" and value.get("eta_s") is not None:
        parts.append(t("{} left", duration(value["eta_s"])))
    return " · ".join(parts)


def draw_capture(layout: UILayout, context: Context, folder: Path, capture: dict[str, Any]) -> None:
    """One capture: its picture, how far it is or why it failed, and a button that opens it when there is something."""
    row = layout.row(align=True)
    icon = thumbnails.picture(folder / capture["picture"]) if capture.get("picture") else 0
    text = capture["name"]
    if capture["state"] == "running":
        text += f" · {capture.get('stage', '')} {capture.get('fraction') or 0:.0%}"
    row.label(text=text, translate=False, **({"icon_value": icon} if icon else {"icon": ICONS[capture["state"]]}))
    if snapshot.has_project(Path(capture["project"])):
        row.operator("fieldwork.open_recent", text="", icon="FILE_FOLDER").folder = capture["project"]
    if capture["state"] == "failed":
        draw_wrapped(layout, capture.get("error", ""), text_width(context) - 4, icon="BLANK1")
    verdict = capture.get("verdict") or {}
    if verdict.get("level") not in (None, "good"):
        draw_wrapped(layout, " ".join(verdict.get("reasons", [])[:1]), text_width(context) - 4, icon="INFO")


CLASSES = [FIELDWORK_PT_campaign]
