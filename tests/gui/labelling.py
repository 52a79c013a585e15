"""Labels from strokes on photos, by the mouse and the keyboard. Each function is a generator over a `Screen` (see driver.py).

FIELDWORK_LABELLING names a file with the project to label, its classes, and the strokes to draw: [{photo, class, points}].
"""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import bpy
from steps import alias, finish


class Desk:
    """The image editor with the photo, and what is known of the project's labels."""

    def __init__(self, screen) -> None:
        self.screen = screen
        self.plan = json.loads(Path(os.environ["FIELDWORK_LABELLING"]).read_text())
        self.settings.project = alias(Path(self.plan["project"]), "museum_fieldwork")
        self.folder = Path(self.settings.project)
        self.records = {
            image["name"]: image for image in json.loads((self.folder / "project.json").read_text())["images"]
        }

    @property
    def settings(self):
        return bpy.context.scene.fieldwork

    def module(self, name):
        return self.screen.module(f"addon.labels.{name}")

    @property
    def area(self):
        return next(area for area in self.screen.window.screen.areas if area.ui_type == "IMAGE_EDITOR")

    @property
    def region(self):
        return next(region for region in self.area.regions if region.type == "WINDOW")

    @property
    def photo(self):
        return self.module("editor").shown_photo(self.folder)

    @property
    def shown(self):
        return self.module("pending").shown(self.folder)

    def computed(self):
        return not self.module("pending").waiting() and self.module("results").computed(self.folder, "main", self.shown)

    def place(self, x, y):
        """Where in the window a pixel of the photo stands."""
        record = self.records[self.photo]
        at = self.module("editor").place_of(self.region, (record["width"], record["height"]), x, y)
        return self.region.x + at[0], self.region.y + at[1]

    def key(self, kind, **keys):
        """Press a key over the photo."""
        x, y = (int(v) for v in self.place(20, 20))
        self.screen.move(x, y)
        yield 0.1
        for value in ("PRESS", "RELEASE"):
            self.screen.window.event_simulate(type=kind, value=value, x=x, y=y, **keys)
        yield 0.3

    def show(self, name):
        bpy.ops.fieldwork.label_photo(photo=name)
        yield 0.5

    def stroke(self, points, **keys):
        """Draw with the left mouse button held."""
        places = [tuple(round(v) for v in self.place(*point)) for point in points]
        send = self.screen.window.event_simulate
        self.screen.move(*places[0])
        yield 0.1
        send(type="LEFTMOUSE", value="PRESS", x=places[0][0], y=places[0][1], **keys)
        yield 0.1
        for place in places[1:]:
            self.screen.move(*place)
            yield 0.03
        send(type="LEFTMOUSE", value="RELEASE", x=places[-1][0], y=places[-1][1], **keys)
        yield 0.1

    def settled(self):
        yield from self.screen.wait(self.computed, 60, "nothing was propagated")
        yield from self.screen.wait(lambda: self.screen.queue.current is None, 20, "the job does not end")
        yield 0.5


