"""Pictures through files in memory, by a process that writes without pause and one that reads: none is torn."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fieldwork.addon.errors import EngineError
from fieldwork.addon.live import frames
from fieldwork.addon.live.frames import Sizes, _SharedPixels
from fieldwork.nerfcore.film.shared_file import SharedFile

FRAMES = 10_000
SIZE = 160, 100  # large enough that a reader often meets a picture in the making

# Every value of a picture is its number: one that is torn holds two. Ends with its standard input.
WRITER = """
import sys, threading
from pathlib import Path
import numpy as np
from fieldwork.nerfcore.film.shared_file import PictureFile, SharedFile
kind, path, width, height = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
over = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
file = PictureFile(path) if kind == "picture" else SharedFile(path, {"Combined": (height, width, 4)})
number = 0
while not over.is_set():
    number += 1
    color = np.full((height, width, 4), number % 1_000_000, np.float32)
    if kind == "picture":
        file.write(number, color, color[..., 0])
    else:
        file.write({"Combined": color})
print(number)
"""


def start(kind: str, path: Path) -> subprocess.Popen:
    command = [sys.executable, "-c", WRITER, kind, str(path), *map(str, SIZE)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def torn(pixels: np.ndarray) -> bool:
    return bool(pixels.min() != pixels.max())


@pytest.mark.slow
def test_ten_thousand_colours_of_renders_are_whole(tmp_path: Path) -> None:
    seen, busy, wrong, careless = 0, 0, 0, 0
    with _SharedPixels(tmp_path / "frame", Sizes(*SIZE, {"Combined": 4})) as pixels:
        writer = start("frame", pixels.path)
        try:
            while seen < FRAMES or careless == 0:
                assert writer.poll() is None, "the writer died"
                found = pixels.whole("Combined")
                if found is None:
                    busy += 1
                elif pixels._counter():
                    seen += 1
                    wrong += torn(found)
                careless += torn(pixels.copy("Combined"))  # without a look at the counter
        finally:
            written = int(writer.communicate()[0])
    print(f"{written} written, {seen} read, {busy} times in the making, {careless} torn without the counter")
    assert wrong == 0
    assert busy > 0


@pytest.mark.slow
def test_ten_thousand_pictures_for_viewports_are_whole(bpy_script, tmp_path: Path) -> None:
    """As the viewport reads them, with their numbers, sizes and depths."""
    facts = bpy_script(
        """
import subprocess
import numpy as np
import fieldwork
from fieldwork.addon.live.training import PixelFile
file = PixelFile(Path(path), size[0] * size[1])
command = [engine, "-c", writer, "picture", path, *map(str, size)]
process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
seen = busy = wrong = last = 0
try:
    while seen < frames or busy == 0:
        assert process.poll() is None, "the writer died"
        found = file.read()
        if found is None:
            busy += file._counter() != 0
            continue
        seen += 1
        value = found.number % 1_000_000
        same = all(bool((part == value).all()) for part in (found.color, found.depth))
        wrong += not same or (found.width, found.height) != tuple(size) or found.number < last
        last = found.number
finally:
    written = int(process.communicate()[0])
