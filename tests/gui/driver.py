"""Runs inside the windowed Blender: drives one scenario of `scenarios.py` or `sessions.py` by simulated events.

    blender --enable-event-simulate --python driver.py -- SCENARIO OUTPUT_FOLDER

A scenario is a generator; each `yield` lets Blender handle events and draw. Screenshots go to the output folder,
`<scenario>.json` says how it ended.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy

Steps = Iterator[float | None]
TICK = 0.03
PATIENCE = float(os.environ.get("FIELDWORK_GUI_PATIENCE", "1"))  # factor of all waiting, for a machine under load
PACKAGE = "bl_ext.user_default.fieldwork"
BARE = {"life"}  # scenarios that install and enable the extension themselves


class Screen:
    """The window as an artist has it: a mouse, keys, and eyes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.facts: dict = {}
        self.headers: tuple = (None, 0.0)
        self.clicked = 0.0

    @property
    def window(self):
        return bpy.context.window_manager.windows[0]

    @property
    def area(self):
        return max((a for a in self.window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width * a.height)

    @property
    def view(self):
        return next(region for region in self.area.regions if region.type == "WINDOW")

    @property
    def sidebar(self):
        return next(region for region in self.area.regions if region.type == "UI")

    def module(self, name: str):
        return importlib.import_module(f"{PACKAGE}.{name}")

    @property
    def queue(self):
        return self.module("addon.jobs.queue").queue

    def move(self, x: float, y: float) -> None:
        self.window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=int(x), y=int(y))

    def type(self, text: str) -> Steps:
        """Type letters where the mouse is."""
        x, y = self.area.x + self.area.width // 2, self.area.y + self.area.height // 2
        for letter in text:
            kind = "SPACE" if letter == " " else letter.upper()
            for value in ("PRESS", "RELEASE"):
                self.window.event_simulate(
                    type=kind, value=value, x=x, y=y, **({"unicode": letter} if value == "PRESS" else {})
                )
            yield 0.05

    def press(self, kind: str, x: float, y: float) -> None:
        for value in ("PRESS", "RELEASE"):
            self.window.event_simulate(type=kind, value=value, x=int(x), y=int(y))

    def click(self, x: float, y: float) -> Steps:
        self.move(x, y)
        yield
        self.move(x + 1, y)
        yield 0.1
        self.press("LEFTMOUSE", x + 1, y)
        yield 0.2

    def scroll_down(self, notches: int) -> Steps:
        """Turn the wheel over the sidebar."""
        x, y = (int(middle) for middle in (self.sidebar.x + 60, self.sidebar.y + self.sidebar.height / 2))
        self.move(x, y)
        yield 0.1
        for _ in range(notches):
            self.window.event_simulate(type="WHEELDOWNMOUSE", value="PRESS", x=x, y=y)
            yield 0.05
        yield 0.3

    def shot(self, name: str) -> None:
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        subprocess.run(["import", "-window", "root", str(self.folder / f"{name}.png")], check=True)

    def show_sidebar(self) -> Steps:
        """Open the sidebar at Fieldwork's tab and make it wide."""
        self.area.spaces.active.show_region_ui = True
        yield 0.3
        self.sidebar.active_panel_category = "Fieldwork"
        self.sidebar.tag_redraw()
        yield 0.3

    def toggle(self, panel: str) -> Steps:
        """Click the header of a sub-panel while those above it are closed and no job runs."""
        from steps import PANELS  # beside this file, which Blender runs by its path

        if self.queue.outcome is not None:  # a message above the headers would move them
            bpy.ops.fieldwork.dismiss()
            self.sidebar.tag_redraw()
            yield 0.3
        state = [(job.id, job.state) for job in [*self.queue.finished, self.queue.current] if job]
        if self.headers[0] != state:
            found = yield from self.buttons(depth=260)
            main = [place for place in found if place[0].startswith("bpy.ops.fieldwork.")]
            assert main, "the main panel has no button"
            # Below the button of the next step, or the bar of the job and its message, come the headers.
            job = self.queue.current
            rows = sorted(main, key=lambda place: -place[2])
            whole = rows[0][0].startswith("bpy.ops.fieldwork.reconstruct(")
            below = self.unit * 1.8 if job else (16 if whole else 24) + self.unit / 2
            others = (place for place in rows if not place[0].startswith("bpy.ops.fieldwork.reconstruct("))
            self.headers = (state, next(others, rows[0])[2] - below)
        yield from self.click(self.sidebar.x + 60, self.headers[1] - PANELS.index(panel) * self.unit)

    @property
    def unit(self) -> float:
        """Distance of two headers of closed panels in pixels."""
        return 26 * bpy.context.preferences.system.ui_scale

    def buttons(self, depth: float = 2000, shares: tuple[float, ...] = ()) -> Iterator[float | None]:
        """Sweep the mouse down the sidebar; returns [(python command, x, y)] of all operator buttons seen.

        `shares`: where across its width the mouse goes down, if not at the usual places.
        """
        found, region = [], self.sidebar
        top = region.y + region.height
        for y in range(top - 8, int(max(region.y + 4, top - depth)), -9):
            # The small button that stops a job stands at the right edge.
            for share in shares or ((0.83,) if self.queue.current else (0.25, 0.72)):
                x = region.x + region.width * share
                self.move(x, y)
                yield
                with bpy.context.temp_override(window=self.window, area=self.area, region=region):
                    if not bpy.ops.ui.copy_python_command_button.poll():
                        continue
                    bpy.context.window_manager.clipboard = ""
                    bpy.ops.ui.copy_python_command_button()
                command = bpy.context.window_manager.clipboard
                # The same button is met in several lines; another one with the same command lies further down.
                if command and not any(c == command and abs(py - y) < 20 for c, _, py in found):
                    found.append((command, x, y - 4))
        return found

    def press_button(self, operator: str, depth: float = 260, shares: tuple[float, ...] = ()) -> Steps:
        """Click the button of an operator in the sidebar, found as a hand with eyes closed would."""
        buttons = yield from self.buttons(depth, shares)
        places = [(x, y) for command, x, y in buttons if command.startswith(f"bpy.ops.{operator}(")]
        assert places, f"there is no button {operator} among {[command for command, _, _ in buttons]}"
        self.clicked = time.monotonic()
        yield from self.click(*places[0])

    def run_operator(self, operator: str, seconds: float) -> Steps:
        """Run a verb by its operator and wait for its end."""
        module, name = operator.split(".")
        getattr(getattr(bpy.ops, module), name)()
        yield from self.idle(seconds)

    def idle(self, seconds: float) -> Steps:
        """Wait until no job runs; the last one must have succeeded."""
        yield from self.wait(lambda: self.queue.current is None, seconds, "the job does not end")
        last = self.queue.last
        assert last.state == "done", last.report()
        yield 0.3

    def wait(self, condition: Callable[[], object], seconds: float, what: str) -> Steps:
        end = time.monotonic() + seconds * PATIENCE
        while not condition():
            assert time.monotonic() < end, f"{what}: nothing after {seconds * PATIENCE:g} s"
            yield 0.1


