"""Plans, elevations and sections: their sizes on paper, what they show, and what they say."""

from __future__ import annotations

import csv
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import Cancelled, ProjectError, SettingError
from fieldwork.nerfcore.files import write_json
from fieldwork.nerfcore.measure import lettering
from fieldwork.nerfcore.measure.conditions import widest, without_specks
from fieldwork.nerfcore.measure.drawings import axis_names, framed, load_subject, plan, section
from fieldwork.nerfcore.measure.sections import profile
from fieldwork.nerfcore.measure.sheet import DPI, Entry, Sheet, _figure, chosen_scale, nice_step, ratio, write_sheet
from fieldwork.nerfcore.measure.views import Window, picture, plane, projection
from fieldwork.nerfcore.mesh.instances import read_instances
from fieldwork.nerfcore.params import PlanParams, SectionParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import MEASURES
from fieldwork.nerfcore.project.schema import Project, SemanticClass
from fieldwork.nerfcore.project.store import save_project
from fieldwork.tests.nerfcore.support.meshed import CLASSES, court, store_mesh
from PIL import Image

SMALL = [
    (0.2, 1.6),
    (2.5, 0.12),
    (3.0, 0.1),
    (3.4, 0.012),
    (3.7, 0.011),
]  # place along a wall and side of damages, metres


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return court(tmp_path_factory.mktemp("drawings") / "court")


@pytest.mark.parametrize("name", ["top", "bottom", "front", "back", "left", "right"])
def test_views_are_right_handed_and_look_from_where_they_say(name: str) -> None:
    from_where = {"top": (0, 0, 1), "bottom": (0, 0, -1), "front": (0, -1, 0), "back": (0, 1, 0)}
    from_where |= {"left": (-1, 0, 0), "right": (1, 0, 0)}
    axes = projection(name).axes
    np.testing.assert_allclose(axes[2], from_where[name])
    assert np.linalg.det(axes) == pytest.approx(1)


def test_a_turned_front_is_seen_squarely() -> None:
    view = projection("front", 30)
    along = np.array([np.cos(np.radians(30)), np.sin(np.radians(30)), 0])
    np.testing.assert_allclose(view(along), (1, 0, 0), atol=1e-12)
    assert axis_names(view, 30) == ("along 30°", "z")
    assert axis_names(projection("back"), 0) == ("−x", "z")


def test_a_picture_shows_each_thing_in_its_place(project: Path) -> None:
    subject = load_subject(project, "main")
    window = Window(np.array([0.0, 0]), np.array([4.0, 3]), 0.05)
    seen = picture(subject.surface, None, projection("top"), window, 5.0, Reporter())
    assert seen.color.shape == (60, 80, 3)
    label = subject.surface.face_class[seen.face]
    # Pixel (row, column) is at x = 0.05 (column + ½), y = 3 − 0.05 (row + ½).
    assert (label[31:49, 11:29] == 3).all()
    assert (label[31:39, 56:64] == 3).all()
    label[30:50, 10:30] = label[30:40, 55:65] = 1
    assert (label == 1).all()
    # From the front, the plinths stand before the wall, and what is above is empty.
    window = Window(np.array([0.0, 0]), np.array([4.0, 3]), 0.05)
    seen = picture(subject.surface, None, projection("front"), window, 5.0, Reporter())
    assert (seen.face[:10] < 0).all()
    assert (seen.color[:9] == 255).all()
    front = subject.surface.face_class[seen.face]
    assert (front[41:59, 11:29] == 3).all()
    assert (front[11:29] == 2).all()
    # Behind a section through both plinths nothing of them is left but their backs, which are turned away.
    seen = picture(subject.surface, None, projection("front"), window, -1.25, Reporter())
    assert (subject.surface.face_class[seen.face][12:59] == 2).all()


def test_a_section_is_as_long_as_what_it_cuts(project: Path) -> None:
    subject = load_subject(project, "main")
    view, at = plane("z = 0.5", 0)
    lengths = profile(subject.surface, view, at).lengths()
    assert lengths[3] == pytest.approx(4 * 1.0 + 4 * 0.5)
    assert lengths[2] == pytest.approx(2 * 4 + 2 * 0.1)
    view, at = plane("y=1.25", 0)
    lengths = profile(subject.surface, view, at).lengths()
    assert lengths[1] == pytest.approx(2 * 4 + 2 * 0.1)
    assert lengths[3] == pytest.approx(2 * (1 + 0.999) + 2 * (0.5 + 1.499))