answer({"seen": seen, "busy": busy, "wrong": wrong, "written": written, "last": last})
""",
        path=tmp_path / "view.pixels",
        size=SIZE,
        frames=FRAMES,
        writer=WRITER,
        engine=sys.executable,
    )
    assert facts["wrong"] == 0
    assert facts["seen"] >= FRAMES
    assert 0 < facts["last"] <= facts["written"]


def test_what_is_being_written_is_not_shown(tmp_path: Path) -> None:
    with _SharedPixels(tmp_path / "frame", Sizes(4, 2, {"Depth": 1, "Combined": 4})) as pixels:
        file = SharedFile(pixels.path, {"Depth": (2, 4, 1), "Combined": (2, 4, 4)})
        file.write({"Combined": np.ones((2, 4, 4), np.float32)})
        found = pixels.whole("Combined")
        assert found is not None
        assert found.min() == 1
        file._counter[0] += 1
        assert pixels.whole("Combined") is None
        assert pixels.whole("Normal") is None, "a pass that was not asked for"


def test_folders_of_processes_that_are_gone_are_removed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Windows:
        """`os` there, as far as it matters."""

        name = "nt"

        def __getattr__(self, name: str) -> object:
            return getattr(os, name)

    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    monkeypatch.setattr(frames, "IN_MEMORY", str(tmp_path / "none"))
    monkeypatch.setattr(frames.tempfile, "gettempdir", lambda: str(tmp_path))
    for system in (os, Windows()):
        monkeypatch.setattr(frames, "os", system)
        left, own = (tmp_path / f"{frames.PREFIX}{number}-x" for number in (ended.pid, os.getpid()))
        left.mkdir()
        own.mkdir(exist_ok=True)
        made = frames.folder_for_frames()
        assert made.is_dir()
        assert own.is_dir()
        assert not left.exists(), system


@pytest.mark.skipif(
    not hasattr(os, "posix_fallocate"), reason="the system has no holes in files, or no way to fill them"
)
def test_files_have_room_for_what_others_write(bpy_script, tmp_path: Path) -> None:
    size = 4 * 4 * 300 * 200
    with _SharedPixels(tmp_path / "frame", Sizes(300, 200, {"Combined": 4})) as pixels:
        assert 512 * pixels.path.stat().st_blocks >= size
    facts = bpy_script(
        "from fieldwork.addon.live.training import PixelFile\n"
        "PixelFile(Path(folder, 'view'), 300 * 200)\nanswer(Path(folder, 'view').stat().st_blocks)",
        folder=tmp_path,
    )
    assert 512 * facts >= size


@pytest.mark.parametrize(("number", "refused"), [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.EOPNOTSUPP, False)])
def test_no_room_is_told_and_a_file_system_that_cannot_tell_is_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, number: int, refused: bool
) -> None:
    def fallocate(*_: int) -> None:
        raise OSError(number, "No")

    monkeypatch.setattr(frames.os, "posix_fallocate", fallocate, raising=False)
    pixels = _SharedPixels(tmp_path / "frame", Sizes(3, 2, {"Combined": 4}))
    if refused:
        with pytest.raises(EngineError, match="no room for a frame"):
            pixels.__enter__()
        assert list(tmp_path.iterdir()) == []
    else:
        with pixels:
            assert pixels.copy("Combined").shape == (2, 3, 4)


def test_frames_are_on_the_disk_where_memory_has_no_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    memory, disk = tmp_path / "memory", tmp_path / "disk"
    memory.mkdir()
    disk.mkdir()
    monkeypatch.setattr(frames, "IN_MEMORY", str(memory))
    monkeypatch.setattr(frames.tempfile, "gettempdir", lambda: str(disk))
    free = {str(memory): 64 << 20}
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=free[str(path)]))
    assert frames.folder_for_frames().parent == disk
    free[str(memory)] = 8 << 30
    assert frames.folder_for_frames().parent == memory


def test_new_trainings_are_looked_at_soon_again(bpy_script, tmp_path: Path) -> None:
    """Views begin to watch a training while they are drawn: had the timer a long pause then, the first picture waited for it."""
    facts = bpy_script(
        """
from fieldwork.addon.live import training
from fieldwork.nerfcore.project import live
own = training.trainings
facts = {"before": [own.run_of(Path(project)), training.tick()]}
live.write(live.training_file(Path(project)), {"run": "main", "pid": 1})
own._runs[Path(project)] = (own._runs[Path(project)][0] - training.IDLE, None)  # as if it was asked a while ago
facts["begun"] = training.tick()
facts["quiet"] = training.tick()
facts["pauses"] = [training.IDLE, training.WATCHING]
answer(facts)
""",
        project=tmp_path,
    )
    idle, watching = facts["pauses"]
    assert facts["before"] == [None, idle]
    assert facts["begun"] == watching < idle
    assert facts["quiet"] == idle


def test_views_of_a_training_go_on_when_the_engine_of_frames_rests(bpy_script, tmp_path: Path) -> None:
    facts = bpy_script(
        """
