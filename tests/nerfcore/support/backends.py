"""The backends that this machine has, as parameters of tests: each kernel test runs on all of them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from fieldwork.nerfcore.kernels.device import using_kernels

_CUDA = pytest.mark.skipif(not torch.cuda.is_available() or torch.version.hip is not None, reason="no NVIDIA GPU")

BACKENDS = [
    pytest.param(("cpu", "warp"), id="warp-cpu"),
    pytest.param(("cpu", "torch"), id="torch"),
    pytest.param(("cuda", "warp"), id="warp-cuda", marks=[pytest.mark.gpu, _CUDA]),
    pytest.param(("cuda", "torch"), id="torch on CUDA", marks=[pytest.mark.gpu, _CUDA]),
]
# Kernels of surfaces run on Warp alone.
WARP_DEVICES = ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, _CUDA])]
if torch.version.hip is not None and torch.cuda.is_available():
    BACKENDS.append(pytest.param(("cuda", "torch"), id="torch on ROCm"))
if torch.backends.mps.is_available():
    BACKENDS.append(pytest.param(("mps", "torch"), id="torch on MPS"))


@pytest.fixture(params=BACKENDS)
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """A device, while its kernels are those of one backend."""
    kind, kernels = request.param
    with using_kernels(kernels):
        yield torch.device(kind)
