"""Compile every kernel module for NVIDIA GPUs without one: `python -m fieldwork.nerfcore.kernels.compile_cuda OUT`."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import warp as wp

from . import cells, composite, encode, march
from .runtime import init

ARCHITECTURES = (75, 86, 89, 90, 120)
MODULES = {
    kernel.module.name: kernel.module
    for source in (encode, march, composite, cells)
    for kernel in vars(source).values()
    if isinstance(kernel, wp.Kernel)
}


def compile_all(folder: Path) -> list[tuple[str, int, float, int]]:
    """Write one binary a module and architecture; returns (module, architecture, seconds, bytes) rows.

    Raises:
        RuntimeError: a kernel does not compile.
    """
    init()
    rows = []
    for arch in ARCHITECTURES:
        for name, module in MODULES.items():
            target = folder / f"sm_{arch}" / name
            target.mkdir(parents=True, exist_ok=True)
            begin = time.perf_counter()
            wp.compile_aot_module(module, device=None, arch=arch, module_dir=str(target))
            size = sum(f.stat().st_size for f in target.iterdir() if f.suffix in (".cubin", ".ptx"))
            if size == 0:
                raise RuntimeError(f"{name} gave no binary for sm_{arch} in {target}")
            rows.append((name, arch, time.perf_counter() - begin, size))
    return rows


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/cubins")
    for name, arch, seconds, size in compile_all(folder):
        print(f"{name:22} sm_{arch:<4} {seconds:6.1f} s {size / 1024:8.1f} KiB")


if __name__ == "__main__":
    main()