def labels(screen):
    """From no class to an accepted labelling; undo, the next photo, an engine that dies, the file loaded again."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    yield from screen.show_sidebar()
    desk = Desk(screen)
    yield 0.5
    yield from screen.toggle("label")
    yield 0.5
    screen.shot("begin")
    begin = time.monotonic()
    yield from first_classes(screen, desk)
    yield from first_strokes(screen, desk, begin)
    yield from undo(screen, desk)
    yield from other_tools(screen, desk)
    yield from part(screen, desk)
    yield from model(screen, desk)
    yield from next_photo(screen, desk)
    yield from killed(screen, desk)
    yield from accept(screen, desk)
    yield from again(screen, desk)
    yield from finish(screen)


def first_classes(screen, desk):
    yield from screen.press_button("fieldwork.label_photo", depth=900)
    yield from screen.wait(lambda: desk.photo, 10, "no photo is shown")
    yield 0.5
    screen.facts["first photo"] = desk.photo
    yield from screen.press_button("fieldwork.class_add", depth=900, shares=(0.83,))
    yield from screen.wait(lambda: len(desk.settings.classes) == 1, 60, "no class was added")
    desk.settings.classes[0].name = desk.plan["classes"][0]
    edits = screen.module("addon.project.edits")
    yield from screen.wait(lambda: not edits.waiting(), 30, "the name is not saved")
    for number, name in enumerate(desk.plan["classes"][1:], 2):
        bpy.ops.fieldwork.class_add(name=name)
        yield from screen.wait(lambda number=number: len(desk.settings.classes) == number, 30, "no class was added")
    screen.facts["classes"] = [entry.name for entry in desk.settings.classes]
    yield 0.5
    screen.shot("classes")


def first_strokes(screen, desk, begin):
    numbers = ("ONE", "TWO", "THREE", "FOUR", "FIVE", "SIX", "SEVEN", "EIGHT", "NINE")
    desk.settings.label_width = 4
    taken = []
    for photo in dict.fromkeys(stroke["photo"] for stroke in desk.plan["strokes"]):
        yield from desk.show(photo)
        for stroke in (s for s in desk.plan["strokes"] if s["photo"] == photo):
            yield from desk.key(numbers[stroke["class"] - 1])
            assert desk.settings.class_index == stroke["class"] - 1, "the number key chose another class"
            before = desk.shown
            yield from desk.stroke(stroke["points"])
            yield from screen.wait(lambda before=before: desk.shown > before, 60, "the mark is not in the journal")
            taken.append(desk.shown)
            if len(taken) == 1:
                released = time.monotonic()
                yield from screen.wait(lambda: screen.queue.current, 5, "nothing is propagated")
                yield 0.3
                screen.shot("propagating")
                yield from desk.settled()
                screen.facts["first overlay"] = [time.monotonic() - released, time.monotonic() - begin]
        yield from desk.settled()
        screen.shot(f"strokes-{len(taken)}")
    screen.facts["revisions"] = taken
    screen.facts["right"] = {"revision": desk.shown}
    desk.settings.label_strokes = False
    desk.settings.label_opacity = 1.0
    desk.area.tag_redraw()
    yield 0.5
    screen.shot("opaque")
    corners = [desk.place(0, 0), desk.place(desk.records[desk.photo]["width"], desk.records[desk.photo]["height"])]
    screen.facts["opaque"] = {
        "photo": desk.photo,
        "corners": [(x, screen.window.height - y) for x, y in corners],
        "colors": {entry.id: list(entry.color) for entry in desk.settings.classes},
    }
    desk.settings.label_opacity = 0.5
    desk.settings.label_view = "confidence"
    yield 0.5
    screen.shot("confidence")
    desk.settings.label_view, desk.settings.label_strokes = "labels", True


def undo(screen, desk):
    """Ctrl-Z over the photo, and back again."""
    newest = desk.shown
    begin = time.monotonic()
    yield from desk.key("Z", ctrl=True)
    yield from screen.wait(lambda: desk.shown == newest - 1, 10, "Ctrl-Z did nothing")
    seen = [desk.shown]
    yield from desk.settled()
    screen.facts["undo seconds"] = time.monotonic() - begin
    screen.shot("undone")
    yield from desk.key("Z", ctrl=True)
    yield from screen.wait(lambda: desk.shown == newest - 2, 10, "the second Ctrl-Z did nothing")
    seen.append(desk.shown)
    for expected in (newest - 1, newest):
        yield from desk.key("Z", ctrl=True, shift=True)
        yield from screen.wait(lambda expected=expected: desk.shown == expected, 10, "redo did nothing")
        seen.append(desk.shown)
    yield from desk.settled()
    screen.facts["undo"] = [newest, seen, json.loads((desk.folder / "marks/shown.json").read_text())["revision"]]
    # Ctrl-Z while the engine is still taking the mark, which is stopped so that there is time for it.
    engine = screen.queue.link.process.pid
    os.kill(engine, signal.SIGSTOP)
    yield from desk.stroke(desk.plan["strokes"][-1]["points"])
    on_the_way = len(desk.module("pending").marks_of(desk.folder))
    yield from desk.key("Z", ctrl=True)
    os.kill(engine, signal.SIGCONT)
    yield from screen.wait(lambda: not desk.module("pending").unfinished(desk.folder), 20, "the mark was not taken")
    yield from desk.settled()
    count = len((desk.folder / "marks/journal.jsonl").read_text().splitlines())
    screen.facts["undo at once"] = [on_the_way, count, desk.shown]


def other_tools(screen, desk):
    """A click takes a part, a stroke with Ctrl erases, void is none of the classes."""
    points = desk.plan["strokes"][-1]["points"]
    desk.settings.label_tool = "click"
    yield from desk.stroke(points[:1])
    yield from desk.settled()
    desk.settings.label_tool = "brush"
    yield from desk.stroke(points, ctrl=True)
    yield from desk.settled()
    desk.settings.label_tool = "void"
    yield from desk.stroke(points[:2])
    yield from desk.settled()
    screen.shot("tools")
    for _ in range(3):
        yield from desk.key("Z", ctrl=True)
    yield from desk.settled()
    lines = (desk.folder / "marks/journal.jsonl").read_text().splitlines()
    screen.facts["tools"] = [json.loads(line) for line in lines[-3:]]
    desk.settings.label_tool = "brush"


def part(screen, desk):
    """The outlines of the parts are shown, and a click takes a whole one; Ctrl-Z takes it back."""
    before, stroke = desk.shown, desk.plan["strokes"][-1]
    count = len((desk.folder / "marks/journal.jsonl").read_text().splitlines())  # with those that were undone
    yield from desk.show(stroke["photo"])
    desk.settings.class_index = stroke["class"] - 1
    desk.settings.label_tool, desk.settings.label_level, desk.settings.label_view = "part", "coarse", "parts"
    yield 0.5
    screen.shot("parts")
    yield from desk.stroke(stroke["points"][:1])
    yield from screen.wait(lambda: desk.shown == count + 1, 60, "the part is not marked")
    yield from desk.settled()
    screen.shot("part")
    mark = json.loads((desk.folder / "marks/journal.jsonl").read_text().splitlines()[-1])
    screen.facts["part"] = {"mark": mark, "revision": desk.shown}
    yield from desk.key("Z", ctrl=True)
    yield from screen.wait(lambda: desk.shown == before, 20, "Ctrl-Z did not take the part back")
    yield from desk.settled()
    desk.settings.label_tool, desk.settings.label_view = "brush", "labels"


def model(screen, desk):
    """Photos are encoded ahead; a click, and a box that is dragged, are answered by a model from files; Ctrl-Z takes both
    back."""
    desk.settings.label_tool = "click"
    desk.settings.label_encoder, desk.settings.label_decoder = desk.plan["encoder"], desk.plan["decoder"]
    encoded = desk.folder / "jobs/embeddings"
    yield from screen.wait(lambda: len(list(encoded.glob("*.npz"))) >= 4, 120, "no photos are encoded ahead")
    yield from screen.wait(lambda: screen.queue.current is None, 60, "the job does not end")
    files = sorted(path.name for path in encoded.glob("*.npz"))
    before, journal = desk.shown, desk.folder / "marks/journal.jsonl"
    count = len(journal.read_text().splitlines())
    for number, points in enumerate(([(180, 120)], [(100, 60), (130, 90), (140, 100)]), 1):
        yield from desk.stroke(points)
        wanted = count + number
        yield from screen.wait(lambda wanted=wanted: desk.shown == wanted, 60, "the model was not asked")
        yield from desk.settled()
    screen.facts["cut out"] = [json.loads(line) for line in journal.read_text().splitlines()[-2:]]
    screen.facts["encoded"] = [files, sorted(path.name for path in encoded.glob("*.npz"))]
    screen.facts["cut out at"] = [(180, 120), (120, 80)]
    screen.shot("model")
    for _ in range(2):
        yield from desk.key("Z", ctrl=True)
    yield from screen.wait(lambda: desk.shown == before, 20, "Ctrl-Z did not take back what the model cut out")
    yield from desk.settled()
    desk.settings.label_tool, desk.settings.label_encoder = "brush", ""


def next_photo(screen, desk):
    before = desk.photo
    yield from screen.press_button("fieldwork.label_next", depth=900, shares=(0.25,))
    yield from screen.wait(lambda: desk.photo != before, 60, "there is no next photo")
    yield 0.5
    screen.facts["next"] = [before, desk.photo]
    screen.shot("next")


def killed(screen, desk):
    """The engine dies while it propagates, and again before a stroke."""
    stroke = desk.plan["strokes"][0]
    yield from desk.show(stroke["photo"])
    desk.settings.class_index = stroke["class"] - 1
    before = desk.shown
    yield from desk.stroke(stroke["points"])
    yield from screen.wait(lambda: screen.queue.running, 20, "nothing is propagated")
    os.kill(screen.queue.link.process.pid, signal.SIGKILL)
    yield from screen.wait(lambda: screen.queue.outcome is not None, 20, "nobody misses the engine")
    screen.facts["death"] = screen.queue.outcome.error.message
    screen.facts["after death"] = [before, desk.shown]
    yield 0.5
    screen.shot("died")
    bpy.ops.fieldwork.dismiss()
    bpy.ops.fieldwork.label_retry()
    yield from desk.settled()
    count = len((desk.folder / "marks/journal.jsonl").read_text().splitlines())
    # Stopped, the engine takes the request and does not answer: then it is killed.
    engine = screen.queue.link.process.pid
    os.kill(engine, signal.SIGSTOP)
    yield from desk.stroke(stroke["points"])
    yield 0.5
    screen.facts["kept"] = len(desk.module("pending").marks_of(desk.folder))
    os.kill(engine, signal.SIGKILL)
    yield from screen.wait(lambda: desk.module("pending").error(desk.folder), 20, "nobody misses the engine")
    screen.facts["told"] = str(desk.module("pending").error(desk.folder))
    screen.area.tag_redraw()
    screen.sidebar.tag_redraw()
    yield 0.3
    screen.shot("kept")
    yield from desk.settled()
    lines = (desk.folder / "marks/journal.jsonl").read_text().splitlines()
    screen.facts["not lost"] = [count, len(lines), desk.shown]


def accept(screen, desk):
    desk.settings.label_seconds = 4
    bpy.ops.fieldwork.stop_engine()  # what was accepted does not hang on the engine that propagated
    yield from screen.press_button("fieldwork.label_accept", depth=900, shares=(0.72,))
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield from screen.idle(200)
    config = json.loads((desk.folder / "runs/main/config.json").read_text())
    screen.facts["accepted"] = [config["accepted"]["revision"], desk.shown, screen.queue.last.result["agreement"]]
    yield 0.5
    screen.shot("accepted")


def again(screen, desk):
    """Save, load: the marks and their labels are there, and undo goes no further back than the file."""
    path, shown = screen.folder / "labels.blend", desk.shown
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    # Another program marks something meanwhile: what the file remembers is not what the project shows.
    bpy.ops.wm.read_homefile(app_template="")
    yield 1.0
    bpy.ops.wm.open_mainfile(filepath=str(path))
    yield 1.5
    screen.facts["loaded"] = [shown, desk.shown, desk.settings.label_revision, desk.photo]
    screen.shot("loaded")
    yield from desk.show(desk.plan["strokes"][0]["photo"])
    yield from desk.stroke(desk.plan["strokes"][0]["points"])
    yield from desk.settled()
    yield from desk.key("Z", ctrl=True)
    yield from screen.wait(lambda: desk.shown == shown, 10, "Ctrl-Z did nothing after loading")
    yield from desk.settled()
    screen.facts["undone after loading"] = desk.shown