def test_scales_are_round_and_fit_the_paper() -> None:
    assert chosen_scale(np.array([4.0, 2.6]), None) == 10
    assert chosen_scale(np.array([4.2, 2.6]), None) == 20
    assert chosen_scale(np.array([40.0, 26]), 50) == 50
    # A coin is drawn larger than it is, and a town in millimetres, of unknown scale, still fits.
    assert ratio(chosen_scale(np.array([0.025, 0.025]), None)) == "10:1"
    assert ratio(chosen_scale(np.array([0.2, 0.1]), None)) == "2:1"
    assert (np.array([3e5, 2e5]) * 1000 / chosen_scale(np.array([3e5, 2e5]), None) <= (400, 280)).all()
    assert [ratio(scale) for scale in (0.4, 1, 2.5, 1e6)] == ["2.5:1", "1:1", "1:2.5", "1:1000000"]
    with pytest.raises(SettingError, match="1:1 the drawing is 40000"):
        chosen_scale(np.array([40.0, 26]), 1)
    assert [nice_step(x, 10) for x in (1.0, 4.2, 37.0)] == [0.1, 0.5, 5.0]
    window, scale = framed(np.array([[0.0, 0], [4, 3]]), 20, True)
    # A pixel of the picture is a dot of the printer.
    assert window.pixel == pytest.approx(20 * 0.0254 / DPI)
    assert scale == 20


def test_plans_are_written_as_large_as_they_say(project: Path, tmp_path: Path) -> None:
    result = plan(PlanParams(project=project, views=["top"], scale=50, out=tmp_path), Reporter())
    assert result["scales"] == {"top": 50}
    names = ["top.png", "top.svg", "top.pdf", "top_classes.png", "top_classes.svg", "top_classes.pdf"]
    assert [Path(path).name for path in result["files"]] == names
    svg = (tmp_path / "top.svg").read_text()
    width = float(re.search(r'width="([\d.]+)pt"', svg).group(1)) / 72 * 25.4  # type: ignore[union-attr]
    # 4 m and 2 % on both sides at 1:50, and the margins.
    assert width == pytest.approx((4 * 1.04) * 1000 / 50 + 18 + 62, abs=0.2)
    with Image.open(tmp_path / "top_classes.png") as image:
        assert image.size[0] == pytest.approx(width / 25.4 * DPI, abs=2)
        colors = {tuple(c) for c in np.array(image.convert("RGB")).reshape(-1, 3)[::7].tolist()}
    assert (87, 181, 232) in colors  # the plinth's colour in the legend
    assert (tmp_path / "top.pdf").read_bytes().startswith(b"%PDF")


def test_conditions_are_hatched_numbered_and_listed(project: Path, tmp_path: Path) -> None:
    wanted = PlanParams(project=project, views=["top"], conditions=["plinth"], scale=50, out=tmp_path)
    files = [Path(path).name for path in plan(wanted, Reporter())["files"]]
    assert files[-4:] == [*(f"top_conditions.{kind}" for kind in ("png", "svg", "pdf")), "conditions.csv"]
    with open(tmp_path / "conditions.csv", newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["number"], first["class"], first["instance"]) == ("1", "plinth", "plinth.001")
    assert float(first["area"]) == pytest.approx(2 + 4 * 0.999)
    assert float(second["area"]) == pytest.approx(2 * 0.25 + 4 * 0.5 * 1.499)
    assert [float(second[axis]) for axis in "xy"] == pytest.approx([3, 1.25])
    svg = (tmp_path / "top_conditions.svg").read_text()
    assert "<pattern" in svg  # hatching is lines, not dots
    with Image.open(tmp_path / "top_conditions.png") as image:
        line = np.abs(np.diff(np.array(image.convert("RGB")).astype(int), axis=1)).max(2) > 25
    # The frame begins at 18 mm and, from below, at 26 mm; 2 % of 4 m lie around the drawing. Plinths alone are hatched.
    height, dot = line.shape[0], DPI / 25.4
    x = (18 + (np.array([0.5, 1.5, 2.0, 2.7]) + 0.08) * 20) * dot
    y = height - (26 + (np.array([0.5, 1.5]) + 0.08) * 20) * dot
    rows = slice(int(y[1]) + 8, int(y[0]) - 8)
    assert line[rows, int(x[0]) + 8 : int(x[1]) - 8].mean() > 0.1
    assert line[rows, int(x[1]) + 8 : int(x[3])].mean() < 0.05
    with pytest.raises(SettingError, match=r"no class “crack”.*floor, wall, plinth"):
        plan(PlanParams(project=project, conditions=["crack"], out=tmp_path), Reporter())


