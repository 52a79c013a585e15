"""The field in the viewport and rendered, in a real window. The screenshots stay in build/gui/<scenario>/."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from fieldwork.tests.gui import window
from fieldwork.tests.nerfcore.support.ball import pattern
from fieldwork.tests.nerfcore.support.halves import write_halves
from fieldwork.tests.nerfcore.support.live import live_ball
from PIL import Image

HERE = Path(__file__).parent


REASON = window.missing()
pytestmark = [
    pytest.mark.gui,
    pytest.mark.slow,
    pytest.mark.timeout(1200 * window.PATIENCE),
    pytest.mark.skipif(REASON is not None, reason=str(REASON)),
]


@pytest.fixture(scope="module")
def project() -> Path:
    folder = window.BUILD / "ball"
    if not (folder / "runs/main/voxels/meta.json").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        live_ball(folder)
    return folder


@pytest.fixture(scope="module")
def things(project: Path) -> Path:
    """The ball with a mesh whose upper class is two things."""
    folder = window.BUILD / "ball-things"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(project, folder)
    write_halves(folder)
    return folder


def played(
    project: Path, scenario: str, suite: str = "sid", timeout: float = 500, size: tuple[int, int] = (1920, 1080)
) -> tuple[dict, Path]:
    """`suite`: of Debian, which says which Blender; "sid-vulkan" draws by Vulkan instead of OpenGL."""
    root = window.OLDER_ROOT if suite == "trixie" else window.BLENDER_ROOT
    vulkan = suite == "sid-vulkan"
    reason = window.missing(root, suite) or (window.missing_vulkan(root) if vulkan else None)
    if reason:
        pytest.skip(reason)
    session = window.Window(f"{scenario}-{suite}", root)
    session.environment["FIELDWORK_BALL"] = str(project)
    if vulkan:
        session.environment["VK_DRIVER_FILES"] = f"/{window.SOFTWARE_VULKAN}"
    facts = session.play(scenario, timeout=timeout, size=size, backend="vulkan" if vulkan else "opengl")
    return facts, session.folder


def around(folder: Path, shot: str, place: list[int]) -> np.ndarray:
    """Colours (25, 3) in [0, 1] of the pixels around a place in a screenshot."""
    pixels = np.asarray(Image.open(folder / f"{shot}.png").convert("RGB"), np.float64) / 255
    x, y = place
    return pixels[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3)


def colour(folder: Path, shot: str, place: list[int]) -> np.ndarray:
    """Their mean colour (3,)."""
    return around(folder, shot, place).mean(0)


def nearest(folder: Path, shot: str, place: list[int], wanted: list[float]) -> np.ndarray:
    """Their colour (3,) that is nearest to the one wanted."""
    pixels = around(folder, shot, place)
    return pixels[np.abs(pixels - wanted).max(1).argmin()]


@pytest.mark.parametrize("suite", ["sid", "sid-vulkan", "trixie"])
def test_the_field_is_among_objects_in_every_shading_mode(project, suite):
    facts, folder = played(project, "viewport", suite, 700)
    places, points = facts["places"], facts["points"]
    truth = {name: pattern(np.array(points[name]) / np.linalg.norm(points[name]) * 0.5) for name in ("field", "low")}
    grey = colour(folder, "solid", places["front"])
    assert np.ptp(grey) < 0.05, "the cube in front hides the field"
    modes = ("solid", "material", "eevee", "cycles")
    for shot in (*modes, *(f"{mode}-no-overlays" for mode in modes)):
        for name in ("field", "low"):
            found = colour(folder, shot, places[name])
            assert found == pytest.approx(truth[name], abs=0.15), f"{shot}: {name} is not as photographed"
        assert np.ptp(colour(folder, shot, places["front"])) < 0.06, f"{shot}: the field shows through the cube"
        assert np.ptp(colour(folder, shot, places["back"])) < 0.06, f"{shot}: what is behind is not beside the field"
    for shot in ("object-away", "vertices-away"):
        assert np.ptp(colour(folder, shot, places["front"])) > 0.2, f"{shot}: hidden by what is no longer there"
    assert colour(folder, "fieldwork", places["field"]) == pytest.approx(truth["field"], abs=0.15)
    back = colour(folder, "solid", places["back"])
    # A class that is hidden, in the next redraw; what is behind it shows.
    assert np.abs(colour(folder, "hidden", places["low"]) - truth["low"]).max() < 0.15
    assert np.ptp(colour(folder, "hidden", place_above(places))) < 0.06
    assert colour(folder, "hidden", place_above(places)) == pytest.approx(back, abs=0.1)
    assert colour(folder, "labels", places["top"]) == pytest.approx([0.8, 0.2, 0.2], abs=0.06)
    assert colour(folder, "labels", places["low"]) == pytest.approx([0.2, 0.3, 0.8], abs=0.06)
    assert np.ptp(colour(folder, "confidence", places["top"])) < 0.05
    assert colour(folder, "confidence", places["top"])[0] > 0.8
    assert colour(folder, "tinted", places["low"]) == pytest.approx([0, 1, 0], abs=0.1)
    assert colour(folder, "tinted", places["top"])[1] < 0.9
    assert colour(folder, "cropped", places["low"]) == pytest.approx(truth["low"], abs=0.15)
    assert np.ptp(colour(folder, "cropped", place_above(places))) < 0.06
    assert colour(folder, "turned", places["top"]) == pytest.approx([0, 1, 0], abs=0.06), (
        "the lower class, green by now"
    )
    assert colour(folder, "undone", places["field"]) == pytest.approx(truth["field"], abs=0.15)
    assert facts["assets"] == 1, "two objects of one field share its textures"
    assert facts["python"] < 0.002, "seconds of Python in a redraw"
    assert facts["viewport error"] == ""
    assert facts["kept"][1] == 1
    print(suite, {name: facts[name] for name in ("moving", "python", "refined after", "size")})


@pytest.mark.parametrize("suite", ["sid", "sid-vulkan", "trixie"])
def test_single_things_are_edited_in_the_viewport(things, suite):
    facts, folder = played(things, "things", suite)
    places, points = facts["places"], facts["points"]

    def seen(shot: str, name: str) -> np.ndarray:
        return colour(folder, shot, places[name])

    def photographed(x: float, y: float, z: float) -> np.ndarray:
        return pattern(np.array([x, y, z]) / np.linalg.norm([x, y, z]) * 0.5)

    truth = {name: photographed(*points[name]) for name in ("left", "right", "low")}
    for name, color in truth.items():
        assert seen("plain", name) == pytest.approx(color, abs=0.15)
    empty = {name: seen("plain", name) for name in ("moved", "copied")}
    assert np.abs(seen("hidden", "left") - truth["left"]).max() > 0.15
    assert seen("hidden", "right") == pytest.approx(truth["right"], abs=0.15), "the other thing of the class stays"
    assert seen("hidden", "low") == pytest.approx(truth["low"], abs=0.15)
    assert seen("tinted", "right") == pytest.approx([0, 1, 0], abs=0.1)
    assert seen("tinted", "left") == pytest.approx(truth["left"], abs=0.15)
    for name in ("left", "right"):
        assert seen("labels", name) == pytest.approx([0.8, 0.2, 0.2], abs=0.06), "labels have the color of the class"
    assert seen("dimmed", "right")[1] < 0.8
    assert seen("dimmed", "left") == pytest.approx(truth["left"], abs=0.15)
    # “left” was carried 0.9 to the right, of “right” there is a copy above.
    for shot in ("elsewhere at once", "elsewhere"):
        assert seen(shot, "moved") == pytest.approx(truth["left"], abs=0.15), shot
        assert seen(shot, "copied") == pytest.approx([0, 1, 0], abs=0.12), shot
        assert np.abs(seen(shot, "left") - truth["left"]).max() > 0.15, shot
        assert seen(shot, "right") == pytest.approx([0, 1, 0], abs=0.1), shot
        assert seen(shot, "low") == pytest.approx(truth["low"], abs=0.15), shot
    assert seen("hidden copy", "copied") == pytest.approx(empty["copied"], abs=0.05)
    assert seen("hidden copy", "moved") == pytest.approx(truth["left"], abs=0.15)
    assert facts["python"] < 0.002, "seconds of Python in a redraw"
    assert facts["viewport error"] == ""
    print(suite, {name: facts[name] for name in ("told after", "moving", "python")})


def place_above(places: dict) -> list[int]:
    """Where the upper half of the ball is, but not the cube in front, nor the inside of the ball's lower half."""
    x, y = places["top"]
    return [x + 10, y - 30]