import time
from types import SimpleNamespace
import fieldwork
fieldwork.register()
from fieldwork.addon.live import engine
from fieldwork.addon.live.training import trainings
watch = trainings._new(Path(project), (8, 4))
ended = []
long_ago = time.monotonic() - 1e6
engine.frames()._link = SimpleNamespace(last_used=long_ago, process=None, close=lambda timeout: ended.append(timeout))
engine._end_when_idle()
facts = {"ended": len(ended), "there": watch.file.path.exists(), "process": engine.frames().process}
fieldwork.unregister()
answer({**facts, "left": watch.file.path.parent.exists()})
""",
        project=tmp_path,
    )
    assert facts == {"ended": 1, "there": True, "process": None, "left": False}


def test_the_engine_of_frames_ends_with_the_other_and_none_starts_while_it_is_replaced(
    bpy_script, tmp_path: Path
) -> None:
    facts = bpy_script(
        """
from types import SimpleNamespace
import fieldwork
fieldwork.register()
from fieldwork.addon import machine
from fieldwork.addon.errors import EngineError
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.live import engine
from fieldwork.operators.base import engine_reason
machine.engine_folder = lambda: Path(folder, "engine")
Path(folder, "engine", "cache").mkdir(parents=True)
ended = []
def begin():
    link = SimpleNamespace(process=1, close=lambda timeout: ended.append(timeout))
    engine.frames()._link = link
begin()
facts = {"stopped": sorted(bpy.ops.fieldwork.stop_engine()), "polls": bpy.ops.fieldwork.stop_engine.poll()}
begin()
facts["removed"] = sorted(bpy.ops.fieldwork.engine_remove())
queue.installer = SimpleNamespace(is_alive=lambda: True)
def told(call):
    try:
        return str(call())
    except EngineError as error:
        return str(error)
for name, python in (("replaced", Path(folder, "engine/venv/bin/python")), ("own", Path(folder, "own/bin/python"))):
    machine.engine_python = lambda: python
    facts[name] = [told(engine._open_link)[:29], told(queue._engine)[:29], engine_reason()]
answer({**facts, "ended": len(ended)})
""",
        folder=tmp_path,
    )
    assert (facts["stopped"], facts["removed"], facts["polls"], facts["ended"]) == (
        ["FINISHED"],
        ["FINISHED"],
        False,
        2,
    )
    assert facts["replaced"] == ["The engine is being installed"] * 3
    assert facts["own"][2] is None
    assert "installed" not in facts["own"][0] + facts["own"][1]


def test_a_linked_field_that_stands_still_goes_on_being_watched(bpy_script, tmp_path: Path) -> None:
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.live.training import _is_there
field = bpy.data.objects.new("Field", None)
bpy.context.scene.collection.objects.link(field)
field.fieldwork.is_field = True
bpy.ops.wm.save_as_mainfile(filepath=file)
bpy.ops.wm.read_homefile()
with bpy.data.libraries.load(file, link=True) as (_, wanted):
    wanted.objects = ["Field"]
linked = wanted.objects[0]
bpy.context.scene.collection.objects.link(linked)
bpy.context.view_layer.update()
(window,) = bpy.context.window_manager.windows
region = next(area.regions[0].as_pointer() for area in window.screen.areas if area.type == "VIEW_3D")
seen = [_is_there((region, linked.name_full))]
linked.hide_set(True)
answer(seen + [_is_there((region, linked.name_full)), _is_there((region, "Field"))])
""",
        file=tmp_path / "library.blend",
    )
    assert facts == [True, False, False]
