"""The doctor: the keys it promises, and what it says of a machine that lacks something."""

from __future__ import annotations

import sys
from importlib import metadata

from fieldwork.nerfcore.engine import doctor as module
from fieldwork.nerfcore.params import DoctorParams
from fieldwork.nerfcore.progress import Reporter

KEYS = {"ok", "device", "python", "torch", "warp", "pycolmap", "blender", "problems"}


def test_doctor_tells_the_truth_about_this_machine():
    import torch

    result = module.doctor(DoctorParams(), Reporter())
    assert result.keys() >= KEYS
    assert result["ok"] == (not result["problems"])
    assert result["torch"] == torch.__version__
    assert result["pycolmap"] == metadata.version("pycolmap")
    assert (result["device"] == "cuda") == torch.cuda.is_available()
    assert result["free_disk_gb"] > 0


def test_missing_library_is_a_problem_with_a_remedy(monkeypatch):
    monkeypatch.setattr(module, "LIBRARIES", [("no-such-library", "no_such_library", "torch")])
    result = module.doctor(DoctorParams(), Reporter())
    assert not result["ok"]
    assert result["torch"] is None
    assert "no-such-library is not installed" in result["problems"][0]
    assert "Repair" in result["problems"][0]


def test_library_that_does_not_load_is_a_problem(monkeypatch):
    monkeypatch.setattr(module, "LIBRARIES", [("xatlas", "xatlas", "xatlas")])
    monkeypatch.setitem(sys.modules, "xatlas", None)
    result = module.doctor(DoctorParams(), Reporter())
    assert any("does not load" in problem for problem in result["problems"])


def test_full_disk_is_a_problem(monkeypatch):
    monkeypatch.setattr(module, "MINIMUM_DISK_GB", 1e9)
    assert any("free" in problem for problem in module.doctor(DoctorParams(), Reporter())["problems"])


def test_driver_without_torch_support_is_a_problem(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(module.shutil, "which", lambda name: f"/usr/bin/{name}")
    assert any("NVIDIA" in problem for problem in module.doctor(DoctorParams(), Reporter())["problems"])


def test_doctor_names_the_backend_and_what_it_multiplies_in(monkeypatch):
    from fieldwork.nerfcore.kernels.device import backend_of, choose_device

    result = module.doctor(DoctorParams(), Reporter())
    assert result["backend"] == backend_of(choose_device()).name
    assert result["native_dtype"] in ("bfloat16", "float16", "float32")
    assert set(result["training_memory_gb"]) == {"draft", "standard", "high"}
    assert all(0.5 < gigabytes < 8 for gigabytes in result["training_memory_gb"].values())
    assert result["free_memory_gb"] > 0
    monkeypatch.setenv("FIELDWORK_BACKEND", "torch")
    result = module.doctor(DoctorParams(), Reporter())
    assert result["backend"] == "torch"
    assert any("PyTorch's own operations" in note for note in result["notes"])
    assert result["ok"] == (not result["problems"])


def test_a_device_that_is_not_there_is_a_problem(monkeypatch):
    monkeypatch.setenv("FIELDWORK_DEVICE", "cuda:99")
    result = module.doctor(DoctorParams(), Reporter())
    assert result["device"] == "none"
    assert any("FIELDWORK_DEVICE" in problem for problem in result["problems"])