def test_a_condition_that_is_named_twice_is_mapped_once(project: Path, tmp_path: Path) -> None:
    wanted = PlanParams(project=project, views=["top"], conditions=["plinth", "wall", "plinth"], scale=50, out=tmp_path)
    plan(wanted, Reporter())
    with open(tmp_path / "conditions.csv", newline="") as file:
        rows = [(row["number"], row["class"]) for row in csv.DictReader(file)]
    assert rows == [("1", "plinth"), ("2", "plinth"), ("3", "wall")]


def test_small_damages_have_numbers_and_specks_are_told_together(tmp_path: Path) -> None:
    folder = tmp_path / "damaged"
    save_project(folder, Project(classes=CLASSES))
    wall = trimesh.creation.box(bounds=[[0, 0, 0], [4, 0.1, 3]])
    small = [trimesh.creation.box(bounds=[[x, -0.1, 1], [x + side, -0.05, 1 + side]]) for x, side in SMALL]
    parts = [wall, *small]
    mesh = trimesh.util.concatenate(parts)
    labels = np.repeat([1, *[3] * len(small)], [len(part.faces) for part in parts])
    store_mesh(folder, mesh, labels, mesh, 0.05)
    # One large damage and two that are less than 1 % of it; the last two are below four cells of 5 cm.
    assert [instance.name for instance in read_instances(folder / "exports/main")] == ["floor.001", "plinth.001"]
    wanted = PlanParams(project=folder, views=["front"], conditions=["plinth"], scale=40, out=tmp_path / "out")
    plan(wanted, Reporter())
    with open(tmp_path / "out/conditions.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    told = [(row["number"], row["instance"]) for row in rows]
    assert told == [("1", "plinth.001"), ("2", ""), ("3", ""), ("", "others (2 places)")]
    areas = [2 * side**2 + 4 * side * 0.05 for _, side in SMALL]
    assert [float(row["area"]) for row in rows] == pytest.approx([*areas[:3], sum(areas[3:])], rel=1e-4)
    assert float(rows[2]["x"]) == pytest.approx(3.05)
    assert {row["class"] for row in rows} == {"plinth"}
    svg = (tmp_path / "out/front_conditions.svg").read_text()
    texts = re.findall(r"<!-- (.*?) -->", svg)
    assert texts[texts.index("z (m)") + 1 :][:3] == ["1", "2", "3"]


def named(folder: Path, *names: str) -> Path:
    """A project with cubes beside each other, each of a class of its own."""
    classes = [SemanticClass(id=n, name=name, color=(0.2, 0.5, 0.8)) for n, name in enumerate(names, 1)]
    save_project(folder, Project(classes=classes))
    boxes = [trimesh.creation.box(bounds=[[2 * k, 0, 0], [2 * k + 1, 1, 1]]) for k in range(len(names))]
    mesh = trimesh.util.concatenate(boxes)
    store_mesh(folder, mesh, np.repeat(np.arange(len(names)) + 1, 12), mesh, 0.02)
    return folder


def test_names_are_written_as_they_are_and_long_ones_on_several_lines(tmp_path: Path) -> None:
    long = "biogenic crust of lichens and algae on the weathered northern parapet"
    folder = named(tmp_path / "cost $5$ and $x^$", "$a^$ and $b$", r"\frac{$", long)
    wanted = PlanParams(project=folder, views=["top"], conditions=["all"], scale=100, out=tmp_path / "out")
    plan(wanted, Reporter())
    for kind in ("classes", "conditions"):
        texts = re.findall(r"<!-- (.*?) -->", (tmp_path / f"out/top_{kind}.svg").read_text("utf-8"))
        assert any(text.startswith("cost $5$ and $x^$: top") for text in texts)
        assert any(text.startswith("$a^$ and $b$  ") for text in texts)
        assert any(text.startswith(r"\frac{$  ") for text in texts)
        assert "biogenic crust of lichens and algae" in texts
        assert any(text.startswith("on the weathered northern parapet") and len(text) <= 36 for text in texts)


def test_large_areas_are_written_without_exponents(tmp_path: Path) -> None:
    folder = named(tmp_path / "dam", "concrete")
    row = {"id": 1, "name": "concrete", "area": 1234.5, "area_low": 1196.5, "area_high": 1272.5}
    write_json(folder / "exports/main" / MEASURES, {"unit": "m", "classes": [row]})
    assert load_subject(folder, "main").size_text(1).replace("\u00a0", " ") == "1234 ± 38 m²"
    row |= {"area": 1.0, "area_low": 0.0, "area_high": 2.96}  # the interval ends at 0, the uncertainty does not
    write_json(folder / "exports/main" / MEASURES, {"unit": "m", "classes": [row]})
    assert load_subject(folder, "main").size_text(1).replace("\u00a0", " ") == "1.0 ± 2.0 m²"
    box = trimesh.creation.box(bounds=[[0, 0, 0], [3e5, 2e5, 10]])
    big = tmp_path / "land"
    save_project(big, Project(classes=CLASSES))
    store_mesh(big, box, np.ones(12, int), box, 1000.0)
    section(SectionParams(project=big, plane="z=5", scale=1e6, out=tmp_path / "out"), Reporter())
    assert not re.findall(r"<!-- .*\de[+-]?\d.* -->", (tmp_path / "out/section_z_5.svg").read_text("utf-8"))


def test_a_long_legend_makes_the_sheet_higher() -> None:
    window = {"low": np.zeros(2), "high": np.ones(2), "scale": 100, "metric": True, "axes": ("x", "y")}
    picture = np.zeros((4, 4, 3), np.uint8)
    entries = [Entry(f"{n} " + "long name " * 8, (0, 0, 0)) for n in range(12)]
    figure = _figure(Sheet("t", image=picture, legend=entries, **window))
    figure.canvas.draw()
    bottoms = [text.get_window_extent().y0 for text in figure.texts]
    assert min(bottoms) >= 0
    assert len(figure.texts) > 2 * len(entries)
    right = max(text.get_window_extent().x1 for text in figure.texts)
    assert right <= figure.bbox.x1


def test_long_titles_and_notes_stay_on_the_sheet() -> None:
    window = {"low": np.zeros(2), "high": np.full(2, 0.05), "scale": 1.0, "axes": ("x", "y")}
    title, note = "weathered parapet of the northern front: section z=1.2, turned 30°", "noise ±0.0123 units (95 %)"
    figure = _figure(Sheet(title, metric=False, image=np.zeros((4, 4, 3), np.uint8), note=note, **window))
    figure.canvas.draw()
    assert max(text.get_window_extent().x1 for text in figure.texts) <= figure.bbox.x1
    shown = {text.get_text(): text for text in figure.texts}
    assert title in shown
    assert any(note in text for text in shown)
    assert shown[title].get_fontsize() > 8


@pytest.mark.parametrize("scale", [20.0, 100.0, 1000.0])
def test_coordinates_beside_a_small_drawing_do_not_overlap(scale: float) -> None:
    window = {"low": np.array([4500.0, 5400.0]), "high": np.array([4504.2, 5402.0]), "metric": True, "axes": ("x", "y")}
    figure = _figure(Sheet("t", image=np.zeros((4, 4, 3), np.uint8), scale=scale, **window))
    figure.canvas.draw()
    (axes,) = figure.axes
    ends = [label.get_window_extent() for label in axes.get_xticklabels()]
    assert all(left.x1 < right.x0 for left, right in zip(ends, ends[1:]))


def test_a_cancel_does_not_wait_for_all_files_of_a_sheet(tmp_path: Path) -> None:
    window = {"low": np.zeros(2), "high": np.full(2, 0.05), "scale": 1.0, "metric": True, "axes": ("x", "y")}
    report = Reporter()

    def check() -> None:
        if (tmp_path / "top.png").is_file():
            report.cancel()
        report.check()

    with pytest.raises(Cancelled):
        write_sheet(tmp_path / "top", Sheet("t", image=np.zeros((4, 4, 3), np.uint8), **window), check)
    assert [path.name for path in tmp_path.iterdir()] == ["top.png"]


def test_characters_that_no_font_has_are_named_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lettering, "FONTS", ("DejaVu Sans",))
    folder, report = named(tmp_path / "wall", "裂缝", "moss"), Reporter()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # matplotlib's own
        plan(PlanParams(project=folder, views=["top", "front"], scale=100, out=tmp_path / "out"), report)
    (warning,) = report.warnings
    assert warning.startswith("No font has 缝 裂: drawn as boxes. Install a font")
    assert lettering.wrapped("裂" * 30, 36) == ["裂" * 18, "裂" * 12]


