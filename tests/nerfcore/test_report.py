"""The report: what stands in its tables, as HTML and as PDF."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import ProjectError, SettingError
from fieldwork.nerfcore.evaluate import report_pdf
from fieldwork.nerfcore.evaluate.documentation import Section, _judgement, results_of
from fieldwork.nerfcore.evaluate.report import by_view, report, write_report
from fieldwork.nerfcore.evaluate.report_pdf import write_pdf
from fieldwork.nerfcore.files import write_json
from fieldwork.nerfcore.params import ReconstructParams, ReportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import MEASURES, METRICS, run_folder
from fieldwork.nerfcore.project.store import edit_project, load_project
from fieldwork.nerfcore.workflows.reconstruct import reconstruct
from fieldwork.tests.nerfcore.support.ball import RADIUS, ball_project
from fieldwork.tests.nerfcore.support.meshed import store_mesh
from PIL import Image

AMOUNTS = {"area": 1.571, "area_low": 1.5, "area_high": 1.64, "volume": None, "volume_low": None, "volume_high": None}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The ball, posed, trained, evaluated, meshed and measured as far as a report can see."""
    folder = ball_project(tmp_path / "ball", views=9)
    ball = trimesh.creation.icosphere(2, RADIUS)
    store_mesh(folder, ball, np.where(ball.triangles_center[:, 2] > 0, 1, 2), ball, 0.03)
    with edit_project(folder) as edited:
        for image in edited.images:
            image.sha256, image.source = image.name.rjust(64, "a"), f"/home/somebody/{image.name}.jpg"
        edited.images[3].status, edited.images[3].reason = "rejected", "it is blurred <very>"
        mesh = {
            "faces": 320,
            "watertight": True,
            "voxel": 0.03,
            "unseen": 0.031,
            "classes": {"top": {"faces": 160, "area": 1.57}},
        }
        edited.record("mesh", {"run": "main"}, mesh)
        edited.record("mesh", {"run": "other"}, mesh | {"faces": 7})
        edited.record("align", {"project": "/home/somebody/ball", "up": "z"}, {})
    scores = [{"name": "00", "psnr": 31.25, "ssim": 0.91}]
    test = {"images": 1, "psnr": 31.25, "ssim": 0.91, "miou": 0.987, "fps": None, "per_image": scores}
    write_json(run_folder(folder, "main") / METRICS, {"test": test})
    check = {
        "name": "door",
        "use": "check",
        "length": 2.004,
        "low": 1.99,
        "high": 2.02,
        "known": 2.0,
        "difference": 0.004,
    }
    measures = {"unit": "m", "scale": {"u_percent": 0.4, "source": "1 control distance"}, "distances": [check]}
    write_json(folder / "exports/main" / MEASURES, measures | {"classes": [{"name": "top"} | AMOUNTS], "instances": []})
    drawings = folder / "exports/main/drawings"
    drawings.mkdir()
    Image.fromarray(np.full((30, 40, 3), 200, np.uint8)).save(drawings / "top.png")
    return folder


def test_another_person_finds_what_is_needed_to_repeat_it(project: Path) -> None:
    result = report(ReportParams(project=project), Reporter())
    html = Path(result["file"]).read_text("utf-8")
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r'src="data:[^"]*"', "", html)))
    for words in (
        "Photos used 8",
        "320 faces, closed, cells of 0.03 m, 3.1 % of the area a guess",
        "1.571 1.500 … 1.640 open",
        "door check 2.0040 1.9900 … 2.0200 2.0000 +4.0 mm",
        "Root mean square of their differences: 4.0 mm",
        "uncertainty of the scale: 0.4 % (1 control distance)",
        "00 31.25 0.910",
        "0 PINHOLE 40 × 40 55.00, 55.00 20.00, 20.00 none 9",
        "01 01.jpg 40 × 40 " + "01".rjust(64, "a"),
        "it is blurred &lt;very&gt;",
        "sampling.resolution",
        "torch 2.",
        "up=z",
    ):
        assert words in text, words
    assert "somebody" not in html
    assert html.count("data:image/png") == 1  # the drawing
    assert "03.jpg" not in html


@pytest.mark.parametrize("level", ["good", "weak"])
def test_nothing_is_left_to_do_only_where_all_is_good(level: str) -> None:
    verdict = {"level": level, "reasons": [] if level == "good" else ["train longer."]}
    made = _judgement({"train": {"verdict": verdict}}, {"verdict": {"level": "good", "reasons": []}, "advice": []})
    assert (["next", "Nothing: more photos would change little."] in made.rows) == (level == "good")


def test_what_is_said_beside_a_good_verdict_does_not_contradict_it() -> None:
    few = {"verdict": {"level": "good", "reasons": ["Only one photo was compared: hold out more."]}, "advice": []}
    assert _judgement({}, few).rows == [
        ["in short", "Yes."],
        ["but", "evaluate: Only one photo was compared: hold out more."],
    ]


