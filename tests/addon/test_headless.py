"""The batch example of docs/headless.md does what the text says."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fieldwork import nerfcore
from fieldwork.nerfcore.blender.simulate import simulate
from fieldwork.nerfcore.params import SimulateParams
from fieldwork.nerfcore.progress import Reporter

TEXT = (Path(nerfcore.__file__).parents[1] / "docs/headless.md").read_text("utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.S)
BATCH = next(block for block in BLOCKS if block.startswith("# batch.py"))
PACKAGE = next(block for block in BLOCKS if "fieldwork.register()" in block)
LABELS = next(block for block in BLOCKS if "show_labels" in block)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.splitlines()[0])
def test_every_example_is_python(block):
    compile(block, "docs/headless.md", "exec")


def test_every_operator_named_exists(bpy_script):
    names = sorted(set(re.findall(r"bpy\.ops\.fieldwork\.([a-z_]+)\(", TEXT)))
    found = bpy_script(PACKAGE + "\nanswer(dir(bpy.ops.fieldwork))")
    assert len(names) >= 4
    assert set(names) <= set(found)


@pytest.mark.slow
def test_the_batch_example_makes_blend_files_and_names_what_failed(tmp_path, bpy_script):
    captures, out = tmp_path / "captures", tmp_path / "results"
    simulate(SimulateParams(out=tmp_path / "sim", views=20, size=(480, 320)), Reporter())
    captures.mkdir()
    (tmp_path / "sim/photos").rename(captures / "museum")
    (captures / "empty").mkdir()
    (captures / "empty/readme.txt").write_text("no photos here")
    script = tmp_path / "batch.py"
    script.write_text(PACKAGE + BATCH)
    done = subprocess.run(
        [sys.executable, str(script), str(captures), str(out), "60"], capture_output=True, text=True, timeout=550
    )
    report = json.loads((out / "report.json").read_text("utf-8"))
    assert report["museum"] == "done", done.stderr[-3000:]
    assert "photo" in report["empty"]
    assert done.returncode == 1
    facts = bpy_script(
        "bpy.ops.wm.open_mainfile(filepath=path)\n" + LABELS + "\nanswer([len(bpy.data.cameras), root['show_labels']])",
        path=out / "museum.blend",
    )
    assert facts[0] >= 18
    assert facts[1] == 1.0


TERMINATED = """
import signal, threading
from fieldwork.addon import cli
cli.machine.engine_python = lambda: ENGINE_PYTHON
started, popen = [], cli.subprocess.Popen
def start(command, **options):
    started.append(popen([ENGINE_PYTHON, "-c", "import time; time.sleep(60)"]))
    threading.Timer(0.5, os.kill, [os.getpid(), signal.SIGTERM]).start()
    return started[0]
cli.subprocess.Popen = start
answer([cli.main(["train", "project"]), started[0].poll()])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signal")
def test_what_ends_blender_ends_the_engine_it_waits_for(bpy_script):
    assert bpy_script(TERMINATED) == [-signal.SIGTERM, -signal.SIGTERM]