def test_a_mesh_without_classes_has_no_conditions_and_says_so(tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    save_project(bare, Project())
    box = trimesh.creation.box()
    store_mesh(bare, box, np.zeros(len(box.faces), int), box, 0.02)
    report = Reporter()
    plan(PlanParams(project=bare, views=["top"], conditions=["all"]), report)
    (warning,) = report.warnings
    assert "no classes, so no conditions are mapped" in warning
    assert "fieldwork train" in warning
    with pytest.raises(SettingError, match="The project has no classes yet"):
        plan(PlanParams(project=bare, conditions=["crack"]), report)


def test_specks_are_left_out_and_numbers_stand_inside() -> None:
    mask = np.zeros((20, 30), bool)
    mask[2:12, 3:23] = mask[17, 28] = True
    assert without_specks(mask, 2).sum() == 200
    assert not without_specks(mask, 500).any()
    row, column = widest(mask)
    assert 6 <= row <= 7
    assert 7 <= column <= 18


def test_a_section_is_drawn_and_listed(project: Path, tmp_path: Path) -> None:
    result = section(SectionParams(project=project, plane="z=0.5", scale=100, out=tmp_path), Reporter())
    assert result["scale"] == 100
    assert result["lengths"]["plinth"] == pytest.approx(6)
    with open(tmp_path / "section_z_0.5.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["class"] for row in rows} == {"wall", "plinth"}
    assert all(float(row["z0"]) == 0.5 for row in rows)


def test_planes_that_miss_a_turned_or_small_mesh_say_where_it_is(project: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingError) as told:
        section(SectionParams(project=project, plane="y=3", turn=90), Reporter())
    assert told.value.hint == "It spans x 0.00 to 3.10, y -4.00 to 0.00, z -0.10 to 2.50, turned 90°."
    view, at = plane("y=-3.9", 90)  # as the sentence says
    assert len(profile(load_subject(project, "main").surface, view, at).segments)
    small = tmp_path / "pin"
    save_project(small, Project(classes=CLASSES))
    box = trimesh.creation.box(bounds=[[0, 0, 0], [0.002, 0.001, 0.0015]])
    store_mesh(small, box, np.ones(12, int), box, 1e-5)
    with pytest.raises(SettingError, match=r"y 0\.00000 to 0\.00100, z 0\.00000 to 0\.00150"):
        section(SectionParams(project=small, plane="z=1"), Reporter())


def test_drawings_of_several_turns_stand_beside_each_other(project: Path, tmp_path: Path) -> None:
    for turn in (0, 30, -45.5):
        settings = {"project": project, "turn": turn, "scale": 100, "out": tmp_path}
        plan(PlanParams(views=["front"], conditions=["plinth"], **settings), Reporter())
        section(SectionParams(plane="z=0.5", **settings), Reporter())
    found = {path.name for path in tmp_path.iterdir()}
    for stem in ("front", "front{}_classes", "front{}_conditions", "section_z_0.5"):
        stem = stem if "{}" in stem else stem + "{}"
        assert {f"{stem.format(turn)}.svg" for turn in ("", "_turn_30", "_turn_-45.5")} <= found
    assert {"section_z_0.5.csv", "section_z_0.5_turn_30.csv"} <= found
    assert "<!-- court: front, turned 30° -->" in (tmp_path / "front_turn_30.svg").read_text("utf-8")
    assert "section z=0.5, turned 30° -->" in (tmp_path / "section_z_0.5_turn_30.svg").read_text("utf-8")
    assert "turned" not in (tmp_path / "front.svg").read_text("utf-8")


def test_impossible_sections_and_meshes_are_named(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldwork.nerfcore.measure.drawings.DPI", 40)  # what is drawn is not looked at
    for text in ("z", "up=1", "z=high"):
        with pytest.raises(SettingError, match="no plane"):
            section(SectionParams(project=project, plane=text), Reporter())
    with pytest.raises(SettingError, match=r"misses the mesh\. It spans x 0\.00 to 4\.00"):
        section(SectionParams(project=project, plane="z=9"), Reporter())
    unknown = court(tmp_path / "unscaled", metric=False)
    report = Reporter()
    result = plan(PlanParams(project=unknown, views=["right"], scale=100), report)
    section(SectionParams(project=unknown, plane="z=0.5", scale=100), report)
    assert len(report.warnings) == 2
    assert all("1:100 is not used: the scale of the capture is not known" in text for text in report.warnings)
    plan(PlanParams(project=unknown, views=["right"]), report)
    assert len(report.warnings) == 2
    assert result["scales"] == {"right": None}
    assert "scale of the capture is not known" in (Path(result["files"][0]).with_suffix(".svg")).read_text()
    (unknown / "exports" / "main" / "mesh.npz").unlink()
    with pytest.raises(ProjectError, match="no mesh"):
        plan(PlanParams(project=unknown), Reporter())
