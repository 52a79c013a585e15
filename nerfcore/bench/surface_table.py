"""What the suite `surface` measures, and its table."""

from __future__ import annotations

from collections.abc import Sequence

from .results import Row

# Figure: heading, what is asked of it, digits behind the point.
FIGURES = {
    "f_size": ("F at 1 % of the size", "≥ 0.97", 3),
    "f_pixel": ("F at two pixels", "≥ 0.90", 3),
    "median_pixels": ("median error (pixels)", "≤ 1", 2),
    "median_size": ("median error (share of the size)", "≤ 0.003", 4),
    "p95_pixels": ("95 % of errors (pixels)", "≤ 4", 1),
    "completeness": ("completeness of what three cameras see", "≥ 0.97", 3),
    "excess_area": ("area farther than 1 % from the truth", "≤ 0.01", 3),
    "border_faces": ("faces on the border of the box", "0", 0),
    "normal_deg": ("normals, median (degrees)", "≤ 10", 1),
    "both_sides": ("plate: the worse of its sides", "≥ 0.95", 3),
    "hit_share": ("held-out pixels that hit the mesh", "≥ 0.95", 3),
    "psnr": ("field, held-out photos (dB)", "", 2),
    "mesh_psnr": ("textured mesh, held-out photos (dB)", "≥ the field's − 2", 2),
    "delta_e": ("textured mesh, held-out photos (CIEDE2000, median)", "≤ 5", 1),
    "exposure_cost": ("loss where photos were exposed ±0.3 stops (dB)", "≤ 0.5", 2),
    "gradient": ("gradient energy over the photos'", "≥ 0.9", 2),
    "seams": ("seams, ΔE over that of other edges", "≤ 1.5", 2),
    "surface_miou": ("mIoU on the surface", "≥ 0.95", 3),
    "class_area_error": ("area of the worst class, off by", "≤ 0.03", 3),
    "outline_texels": ("outlines of painted classes, off by (texels, median)", "≤ 2", 1),
    "volume_error": ("volume of the worst closed body, off by", "", 3),
    "faces": ("faces", "", 0),
    "texture": ("texels along a side of the texture", "", 0),
    "mesh_seconds": ("mesh (s)", "≤ 360 on two cores", 0),
    "mesh_processor": ("mesh (processor s)", "", 0),
    "memory_mb": ("peak memory (MiB)", "≤ 6144", 0),
}


def figure_table(rows: Sequence[Row]) -> tuple[dict[str, str], list[Row]]:
    """Columns and rows of a table with a row for each figure and each stage of making the mesh, and a column for each of
    the suite's rows, which hold the keys of FIGURES and "stages" {name: processor seconds}."""
    names = [row["scene"] for row in rows]
    columns = {"figure": "figure", "asked": "asked", **{name: name for name in names}}
    made: list[Row] = []
    for key, (heading, asked, digits) in FIGURES.items():
        shown = {name: _text(row.get(key), digits) for name, row in zip(names, rows)}
        made.append({"figure": heading, "asked": asked, **shown})
    for stage in dict.fromkeys(name for row in rows for name in row.get("stages", {})):
        shown = {name: _text(row.get("stages", {}).get(stage), 0) for name, row in zip(names, rows)}
        made.append({"figure": f"{stage} (processor s)", "asked": "", **shown})
    return columns, made


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