def run(steps: Steps, screen: Screen) -> None:
    def finish(code: int, error: str = "") -> None:
        (screen.folder / f"{sys.argv[-2]}.json").write_text(json.dumps({**screen.facts, "error": error}, default=str))
        # Leave as an artist does, so that the extension is unregistered.
        if code == 0:
            bpy.ops.wm.quit_blender()
        os._exit(code)

    def step() -> float | None:
        try:
            return next(steps) or TICK
        except StopIteration:
            finish(0)
        except BaseException:  # noqa: BLE001 - whatever it is, it goes into the result
            error = traceback.format_exc()
            try:
                screen.shot("failure")
            finally:
                finish(1, error)
        return None

    bpy.app.timers.register(step, first_interval=1.0, persistent=True)


def main() -> None:
    name, folder = sys.argv[sys.argv.index("--") + 1 :][:2]
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.use_preferences_save = False
    if name not in BARE:
        bpy.ops.preferences.addon_enable(module=PACKAGE)
    sys.path.insert(0, str(Path(__file__).parent))
    modules = [
        importlib.import_module(module)
        for module in (
            "scenarios",
            "sessions",
            "panels",
            "labelling",
            "surface_labels",
            "live",
            "live_training",
            "campaigns",
        )
    ]
    scenario = next(getattr(module, name) for module in modules if hasattr(module, name))
    screen = Screen(Path(folder))
    run(scenario(screen), screen)


main()
