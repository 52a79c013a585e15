"""Which device is taken, and which backend serves it."""

from __future__ import annotations

import pytest
import torch
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.field.mlp import compute_dtype
from fieldwork.nerfcore.kernels import device as module
from fieldwork.nerfcore.kernels.device import backend_of, choose_device, native_half, using_kernels

CPU, CUDA, MPS = (torch.device(kind) for kind in ("cpu", "cuda", "mps"))


@pytest.fixture(autouse=True)
def nothing_remembered(monkeypatch: pytest.MonkeyPatch):
    for name in ("FIELDWORK_DEVICE", "FIELDWORK_BACKEND"):
        monkeypatch.delenv(name, raising=False)
    caches = module._backend, native_half
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def machine(monkeypatch: pytest.MonkeyPatch, cuda: int = 0, hip: str | None = None, mps: bool = False) -> None:
    """Let torch say that there are so many GPUs."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: mps)


def test_the_first_gpu_is_taken_else_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    machine(monkeypatch)
    assert choose_device() == CPU
    machine(monkeypatch, cuda=2)
    assert choose_device() == CUDA
    machine(monkeypatch, mps=True)
    assert choose_device() == MPS


@pytest.mark.parametrize(
    ("wanted", "there", "device"),
    [
        ("cpu", {"cuda": 1}, "cpu"),
        ("cuda", {"cuda": 1}, "cuda"),
        ("cuda:1", {"cuda": 2}, "cuda:1"),
        ("rocm", {"cuda": 1, "hip": "6.4"}, "cuda"),
        ("mps", {"mps": True}, "mps"),
        ("auto", {}, "cpu"),
    ],
)
def test_the_environment_chooses_the_device(
    monkeypatch: pytest.MonkeyPatch, wanted: str, there: dict, device: str
) -> None:
    machine(monkeypatch, **there)
    monkeypatch.setenv("FIELDWORK_DEVICE", wanted)
    assert choose_device() == torch.device(device)


@pytest.mark.parametrize(
    ("wanted", "there"),
    [
        ("gpu", {"cuda": 1}),
        ("cuda:x", {"cuda": 1}),
        ("cpu:1", {}),
        ("cuda", {}),
        ("cuda:2", {"cuda": 2}),
        ("rocm", {"cuda": 1}),
        ("cuda", {"cuda": 1, "hip": "6.4"}),
        ("mps", {"cuda": 1}),
    ],
)
def test_a_device_that_is_not_there_is_refused_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch, wanted: str, there: dict
) -> None:
    machine(monkeypatch, **there)
    monkeypatch.setenv("FIELDWORK_DEVICE", wanted)
    with pytest.raises(SettingError, match=f"FIELDWORK_DEVICE is “{wanted}”"):
        choose_device()


def test_each_device_has_its_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    machine(monkeypatch, cuda=1)
    assert [backend_of(d).name for d in (CPU, CUDA, MPS)] == ["warp-cpu", "warp-cuda", "torch"]
    assert backend_of(CUDA).fixed_capacity
    assert backend_of(CUDA).fused
    # A GPU is filled by one launch: threads of the host would only wait for each other.
    assert [backend_of(d).host_threads for d in (CPU, CUDA, MPS)] == [True, False, False]
    module._backend.cache_clear()
    machine(monkeypatch, cuda=1, hip="6.4")
    assert backend_of(CUDA).name == "torch"
    assert not backend_of(CUDA).fused
    assert not backend_of(CUDA).host_threads


def test_the_backend_can_be_overridden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDWORK_BACKEND", "torch")
    assert [backend_of(d).name for d in (CPU, CUDA)] == ["torch", "torch"]
    with using_kernels("warp"):
        assert backend_of(CPU).name == "warp-cpu"
    monkeypatch.setenv("FIELDWORK_BACKEND", "warp")
    with pytest.raises(SettingError, match="no kernels for MPS"):
        backend_of(MPS)
    monkeypatch.setenv("FIELDWORK_BACKEND", "jax")
    with pytest.raises(SettingError, match="jax"):
        backend_of(CPU)


def test_emulated_bfloat16_is_not_native(monkeypatch: pytest.MonkeyPatch) -> None:
    class Here:
        def __init__(self, device) -> None:
            pass

        def __enter__(self) -> None:
            pass

        def __exit__(self, *error) -> None:
            pass

    monkeypatch.setattr(torch.cuda, "device", Here)
    # A GPU before Ampere: torch computes with bfloat16 there, ten times as slowly as with float16.
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation)
    assert compute_dtype("auto", CUDA) == torch.float16
    native_half.cache_clear()
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: True)
    assert compute_dtype("auto", CUDA) == torch.bfloat16


@pytest.mark.parametrize(
    ("able", "dtype"), [("amx_bf16", "bfloat16"), ("avx512_bf16", "bfloat16"), ("avx2", "float32")]
)
def test_a_cpu_multiplies_bfloat16_where_it_has_instructions_for_it(
    monkeypatch: pytest.MonkeyPatch, able: str, dtype: str
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {able: True})
    with using_kernels("torch"):
        assert compute_dtype("auto", CPU) == getattr(torch, dtype)
    with using_kernels("warp"):  # whose networks are in single precision
        assert compute_dtype("auto", CPU) == torch.float32
    assert compute_dtype("auto", MPS) == torch.float32