def test_sizes_of_small_things_keep_their_digits_and_have_units(project: Path) -> None:
    path = project / "exports/main" / MEASURES
    measures = json.loads(path.read_text())
    pin = {"name": "pin", "use": "check", "length": 0.00204, "low": 0.00202, "high": 0.00206, "known": 0.002}
    write_json(path, measures | {"distances": [pin | {"difference": 0.00004}]})
    with edit_project(project) as edited:
        mesh = next(step for step in edited.provenance if step.verb == "mesh").result
        edited.record("mesh", {"run": "main"}, mesh | {"classes": {"top": {"faces": 160, "area": 0.00012345}}})
    html = Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")
    assert '<td class="n">0.0001234</td>' in html
    assert "area (m²)</th></tr>" in html
    for cell in ("0.002040", "0.002020 … 0.002060", "+0.040 mm"):
        assert f"<td>{cell}</td>" in html
    assert "Root mean square of their differences: 0.040 mm" in html


def test_intervals_that_are_cut_off_at_zero_have_no_more_digits_than_others(project: Path) -> None:
    path = project / "exports/main" / MEASURES
    short = {"name": "pin", "use": "check", "length": 0.0001, "low": 0.0, "high": 0.0012, "known": 0.0002}
    speck = {"name": "top", **AMOUNTS, "area": 0.1, "area_low": 0.0, "area_high": 1.3}
    measures = json.loads(path.read_text()) | {"distances": [short | {"difference": -0.0001}], "classes": [speck]}
    write_json(path, measures)
    html = Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")
    for cell in ("0.0001", "0.0000 … 0.0012", "0.1", "0.0 … 1.3"):
        assert f"<td>{cell}</td>" in html


def test_what_of_an_area_is_a_guess_has_a_column(project: Path) -> None:
    path = project / "exports/main" / MEASURES
    measures = json.loads(path.read_text())
    assert "of it a guess" not in Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")
    top, bottom = (
        {"name": name, **AMOUNTS, "area_guessed": guess} for name, guess in (("top", 0.1571), ("bottom", 0.0))
    )
    write_json(path, measures | {"classes": [top, bottom]})
    html = Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r'src="data:[^"]*"', "", html)))
    assert "95 % interval of it a guess volume" in text
    assert "1.571 1.500 … 1.640 10.0 % open" in text
    assert "1.571 1.500 … 1.640 0.0 % open" in text


def test_held_out_photos_may_have_dots_in_their_names(project: Path) -> None:
    names = ["IMG.01", "IMG.02", "gone.03"]
    for name in names[:2]:
        Image.new("RGB", (8, 6)).save(project / f"{name}.png")
    scores = [{"name": name, "psnr": 20.0 + n, "ssim": 0.5 + n / 10} for n, name in enumerate(names)]
    test = {"images": 3, "psnr": 21.0, "ssim": 0.6, "miou": None, "per_image": scores}
    pictures = [f"{name}.png" for name in ("IMG.01", "gone.03", "IMG.02")]
    test |= {"pictures": pictures, "per_image": [scores[0], scores[2], scores[1]]}
    write_json(run_folder(project, "main") / METRICS, {"test": test})
    html = Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")
    captions = re.findall(r"<figcaption>(IMG.*?)</figcaption>", html)
    assert captions == ["IMG.01 — 20.00 dB, SSIM 0.500", "IMG.02 — 21.00 dB, SSIM 0.600"]


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (
            {"split": "test"},
            ("Held-out views", "Held-out images 1", "Accuracy on held-out photos", "were not trained on"),
        ),
        (
            {"split": "train"},
            ("Training views", "Training images 1", "Accuracy on training photos", "that were trained on"),
        ),
        (
            {"split": "test", "baked": True},
            (
                "Held-out views, baked field",
                "Held-out images, baked field 1",
                "Accuracy on held-out photos, baked field",
            ),
        ),
    ],
)
def test_a_report_names_the_photos_that_were_evaluated(
    project: Path, tmp_path: Path, given: dict[str, Any], names: tuple[str, ...]
) -> None:
    """Whatever else of the run was evaluated before."""
    Image.new("RGB", (8, 6)).save(project / "a.png")
    scores = [{"name": "a", "psnr": 44.44, "ssim": 0.99}]
    made = {"images": 1, "psnr": 44.44, "ssim": 0.99, "miou": None, "per_image": scores, "pictures": ["a.png"], **given}
    found = results_of(load_project(project), "main") | {"evaluate": made}
    path, pdf = tmp_path / "r.html", tmp_path / "r.pdf"
    titles = write_report(path, project, "main", tmp_path / "none", found, Reporter())
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r'src="data:[^"]*"', "", path.read_text("utf-8"))))
    for words in (*names, "PSNR 44.44 dB", "a 44.44 0.990"):
        assert words in text, words
    assert "31.25" not in text
    if given["split"] == "train":
        assert "eld-out" not in text
    assert write_report(pdf, project, "main", tmp_path / "none", found, Reporter()) == titles


