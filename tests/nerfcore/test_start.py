"""What a command loads before it begins: whoever starts one waits for it."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Iterable

import pytest
from fieldwork.nerfcore import verbs

LIBRARIES = [
    "matplotlib", "trimesh", "networkx", "pycolmap", "av", "rawpy", "ray", "fsspec", "onnx", "onnxruntime", "pxr", "jinja2", "xatlas",
    "scipy.linalg", "scipy.ndimage", "scipy.sparse", "scipy.spatial", "skimage.color", "skimage.draw", "skimage.measure",
    "torch._dynamo",
]  # fmt: skip
WITHOUT_TORCH = [
    "doctor", "simulate", "dataset", "new", "import", "poses", "align", "classes", "region", "report", "instances", "label stroke",
    "label checkout", "reconstruct", "blocks", "batch",
]  # fmt: skip


def loaded(code: str) -> set[str]:
    """The modules that are there after `code`, in a process of its own."""
    code = f"import sys, importlib\n{code}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def loading(names: Iterable[str]) -> str:
    return f"from fieldwork.nerfcore.verbs import load_verb\nfor name in {list(names)}: load_verb(name)"


@pytest.mark.parametrize("module", ["cli", "engine.server"])
def test_neither_command_line_nor_engine_waits_for_a_library_before_it_is_asked(module: str) -> None:
    modules = loaded(f"import fieldwork.nerfcore.{module}")
    assert f"fieldwork.nerfcore.{module}" in modules
    assert modules.isdisjoint(["torch", "warp", *LIBRARIES])


def test_no_verb_loads_a_library_before_it_needs_it() -> None:
    modules = loaded(loading(verbs.VERBS))
    assert "torch" in modules
    assert modules.isdisjoint(LIBRARIES), modules & set(LIBRARIES)


def test_verbs_that_begin_without_a_field_do_not_wait_for_torch() -> None:
    modules = loaded(loading(WITHOUT_TORCH))
    assert "fieldwork.nerfcore.workflows.reconstruct" in modules
    assert modules.isdisjoint(["torch", "warp"])


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
