"""The extension in a real window, driven by simulated events. The screenshots stay in build/gui/<scenario>/."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from fieldwork.tests.gui import window

HERE = Path(__file__).parent


REASON = window.missing()
pytestmark = [
    pytest.mark.gui,
    pytest.mark.slow,
    pytest.mark.timeout(1200 * window.PATIENCE),
    pytest.mark.skipif(REASON is not None, reason=str(REASON)),
]
WINDOW = window.Window


@pytest.fixture(scope="module")
def captured():
    """The capture that all scenarios go on with: photos dropped, read and placed by the mouse."""
    return WINDOW("capture").play("capture", timeout=900)


def assert_never_held_up(facts: dict) -> None:
    """Nothing of Fieldwork held the window up for longer than 100 ms.

    Where other programs want more processors than there are, waiting for one is not Fieldwork's doing.
    """
    assert facts["slowest_cpu"] < 0.1, facts["slowest_step"]
    if os.getloadavg()[0] <= (os.cpu_count() or 1):
        assert facts["slowest_tick"] < 0.1, facts["slowest_step"]


def shots(name: str) -> set[str]:
    return {path.stem for path in (window.BUILD / name).glob("*.png")}


def test_photos_are_dropped_read_placed_and_shown(captured):
    photos, project = captured["dropped"]
    assert photos.endswith("banana/images")
    assert project.endswith("/banana_fieldwork")
    placed, total = captured["placed"]
    assert placed >= total - 1
    # One camera for each photo, the animated one, and the one of the default scene.
    assert captured["cameras"] == placed + 2
    assert captured["cameras again"] == captured["cameras"], "importing again piles up cameras"
    assert_never_held_up(captured)
    assert {"empty", "dropped", "reading", "posing", "scene", "posed-capture", "posed-poses"} <= shots("capture")


def test_panels_say_where_things_stand_and_lead_to_results():
    window.simulate()
    session = WINDOW("panels")
    facts = session.play("panels", timeout=1100)
    photos, empties = facts["without tab"]
    assert photos == "", "a picture dropped where Fieldwork is not open is Blender's"
    assert empties == 1
    assert facts["verbs"][-2:] == ["reconstruct", "package"]
    assert facts["meshes"] == 1, "what was reconstructed comes into the scene"
    assert_never_held_up(facts)
    facts = session.play("documents", timeout=900)
    camera, row, perspective = facts["looked through"]
    assert camera == row
    assert perspective == "CAMERA"
    assert facts["editors before"] == 0
    assert facts["rendered"], "a render opens in an image editor"
    assert any("top" in name or "plan" in name for name in facts["drawn"]), facts["drawn"]
    assert facts["recent"].endswith("museum_fieldwork")
    assert_never_held_up(facts)
    assert {"one-button", "locked", "measured-line", "rendered", "recent", "all-measure"} <= shots("panels")


def test_a_first_look_at_the_mesh_comes_soon_and_gives_way_to_it():
    window.simulate()
    project = window.BUILD / "trained"
    shutil.rmtree(project, ignore_errors=True)
    for arguments in (
        ["import", window.MUSEUM / "ground_truth", project],
        ["train", project, "--preset", "draft", "--steps", "300"],
    ):
        window.subprocess.run([sys.executable, "-m", "fieldwork.nerfcore", *arguments], check=True)
    session = WINDOW("preview")
    session.environment["FIELDWORK_TRAINED"] = str(project)
    facts = session.play("preview", timeout=700)
    assert facts["preview faces"] > 1000
    assert facts["roles"] == ["mesh"]
    if os.getloadavg()[0] <= (os.cpu_count() or 1):
        assert facts["seconds"] < 20
    assert_never_held_up(facts)


def test_training_shows_its_curve_and_ends_as_a_mesh_in_the_scene(captured):
    facts = WINDOW("train").play("train", timeout=900)
    assert facts["curve"] > 10
    assert facts["preview"]
    assert len(facts["faces"]) == 1
    assert facts["faces"][0] > 100
    assert {"training", "trained", "scene", "trained-train", "trained-mesh"} <= shots("train")


def test_cancel_death_undo_and_another_file_in_the_middle(captured):
    facts = WINDOW("interruptions").play("interruptions", timeout=900)
    assert facts["cancel"] < 2.0
    assert facts["resumed at"] > 1, "the training began anew"
    assert "signal 9" in facts["death"]
    assert "signal 9" in facts["report"]
    assert "log of the engine" in facts["report"]
    assert facts["cancel detached"] < 3.0
    assert_never_held_up(facts)


def test_classes_renders_presets_and_themes_of_a_labelled_capture():
    window.simulate()
    facts = WINDOW("labelled").play("labelled", timeout=1100)
    assert len(facts["classes"]) >= 5
    assert sum(area > 0 for _, area in facts["classes"]) >= 2
    name, whole, left = facts["hidden"]
    assert 0 < left < whole, name
    assert any(image.endswith(".png") for image in facts["background"])
    assert facts["preset"] == ["Quick_Look.py", 77.0, 5]
    assert facts["exported"] == ["glTF"]
    assert_never_held_up(facts)
    assert {"classes", "hidden", "light", "large", "labelled-train", "labelled-classes"} <= shots("labelled")


@pytest.mark.parametrize("suite", ["sid", "trixie"])
def test_install_capture_to_mesh_disable_and_uninstall(suite):
    """The life of the extension in the newest Blender and in an older one, in one session of each."""
    root = window.BLENDER_ROOT if suite == "sid" else window.OLDER_ROOT
    reason = window.missing(root, suite)
    if reason:
        pytest.skip(reason)
    window.simulate()
    facts = WINDOW(f"life-{suite}", root, install=False).play("life", timeout=600)
    assert facts["blender"].startswith("4.3" if suite == "trixie" else "5.")
    assert facts["photos"] == 24
    assert facts["faces"] > 100
    assert facts["registered"]
    assert facts["left"] == {}
    assert facts["files"] is False
    assert_never_held_up(facts)
    assert {"installed", "trained", "scene", "uninstalled"} <= shots(f"life-{suite}")


def test_a_job_goes_on_without_blender_and_is_found_again(captured):
    facts = WINDOW("reattach").play("leave", "back", timeout=600)
    assert facts["followed"] == "train"
    assert facts["points"] > 3, "the curve of the time without Blender"
    assert facts["state"] == "done"
    assert facts["runs"] == ["second"]
    assert facts["used"] == "second"
    assert {"left", "reattached", "runs"} <= shots("reattach")


def test_keyboard_search_picked_points_region_and_data_set_of_the_scene(captured):
    facts = WINDOW("tools").play("tools", timeout=600)
    assert facts["searched"] == "doctor", "F3 finds the operators"
    assert facts["menu"] == "poses", "the menu is walked with the arrow keys"
    assert facts["picked"] < 1e-4, "the point that was clicked is the sparse point"
    assert facts["kept turning"], "the view turns while a point is picked"
    assert facts["cancelled"], "escape leaves the point as it was"
    assert facts["region"] == [[-1, -2, 0], [3, 2, 2]]
    assert facts["photographed"] == 3
    assert facts["project images"] == 3
    assert facts["classes"]
    assert facts["translated"] in (["Posen schätzen", "3 von 4 Fotos verortet"], "no languages here")
    assert_never_held_up(facts)
    assert {"search", "picking", "align", "region", "dataset", "photographed"} <= shots("tools")


def test_edits_wait_for_the_engine_and_a_moved_project_is_found():
    facts = WINDOW("edits").play("edits", timeout=300)
    assert facts["undone"] == 1.0
    reason, name = facts["unsaved"]
    assert "no engine" in reason
    assert name == "stone", "nothing but the engine writes the project"
    assert "gold" in facts["refused"]
    project, name = facts["found"]
    assert project.endswith("/elsewhere")
    assert name == "marble"
    assert_never_held_up(facts)
    assert {"unsaved", "gone", "found"} <= shots("edits")


def unlabelled(folder: Path) -> Path:
    """The simulated capture, its photos without labels, trained and prepared."""
    from fieldwork.nerfcore.project.store import load_project, save_project

    if not (folder / "runs/main/surfels/prepared.json").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        run = lambda *words: window.subprocess.run([sys.executable, "-m", "fieldwork.nerfcore", *words], check=True)  # noqa: E731
        run("import", window.MUSEUM / "ground_truth", folder)
        project = load_project(folder)
        project.classes = []  # as if there never were any: an edit would note their ids, which no new class gets
        for image in project.images:
            image.label = None
        save_project(folder, project)
        run("train", folder, "--preset", "draft", "--steps", "600")
        run("label", "prepare", folder)
    return folder


def strokes_for(names: list[str], photos: list[str], seed: int) -> list[dict]:
    """Strokes as a simulated annotator draws them on photos of the simulated capture."""
    from fieldwork.nerfcore.bench.annotator import first_strokes
    from fieldwork.nerfcore.images.working import read_label
    from scipy.ndimage import uniform_filter1d

    found = []
    for photo in photos:
        truth = read_label(window.MUSEUM / "labels" / f"{photo}.png")
        for stroke in first_strokes(photo, truth, list(range(1, len(names) + 1)), seed):
            points = uniform_filter1d(stroke.points, 5, axis=0, mode="nearest")  # a hand that is calm
            points = np.clip(points, 4, np.array(truth.shape[::-1]) - 4)
            found.append({"photo": photo, "class": stroke.class_id, "points": points.tolist()})
    return found


def share_that_is_right(project: Path, revision: int) -> float:
    """Share of the pixels of all photos with a true class that have the true one at a revision."""
    from fieldwork.nerfcore.images.working import nearest, read_label
    from fieldwork.nerfcore.labels.overlay import photo_labels
    from fieldwork.nerfcore.labels.revisions import computed

    ready, labelling = computed(project, "main", revision)
    right = total = 0
    for photo in ready.photos:
        truth = nearest(read_label(window.MUSEUM / "labels" / f"{photo.name}.png"), photo.width, photo.height)
        found, _ = photo_labels(ready, labelling, photo.name, 0)
        right, total = right + ((found == truth) & (truth > 0)).sum(), total + (truth > 0).sum()
    return float(right / total)


def share_of_the_part(project: Path, mark: dict, revision: int) -> float:
    """Share of the part under a click that has the class of the mark at a revision."""
    from fieldwork.nerfcore.labels.revisions import computed

    ready, labelling = computed(project, "main", revision)
    surfels, _ = ready.map_of(mark["photo"])
    image = next(i for i in json.loads((project / "project.json").read_text())["images"] if i["name"] == mark["photo"])
    (x, y), (rows, columns) = mark["points"][0], surfels.shape
    parts = np.asarray(ready.parts[:, 1])
    clicked = surfels[int(y * rows / image["height"]), int(x * columns / image["width"])]
    assert clicked >= 0, "the click met the surface"
    return float((labelling.label(0)[parts == parts[clicked]] == mark["class_id"]).mean())


def overlay_that_is_seen(shot: Path, opaque: dict, project: Path, revision: int) -> tuple[float, int]:
    """Of the middles of places with one class, the share that have its colour on the screen, and how many were compared."""
    from fieldwork.nerfcore.labels.overlay import photo_labels
    from fieldwork.nerfcore.labels.revisions import computed
    from PIL import Image

    ready, labelling = computed(project, "main", revision)
    ids, _ = photo_labels(ready, labelling, opaque["photo"], 0)
    screen = np.asarray(Image.open(shot).convert("RGB"), np.float64) / 255
    (left, top), (right, bottom) = opaque["corners"]
    seen, height, width = [], *ids.shape
    for y in range(4, height - 4, 7):
        for x in range(4, width - 4, 7):
            if ids[y, x] and (ids[y - 3 : y + 4, x - 3 : x + 4] == ids[y, x]).all():
                column, row = left + (x + 0.5) / width * (right - left), top + (y + 0.5) / height * (bottom - top)
                difference = screen[int(row), int(column)] - opaque["colors"][str(ids[y, x])]
                seen.append(np.abs(difference).max() < 0.02)
    return float(np.mean(seen)), len(seen)


@pytest.mark.parametrize("suite", ["sid", "trixie"])
def test_labels_from_strokes_on_photos(suite):
    """Scribbles, undo, a click, the next photo, an engine that is killed, accepting, the file loaded again."""
    from fieldwork.tests.nerfcore.support import onnx_models as tiny_models

    root = window.BLENDER_ROOT if suite == "sid" else window.OLDER_ROOT
    reason = window.missing(root, suite)
    if reason:
        pytest.skip(reason)
    window.simulate()
    session = WINDOW(f"labels-{suite}", root)
    project = Path(shutil.copytree(unlabelled(window.BUILD / "unlabelled"), session.folder / "project"))
    names = ["stone", "gilding", "wood", "textile", "ceramic", "floor", "wall"]
    strokes = strokes_for(names, ["IMG_0001", "IMG_0013"], 0)
    plan = session.folder / "plan.json"
    models = {"encoder": tiny_models.encoder, "decoder": tiny_models.sam_decoder}
    files = {name: str(make(session.folder / f"{name}.onnx")) for name, make in models.items()}
    plan.write_text(json.dumps({"project": str(project), "classes": names, "strokes": strokes, **files}))
    session.environment["FIELDWORK_LABELLING"] = str(plan)
    facts = session.play("labels", timeout=900)
    assert facts["classes"] == names
    count = len(strokes)
    assert facts["revisions"] == list(range(1, count + 1)), "each stroke is one mark"
    marks = [json.loads(line) for line in (project / "marks/journal.jsonl").read_text().splitlines()]
    for mark, stroke in zip(marks, strokes):
        assert (mark["photo"], mark["class_id"]) == (stroke["photo"], stroke["class"])
        for end in (0, -1):
            assert mark["points"][end] == pytest.approx(stroke["points"][end], abs=1.0), "marked where the mouse was"
    assert share_that_is_right(project, count) > 0.6
    share, compared = overlay_that_is_seen(session.folder / "opaque.png", facts["opaque"], project, count)
    assert compared > 100
    assert share > 0.97, "the classes have their colours on the photo"
    newest, seen, stored = facts["undo"]
    assert seen == [newest - 1, newest - 2, newest - 1, newest]
    assert stored == newest
    assert facts["undo at once"] == [1, newest + 1, newest], "Ctrl-Z takes back the mark, not what was before it"
    click, erased, void = facts["tools"]
    assert (click["shape"], erased["erase"], void["class_id"], void["erase"]) == ("part", True, None, False)
    mark, revision = facts["part"]["mark"], facts["part"]["revision"]
    assert (mark["shape"], mark["level"], mark["class_id"]) == ("part", "coarse", strokes[-1]["class"])
    assert share_of_the_part(project, mark, revision) > 0.95, "the whole part that was clicked has the class"
    before, after = facts["encoded"]
    assert len(before) == 4, "the photo that is shown and the next three"
    assert after == before, "what was encoded ahead is not encoded again"
    for cut, (x, y) in zip(facts["cut out"], facts["cut out at"]):
        assert cut["shape"] == "outline"
        middle = (np.min(cut["points"], axis=0) + np.max(cut["points"], axis=0)) / 2
        assert middle == pytest.approx([x, y], abs=1.5), "what the model cuts out is where the mouse was"
    assert facts["next"][0] != facts["next"][1]
    assert "signal 9" in facts["death"]
    before, after = facts["after death"]
    assert after > before, "the stroke was in the journal when the engine died"
    assert facts["kept"] == 1
    assert "signal 9" in facts["told"]
    before, after, shown = facts["not lost"]
    assert (after, shown) == (before + 1, before + 1), "the stroke is neither lost nor there twice"
    accepted, shown, agreement = facts["accepted"]
    assert accepted == shown
    assert agreement > 0.8
    before, after, remembered, photo = facts["loaded"]
    assert before == after == remembered
    assert photo is not None
    assert facts["undone after loading"] == before
    assert_never_held_up(facts)


def test_engine_is_installed_from_the_preferences():
    """Without network, from a folder that lacks the packages: it must fail with advice, and nothing must hang."""
    facts = WINDOW("preferences").play("preferences", timeout=300)
    assert "Press Install again" in facts["failure"]
    assert {"no-engine", "preferences", "installing", "failed"} <= shots("preferences")


def test_closing_blender_leaves_no_engine_and_no_half_project(captured):
    """After the scenarios the project is whole: the command line can read it."""
    project = window.BUILD / "capture" / "project"
    assert (project / "project.json").is_file()
    assert not list(project.rglob(".*.tmp"))
    copy = window.BUILD / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(project, copy)
    code = f"from fieldwork.nerfcore.data.load import load_scene; print(len(load_scene({str(copy)!r}).views))"
    done = window.subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=dict(os.environ)
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == captured["placed"][0]
