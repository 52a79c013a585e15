"""The engine with one more verb, which counts, fails or prints: quick to know, for tests of the machinery.

python tests/counting_engine.py [SECONDS OF GRACE FOR A CANCELLED JOB]      (repository root on PYTHONPATH)
"""

import ctypes
import importlib.util
import subprocess
import sys
import time
import types
from pathlib import Path

from nerfcore import params, verbs
from nerfcore.engine.server import main
from nerfcore.errors import InputError
from nerfcore.files import write_text


class CountParams(params.Params):
    project: Path
    steps: int = 100
    deaf: bool = False
    native: bool = False
    fail: str = ""


def count(p, report):
    report.stage("Counting")
    if p.fail == "input":
        raise InputError("photo.jpg is not an image.", "Remove it.")
    if p.fail == "bug":
        raise KeyError("no such thing")
    if p.native:
        ctypes.CDLL(None).puts(b"native text")
        ctypes.CDLL(None).fflush(None)
        print("python text", flush=True)
        subprocess.run([sys.executable, "-c", "import sys; print('child text'); sys.stdin.read()"], check=True)
    for step in range(p.steps):
        time.sleep(0.02)
        if not p.deaf:
            try:
                report.progress(step / p.steps, f"step {step}")
            finally:
                if report.cancelled:
                    write_text(p.project / "checkpoint", str(step))
        if step % 10 == 0:
            report.event("train", step=step, loss=float("nan"), where=p.project)
    return {"steps": p.steps, "project": p.project}


module = types.ModuleType("nerfcore.counting")
module.count = count
sys.modules["nerfcore.counting"] = module


class SlowToLoad:
    """A module whose libraries take three seconds to load."""

    def find_spec(self, name, path=None, target=None):
        if name != "nerfcore.slow":
            return None
        return importlib.util.spec_from_loader(name, self)

    def create_module(self, spec):
        return None

    def exec_module(self, loaded):
        time.sleep(3)
        loaded.count = count


sys.meta_path.insert(0, SlowToLoad())
verbs.VERBS["slow_to_load"] = verbs.Verb(CountParams, "slow:count", "Count, later.")
verbs.VERBS["count"] = verbs.Verb(CountParams, "counting:count", "Count.")
if len(sys.argv) > 1:
    from nerfcore.engine import server

    server.GRACE = float(sys.argv[1])
main()
