"""The verbs `plan` and `section`: orthographic drawings of the mesh at a stated scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SettingError
from ..mesh.instances import Instance, read_instances
from ..mesh.parts import Texture
from ..mesh.stored import LABEL_FIRST, load_surface, mesh_folder, mesh_record
from ..mesh.surface import Surface
from ..mesh.triangles import areas
from ..params import PlanParams, SectionParams
from ..progress import Reporter
from ..project.label_revision import LABEL_REVISION
from ..project.schema import Project
from ..project.store import load_project, record_step
from .conditions import chosen_classes, condition_sheet, find_places, write_places
from .lettering import warn_of_missing
from .sections import profile, write_profile
from .sheet import DPI, MM, Color, Entry, Sheet, chosen_scale, label_note, ratio, write_sheet
from .stored import read_measures
from .views import Picture, Projection, Window, picture, plane, projection
from .wording import amount, decimals, significant

MARGIN = 0.02  # of the drawing's longer side, around it
CLASS_SHARE = 0.6  # of a class's colour in a map of classes, over the grey picture
PALE = 0.55  # share of white over what lies behind a section
VOID = (0.35, 0.35, 0.35)
NO_BREAK = "\u00a0"  # a space at which lines do not end


@dataclass(frozen=True)
class Subject:
    """What is drawn: the mesh of a run in the world, how its classes are called and shown, and which revision of the marks
    they are from, if any."""

    title: str
    surface: Surface
    texture: Texture | None
    names: dict[int, str]
    colors: dict[int, Color]
    metric: bool
    measures: dict[int, dict[str, Any]]
    void: int
    instances: list[Instance]
    instance_measures: dict[int, dict[str, Any]]
    label_revision: int | None
    voxel: float

    def class_ids(self) -> list[int]:
        """The classes that occur; void is none."""
        return sorted(set(np.unique(self.surface.face_class).tolist()) - {self.void})

    def area(self, class_id: int) -> float:
        own = self.surface.faces[self.surface.face_class == class_id]
        return float(areas(self.surface.vertices.astype(np.float64), own).sum())

    def size_text(self, class_id: int) -> str:
        """The area of a class, with half of its interval where it was measured; no line ends within."""
        unit, row = "m²" if self.metric else "units²", self.measures.get(class_id)
        if row is None:
            size = significant(self.area(class_id))
        else:
            size = amount(row["area"], row["area_high"] - row["area"])  # the lower end is never below 0
        return f"{size} {unit}".replace(" ", NO_BREAK)

    def texts(self) -> list[str]:
        """What drawings write that the user named."""
        return [self.title, *self.names.values()]


def load_subject(folder: Path, run: str) -> Subject:
    """The mesh of a run as drawings need it. Raises ProjectError when there is none, or it lies elsewhere by now."""
    project: Project = load_project(folder)
    surface, texture = load_surface(folder, run)
    measures, made = read_measures(folder, run) or {}, mesh_record(folder, run).result
    return Subject(
        folder.absolute().name,
        surface,
        texture,
        {project.ignore_id: "void"} | {c.id: c.name for c in project.classes},
        {project.ignore_id: VOID} | {c.id: c.color for c in project.classes},
        project.frame.scale_known,
        {row["id"]: row for row in measures.get("classes", [])},
        project.ignore_id,
        read_instances(mesh_folder(folder, run)),
        {row["id"]: row for row in measures.get("instances", [])},
        made.get(LABEL_REVISION),
        float(made["voxel"]),
    )


def plan(params: PlanParams, report: Reporter) -> dict[str, Any]:
    """Draw plans and elevations of the mesh, in its colours, as maps of its classes and of conditions, to scale.

    Returns:
        {"scales": {view: N of 1:N, None while the scale is not known}, "label_revision": of the marks that classes are from,
        or None, "files"}
    Raises:
        ProjectError: there is no mesh. SettingError: a scale that no paper is large enough for, or an unknown class.
    """
    folder = Path(params.project)
    subject = load_subject(folder, params.run)
    target = params.out or mesh_folder(folder, params.run) / "drawings"
    scales, files = {}, []
    warn_of_missing(subject.texts(), report)
    warn_of_unused_scale(params.scale, subject, report)
    if params.conditions and not subject.class_ids():
        report.warn(f"The mesh has no classes, so no conditions are mapped. {LABEL_FIRST}")
    mapped = chosen_classes(params.conditions, subject.names, subject.void)
    places = find_places(subject.surface, mapped, subject.instances, subject.instance_measures, subject.voxel)
    legend = {c: (f"{subject.names[c]}  {subject.size_text(c)}", line_color(subject, c)) for c in mapped}
    for name in params.views:
        report.stage(f"Drawing: {name}")
        view = projection(name, params.turn)
        found = view(subject.surface.vertices)
        window, scale = framed(found[:, :2], params.scale, subject.metric)
        before = float(found[:, 2].max()) + window.pixel
        seen = picture(subject.surface, subject.texture, view, window, before, report)
        scales[name] = scale if subject.metric else None
        title, stem = f"{subject.title}: {name}{turned(params.turn)}", f"{name}{suffix(params.turn)}"
        axes, note = axis_names(view, params.turn), label_note(subject.label_revision)
        sheet = Sheet(title, window.low, window.high, scale, subject.metric, seen.color, axes, note=note)
        files += write_sheet(target / stem, sheet, report.check)
        if subject.class_ids():
            files += write_sheet(target / f"{stem}_classes", class_sheet(sheet, subject, seen), report.check)
        if mapped:
            conditions = condition_sheet(sheet, subject.surface, seen, places, legend)
            files += write_sheet(target / f"{stem}_conditions", conditions, report.check)
    if mapped:
        files.append(write_places(target / "conditions.csv", places, subject.names, subject.label_revision))
    result = {"scales": scales, "label_revision": subject.label_revision, "files": [str(path) for path in files]}
    record_step(folder, "plan", params.model_dump(mode="json"), result)
    return result


def section(params: SectionParams, report: Reporter) -> dict[str, Any]:
    """Draw the section of the mesh by a plane, over a pale picture of what lies behind it, to scale.

    Returns:
        {"scale": N of 1:N or None, "lengths": {class: length of the section}, "label_revision": as of `plan`, "files"}
    Raises:
        ProjectError: there is no mesh. SettingError: no plane, it misses the mesh, or the scale is too large.
    """
    folder = Path(params.project)
    subject = load_subject(folder, params.run)
    warn_of_missing(subject.texts(), report)
    warn_of_unused_scale(params.scale, subject, report)
    view, at = plane(params.plane, params.turn)
    report.stage("Cutting")
    cut = profile(subject.surface, view, at)
    if not len(cut.segments):
        raise SettingError(f"The plane {params.plane} misses the mesh.", spans(subject.surface.vertices, params.turn))
    found = view(subject.surface.vertices)
    window, scale = framed(found[:, :2], params.scale, subject.metric)
    report.stage("Drawing")
    seen = picture(subject.surface, subject.texture, view, window, at, report)
    pale = (255 * PALE + seen.color * (1 - PALE)).astype(np.uint8)
    lengths = cut.lengths()
    unit = "m" if subject.metric else "units"
    sheet = Sheet(
        f"{subject.title}: section {params.plane}{turned(params.turn)}",
        window.low,
        window.high,
        scale,
        subject.metric,
        pale,
        axis_names(view, params.turn),
        [
            Entry(f"{subject.names.get(c, c)}  {significant(length)}{NO_BREAK}{unit}", line_color(subject, c))
            for c, length in lengths.items()
        ],
        "Length of the section",
        view(cut.segments)[..., :2],
        np.array([line_color(subject, c) for c in cut.label.tolist()]),
        note=label_note(subject.label_revision),
    )
    target = params.out or mesh_folder(folder, params.run) / "drawings"
    stem = "section_" + params.plane.replace(" ", "").replace("=", "_") + suffix(params.turn)
    files = write_sheet(target / stem, sheet, report.check)
    files.append(target / f"{stem}.csv")
    write_profile(files[-1], cut, subject.names, subject.label_revision)
    named = {subject.names.get(c, str(c)): length for c, length in lengths.items()}
    result = {
        "scale": scale if subject.metric else None,
        "lengths": named,
        "label_revision": subject.label_revision,
        "files": [str(path) for path in files],
    }
    record_step(folder, "section", params.model_dump(mode="json"), result)
    return result


def spans(vertices: np.ndarray, turn: float) -> str:
    """From where to where vertices (V, 3) lie along the axes that planes are named by, which are turned about z."""
    along = projection("top", turn)(vertices)
    places = max(2, decimals(float(np.ptp(along, axis=0).max())) + 1)
    low, high = along.min(0).round(places) + 0.0, along.max(0).round(places) + 0.0  # − 0 is 0
    text = ", ".join(f"{axis} {a:.{places}f} to {b:.{places}f}" for axis, a, b in zip("xyz", low, high))
    return f"It spans {text}{turned(turn)}."


def warn_of_unused_scale(scale: float | None, subject: Subject, report: Reporter) -> None:
    """Warn where a scale on paper was asked for and the capture has none."""
    if scale is not None and not subject.metric:
        report.warn(
            f"The scale {ratio(scale)} is not used: the scale of the capture is not known. Set it with "
            "`fieldwork align --scale`, then run `fieldwork mesh` again."
        )


def turned(turn: float) -> str:
    """What titles say of a turn by degrees about z."""
    return f", turned {turn:g}°" if turn else ""


def suffix(turn: float) -> str:
    """What the names of files say of it, so that drawings of several turns stand beside each other."""
    return f"_turn_{turn:g}" if turn else ""


def framed(points: np.ndarray, scale: float | None, metric: bool) -> tuple[Window, float]:
    """The window around points (N, 2) of a drawing, and its scale 1 : N. While the scale of the capture is not known, it
    is drawn as large as the paper lets it."""
    low, high = points.min(0), points.max(0)
    margin = MARGIN * float((high - low).max())
    low, high = low - margin, high + margin
    stated = chosen_scale(high - low, scale if metric else None)
    pixel = stated / 1000 / (DPI * MM)
    return Window(low, high, pixel), stated


def axis_names(view: Projection, turn: float) -> tuple[str, str]:
    """What the coordinates at the sides of a drawing are: axes of the world, or turned ones."""
    found = []
    for axis in view.axes[:2]:
        number = int(np.abs(axis).argmax())
        straight = abs(axis[number]) > 1 - 1e-9
        sign = "−" if axis[number] < 0 else ""
        found.append(f"{sign}{'xyz'[number]}" if straight else f"along {turn:g}°")
    return found[0], found[1]


def class_sheet(sheet: Sheet, subject: Subject, seen: Picture) -> Sheet:
    """The same sheet with classes in their colours over a grey picture, and their areas in the legend."""
    ids = np.unique(subject.surface.face_class)
    shades = np.array([subject.colors.get(int(c), VOID) for c in ids]) * 255
    grey = np.repeat(seen.color.mean(-1, keepdims=True), 3, -1)
    hit = seen.face >= 0
    shown = seen.color.copy()
    own = shades[np.searchsorted(ids, subject.surface.face_class[seen.face[hit]])]
    shown[hit] = (CLASS_SHARE * own + (1 - CLASS_SHARE) * grey[hit]).astype(np.uint8)
    legend = [
        Entry(f"{subject.names.get(c, c)}  {subject.size_text(c)}", subject.colors.get(c, VOID)) for c in ids.tolist()
    ]
    return Sheet(
        f"{sheet.title}, classes",
        sheet.low,
        sheet.high,
        sheet.scale,
        sheet.metric,
        shown,
        sheet.axes,
        legend,
        "Area on the whole surface" + (", 95 %" if subject.measures else ""),
        note=sheet.note,
    )


def line_color(subject: Subject, class_id: int) -> Color:
    """The colour of a class, dark enough for a line on white."""
    red, green, blue = (0.75 * value for value in subject.colors.get(class_id, VOID))
    return red, green, blue