@pytest.mark.parametrize("suite", ["sid", "sid-vulkan", "trixie"])
def test_frames_of_each_size_show_the_same(project, suite):
    """How many of them a second is printed: it is software that draws here."""
    facts, _ = played(project, "speed", suite)
    rates, covered = ({name: values[k] for name, values in facts["frames"].items()} for k in (0, 1))
    print(suite, "frames a second of the viewport's march", {name: round(rate, 1) for name, rate in rates.items()})
    assert facts["viewport error"] == ""
    assert covered["400"] > 0.02
    # The view is as wide as before, whatever the picture's form: it is stretched.
    for name in ("800", "1080"):
        assert covered[name] == pytest.approx(covered["400"], rel=0.03)
    assert rates["400"] > rates["800"] > rates["1080"]


def test_the_panel_and_the_properties_show_the_field(project):
    _, folder = played(project, "live_panel")
    assert {"panel", "engine", "passes"} <= {path.stem for path in folder.glob("*.png")}


@pytest.mark.parametrize("suite", ["sid", "trixie"])
def test_f12_in_the_window_cancel_death_and_animation(project, suite):
    facts, folder = played(project, "rendering", suite)
    picture = np.asarray(Image.open(folder / "picture.png").convert("RGB"), np.float64) / 255
    height, width = picture.shape[:2]
    scale = 50 / 36 * width
    for point in ((0.2, -0.45, 0.1), (0.1, -0.46, -0.2)):
        x = width / 2 + scale * point[0] / (point[1] + 2)
        y = height / 2 - scale * point[2] / (point[1] + 2)
        truth = pattern(np.array(point) / np.linalg.norm(point) * 0.5)
        assert picture[int(y), int(x)] == pytest.approx(truth, abs=0.15)
    assert np.ptp(picture[3, 3]) < 0.02, "the world is grey"
    assert facts["cancel"] < 2
    assert facts["death"] < 2
    assert facts["frames"] == 5


