"""The Measure panel."""

from __future__ import annotations

from typing import Any

from bpy.types import Context, UILayout

from ..addon.text import t
from . import states
from .base import StepPanel, columns, open_folder
from .states import project_folder

MOST_ROWS = 12  # of what was measured
LEAST_GUESS = 5e-4  # share of an area that is told


class FIELDWORK_PT_measure(StepPanel):
    bl_label = "Measure"
    state = staticmethod(states.measure)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        measures = states.measures(context)
        if measures:
            draw_measures(layout, measures)
        column = columns(layout)
        for name in ("distances", "scale_error", "caps"):
            column.prop(settings, name)
        layout.operator("fieldwork.measure", icon="DRIVER_DISTANCE")
        column = columns(layout)
        for name in ("sides", "conditions", "turn", "paper_scale", "drawings"):
            column.prop(settings, name)
        layout.operator("fieldwork.plan", icon="IMAGE_REFERENCE")
        columns(layout).prop(settings, "section_plane")
        layout.operator("fieldwork.section", icon="MOD_BOOLEAN")
        column = columns(layout)
        column.prop(settings, "other_project")
        if settings.other_project:
            for name in ("other_run", "common_points", "compare_limit", "compare_path"):
                column.prop(settings, name)
            layout.operator("fieldwork.compare", icon="MOD_MASK")
        columns(layout).prop(settings, "report_path")
        row = layout.row(align=True)
        row.operator("fieldwork.report", icon="FILE_TEXT")
        written = states.last_done(context, "report")
        if written is not None:
            row.operator("wm.path_open", text=t("Open"), icon="URL").filepath = str(written.result["file"])
        if folder is not None:
            open_folder(layout, folder / "exports" / settings.run)


def draw_measures(layout: UILayout, measures: dict[str, Any]) -> None:
    """Area and volume of the whole surface and of each class, and distances, with half their intervals."""
    box = layout.box().column(align=True)
    for name, amounts in (*measured_rows(measures), *distance_rows(measures)):
        line = box.split(factor=0.3)
        line.label(text=name, translate=False)
        line.label(text=amounts, translate=False)
    if measures.get("unit") != "m":
        box.label(text=t("In scene units: the scale is not known"))


def measured_rows(measures: dict[str, Any]) -> list[tuple[str, str]]:
    """The name of what was measured, and its sizes in words."""
    units = (("area", "m²"), ("volume", "m³")) if measures.get("unit") == "m" else (("area", ""), ("volume", ""))
    rows = [(t("Whole"), measures["whole"])] if "whole" in measures else []
    rows += [(row["name"], row) for row in measures.get("classes", [])[:MOST_ROWS]]
    return [
        (name, "   ".join(filter(None, [*(amount_text(row, *unit) for unit in units), guess_text(row)])))
        for name, row in rows
    ]


def distance_rows(measures: dict[str, Any]) -> list[tuple[str, str]]:
    """The names of distances, how long they are, and by how much they differ from what is known of them."""
    from ..nerfcore.measure.wording import amount  # not at the top: enabling the extension must be quick

    unit, rows = " m" if measures.get("unit") == "m" else "", []
    for row in measures.get("distances", [])[:MOST_ROWS]:
        words = [amount(row["length"], row["high"] - row["length"]) + unit]
        if row.get("difference") is not None:
            words.append(t("{:+.3g} m off", row["difference"]))
        rows.append((row["name"], "   ".join(words)))
    return rows


def guess_text(row: dict[str, Any]) -> str:
    """What of an area is a guess; empty where next to nothing is, and of measures of earlier versions."""
    share = row.get("area_guessed", 0.0) / max(row["area"], 1e-30)
    return t("{:.1%} a guess", share) if share >= LEAST_GUESS else ""


def amount_text(row: dict[str, Any], name: str, unit: str) -> str:
    """A value with half of its 95 % interval, to the digits that this leaves: “1.238 ± 0.030 m²”; empty without one."""
    from ..nerfcore.measure.wording import amount  # not at the top: enabling the extension must be quick

    value = row.get(name)
    if value is None:
        return ""
    return f"{amount(value, row[f'{name}_high'] - value)} {unit}".rstrip()  # the lower end is never below 0


CLASSES = [FIELDWORK_PT_measure]
