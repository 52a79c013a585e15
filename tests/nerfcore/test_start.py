"""What a command loads before it begins: whoever starts one waits for it."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest
from fieldwork.nerfcore import verbs

HEAVY = {
    "cli": ("torch", "warp", "scipy", "matplotlib", "pycolmap", "trimesh"),
    "engine.server": ("torch", "warp", "scipy", "matplotlib", "pycolmap", "trimesh"),
    "train.verb": ("matplotlib", "scipy", "trimesh", "skimage", "pycolmap", "torch._dynamo"),
    "mesh.verb": ("matplotlib.figure", "scipy.sparse.csgraph", "trimesh", "networkx", "pycolmap", "torch._dynamo"),
    "render.verb": ("matplotlib", "scipy", "trimesh", "skimage", "pycolmap", "torch._dynamo"),
    "export.verb": ("matplotlib", "trimesh", "onnx", "pxr", "pycolmap", "torch._dynamo"),
    "workflows.reconstruct": ("matplotlib.figure", "scipy.spatial", "trimesh", "av", "pycolmap", "torch._dynamo"),
    "evaluate.verb": ("matplotlib", "scipy", "trimesh", "pycolmap", "torch._dynamo"),
}


@pytest.mark.parametrize("module", HEAVY)
def test_a_verb_loads_no_library_before_it_needs_it(module: str) -> None:
    code = f"import sys, fieldwork.nerfcore.{module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert f"fieldwork.nerfcore.{module}" in loaded
    assert loaded.isdisjoint(HEAVY[module]), loaded & set(HEAVY[module])


@pytest.mark.parametrize("collecting", [True, False])
def test_loading_a_verb_does_not_look_for_garbage_and_leaves_that_as_it_was(monkeypatch, collecting: bool) -> None:
    seen = []
    monkeypatch.setattr(verbs.importlib, "import_module", lambda *names: seen.append(gc.isenabled()))
    before = gc.isenabled()
    try:
        gc.enable() if collecting else gc.disable()
        verbs.load_verb("train")
        assert seen == [False]
        assert gc.isenabled() is collecting
    finally:
        gc.enable() if before else gc.disable()