def test_what_is_of_a_mesh_that_lies_elsewhere_is_left_out_with_a_warning(project: Path) -> None:
    with edit_project(project) as edited:
        edited.frame.world_from_sfm = (2 * np.eye(4)).tolist()
    reporter = Reporter()
    html = Path(report(ReportParams(project=project), reporter)["file"]).read_text("utf-8")
    assert not [words for words in ("cells of", "1.571", "door", "data:image/png") if words in html]
    assert "Photos used" in html
    (warning,) = reporter.warnings
    assert "leaves out mesh, measures and drawings" in warning
    assert "aligned anew" in warning
    assert "Run `fieldwork mesh` again." in warning


def test_drawings_of_an_earlier_mesh_are_left_out_with_a_warning(project: Path) -> None:
    drawn = {"files": [str(project / "exports/main/drawings/top.png")]}
    with edit_project(project) as edited:
        edited.record("plan", {"run": "main", "out": None}, drawn)
        edited.record("mesh", {"run": "other"}, {})  # another run's
    assert "<h2>Drawings" in Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")
    with edit_project(project) as edited:
        mesh = next(step for step in edited.provenance if step.verb == "mesh")
        edited.record("mesh", {"run": "main"}, mesh.result)
    reporter = Reporter()
    html = Path(report(ReportParams(project=project), reporter)["file"]).read_text("utf-8")
    assert "<h2>Drawings" not in html
    assert "1.571" in html
    (warning,) = reporter.warnings
    assert "earlier mesh: top.png. Run `fieldwork plan`" in warning
    assert (project / "exports/main/drawings/top.png").is_file()
    with edit_project(project) as edited:
        edited.record("plan", {"run": "main", "out": None}, drawn)
    assert "<h2>Drawings" in Path(report(ReportParams(project=project), Reporter())["file"]).read_text("utf-8")


def test_the_pdf_has_the_same_tables(project: Path, tmp_path: Path) -> None:
    html = report(ReportParams(project=project), Reporter())
    pdf = report(ReportParams(project=project, out=tmp_path / "r.pdf"), Reporter())
    assert pdf["sections"] == html["sections"]
    data = (tmp_path / "r.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b", data)) >= 3


def test_long_tables_go_on_on_the_next_page_and_pictures_keep_their_shape(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((400, 20, 3), np.uint8)).save(tmp_path / "tall.png")
    rows = [[str(n), "$a_b$ " * 60] for n in range(60)]
    write_pdf(
        tmp_path / "r.pdf", "Übersicht", [Section("Many", ["n", "text"], rows)], [("tall", tmp_path / "tall.png")]
    )
    assert len(re.findall(rb"/Type /Page\b", (tmp_path / "r.pdf").read_bytes())) == 4


def test_wide_letters_and_long_titles_stay_in_their_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(report_pdf._Pages, "end", lambda pages: drawn.append(pages.figure))
    title = "survey of the weathered northern parapet " * 4
    write_pdf(tmp_path / "r.pdf", title, [Section("Many", ["name", "area"], [["裂缝" * 12, "1.0"]])], [])
    (figure,) = drawn
    shown = {text.get_text(): text for text in figure.texts}
    assert shown[title].get_window_extent().x1 <= figure.bbox.x1
    # Letters of that script are as wide as high; columns lie two characters apart.
    wide = max(len(text) for text in shown if text.startswith("裂缝")) * report_pdf.SIZE / 72 * 25.4
    assert report_pdf.MARGIN + wide < shown["area"].get_position()[0] * report_pdf.WIDTH


def test_other_endings_are_refused_before_anything_is_done(project: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"\.html or \.pdf"):
        report(ReportParams(project=project, out=tmp_path / "r.doc"), Reporter())
    with pytest.raises(SettingError, match=r"\.html or \.pdf"):
        reconstruct(ReconstructParams(photos=tmp_path, out=tmp_path / "p", report=tmp_path / "r.doc"), Reporter())
    assert not (tmp_path / "p").exists()


def test_runs_that_are_not_there_are_named(project: Path, tmp_path: Path) -> None:
    run_folder(project, "fine").mkdir()
    with pytest.raises(ProjectError, match=r"no run “mian”\. Its runs: fine, main\."):
        report(ReportParams(project=project, run="mian"), Reporter())
    assert not (project / "exports/mian").exists()
    assert "Photographs" in report(ReportParams(project=project, run="fine"), Reporter())["sections"]
    posed = ball_project(tmp_path / "posed", views=9)
    assert "Photographs" in report(ReportParams(project=posed), Reporter())["sections"]


def test_passes_of_a_view_stand_together() -> None:
    names = ["a", "a_2", "a_2_labels", "a_depth", "orbit_0_depth", "orbit_0_normal"]
    found = by_view([Path(f"{name}.png") for name in names])
    views = [[file.stem for file in view] for view in found]
    assert views == [["a", "a_depth"], ["a_2", "a_2_labels"], ["orbit_0_depth", "orbit_0_normal"]]