def layers(path: Path) -> dict[str, np.ndarray]:
    """Channels of a file by their names, without that of the view layer."""
    import OpenImageIO as oiio

    source, found, number = oiio.ImageInput.open(str(path)), {}, 0
    while source.seek_subimage(number, 0):
        spec = source.spec()
        pixels = np.asarray(source.read_image(number, 0, 0, spec.nchannels, "float"))
        for place, name in enumerate(spec.channelnames):
            found[name.removeprefix("ViewLayer.")] = pixels[..., place]
        number += 1
    return found


@pytest.mark.parametrize("suite", ["sid", "trixie"])
def test_f12_without_a_window(project, suite):
    """All passes in a multilayer file, and the compositor, by `blender -b` itself."""
    root = window.BLENDER_ROOT if suite == "sid" else window.OLDER_ROOT
    reason = window.missing(root, suite)
    if reason:
        pytest.skip(reason)
    session = window.Window(f"background-{suite}", root)
    command = ["blender", "-b", "--factory-startup", "--python-exit-code", "1", "--python", str(HERE / "background.py")]
    done = window.enter(
        [*command, "--", str(project), str(session.folder)], session.environment, 300 * window.PATIENCE, root
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    found = layers(session.folder / "passes.exr")
    assert found["Depth.Z"][40, 60] == pytest.approx(1.5, abs=0.08)
    assert found["Depth.Z"][0, 0] == pytest.approx(1e10)
    assert found["Position.Y"][40, 60] == pytest.approx(-0.5, abs=0.08)
    assert found["Normal.Y"][35:45, 55:65].mean() < -0.6
    assert [found["Class Index.X"][y, x] for y, x in ((28, 60), (52, 60), (0, 0))] == [1, 2, 0]
    assert found["Confidence.X"][28, 60] > 0.8
    from fieldwork.nerfcore.film.cryptomatte import id_of

    assert found["CryptoMaterial00.R" if "CryptoMaterial00.R" in found else "CryptoMaterial00.r"][28, 60] == np.float32(
        id_of("top")
    )
    mixed = layers(session.folder / "composite.exr")
    red, green, blue, alpha = (mixed[name] for name in "RGBA")
    # The grey cube in the middle, the field around it.
    assert np.ptp([red[40, 60], green[40, 60], blue[40, 60]]) < 0.03
    truth = pattern(np.array([0.2, -0.45, 0.1]) / np.linalg.norm([0.2, -0.45, 0.1]) * 0.5)
    scale = 50 / 36 * 120
    x, y = 60 + scale * 0.2 / 1.55, 40 - scale * 0.1 / 1.55
    light = np.where(truth > 0.04045, ((truth + 0.055) / 1.055) ** 2.4, truth / 12.92)
    assert [c[int(y), int(x)] for c in (red, green, blue)] == pytest.approx(light, abs=0.15)
    assert alpha[40, 60] == pytest.approx(1, abs=1e-3)
    assert alpha[1, 1] < 0.05
