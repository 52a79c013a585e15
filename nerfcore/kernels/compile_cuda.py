"""Compile every kernel for NVIDIA GPUs without one, and report what each takes of a multiprocessor.

    python -m fieldwork.nerfcore.kernels.compile_cuda OUT [--architectures 75,86,89,90,120] [--jobs N]
        [--page FILE | --only NAME]

Writes OUT/sm_NN/MODULE/*.cubin, OUT/resources.json and OUT/resources.md, and the section "Resources" of a page; `--only`:
the modules whose name holds NAME.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import warp as wp

from ..files import write_json, write_section, write_text
from . import (
    cells,
    closest,
    composite,
    depth_normals,
    encode,
    encode_points,
    march,
    patches,
    random_reads,
    raycast,
    surface,
    triangles,
    voxel_fit,
    voxel_march,
    warping,
)
from .fused import lanes_of
from .fused_kernel import class_kernel, color_kernel, density_kernel
from .fused_shape import FusedShape
from .host import default_threads
from .resources import Resources, disassembler, markdown, read_resources
from .runtime import CUDA_BLOCK, init

ARCHITECTURES = (75, 86, 89, 90, 120)
SOURCES = (
    encode,
    encode_points,
    march,
    composite,
    cells,
    surface,
    patches,
    warping,
    depth_normals,
    raycast,
    closest,
    triangles,
    voxel_fit,
    voxel_march,
    random_reads,
)
# The standard preset: with few classes and with the most, and the branches blended.
_STANDARD = FusedShape(
    levels=8, octaves=8, concat=True, width=64, geometry=16, color_layers=3, appearance=0, classes=16, logits=False
)
_BLENDED, _MANY = dataclasses.replace(_STANDARD, concat=False), dataclasses.replace(_STANDARD, classes=64)
FUSED = {
    "fused, side by side": (density_kernel, _STANDARD),
    "fused, blended": (density_kernel, _BLENDED),
    "fused, colour": (color_kernel, _STANDARD),
    "fused, 16 classes": (class_kernel, _STANDARD),
    "fused, 64 classes": (class_kernel, _MANY),
}


def modules(architecture: int) -> dict[str, tuple[wp.Module, int]]:
    """Every kernel module by name, with the threads a block it is launched with on an architecture."""
    kernels = [kernel for source in SOURCES for kernel in vars(source).values() if isinstance(kernel, wp.Kernel)]
    found = {kernel.module.name: (kernel.module, CUDA_BLOCK) for kernel in kernels}
    lanes = lanes_of(architecture)
    return found | {name: (kernel(shape, lanes).module, lanes) for name, (kernel, shape) in FUSED.items()}


def compile_architecture(folder: Path, architecture: int, only: str = "") -> list[tuple[str, float, list[Resources]]]:
    """Compile the modules whose name holds `only` for one architecture; (module, seconds, resources of its kernels).

    Raises:
        RuntimeError: a kernel does not compile.
    """
    init()
    rows = []
    for name, (module, block) in modules(architecture).items():
        if only not in name:
            continue
        target = folder / f"sm_{architecture}" / name.replace(", ", "_").replace(" ", "_")
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        begin = time.perf_counter()
        module.options["block_dim"] = block
        wp.compile_aot_module(module, device=None, arch=architecture, module_dir=str(target), use_ptx=False)
        binary, meta = next(target.glob("*.cubin"), None), next(target.glob("*.meta"), None)
        if binary is None or meta is None:
            raise RuntimeError(f"{name} gave no binary for sm_{architecture} in {target}")
        rows.append((name, time.perf_counter() - begin, read_resources(binary, meta, architecture)))
    return rows


def compile_all(folder: Path, architectures: list[int], jobs: int, only: str = "") -> list[tuple[str, Resources]]:
    """Compile for several architectures, one process each, and write the report; (module, resources) of each kernel."""
    rows: list[tuple[str, Resources]] = []
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        results = pool.map(
            compile_architecture, [folder] * len(architectures), architectures, [only] * len(architectures)
        )
        for architecture, compiled in zip(architectures, results):
            for name, seconds, kernels in compiled:
                print(f"sm_{architecture:<4} {name:22} {seconds:6.1f} s", flush=True)
                for r in kernels:
                    local = "" if r.local_loads is None else f", local memory {r.local_loads} + {r.local_stores}"
                    print(f"    {r.kernel:18} {r.registers:3} registers, stack {r.stack}, shared {r.shared}{local}")
                rows += [(name, r) for r in kernels]
    write_json(folder / "resources.json", [{"module": m, **dataclasses.asdict(r)} for m, r in rows])
    write_text(folder / "resources.md", markdown(rows))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(prog="compile_cuda", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", type=Path, nargs="?", default=Path("build/cubins"))
    parser.add_argument("--architectures", default=",".join(map(str, ARCHITECTURES)))
    parser.add_argument("--jobs", type=int, default=default_threads())
    parser.add_argument("--page", type=Path, help="Markdown page whose section “Resources” is rewritten")
    parser.add_argument("--only", default="", help="compile only modules whose name holds this")
    options = parser.parse_args()
    if options.only and options.page is not None:
        parser.error("--page takes all modules: leave --only out")
    if disassembler() is None:
        print("nvdisasm is not installed: local memory accesses are not measured.")
    rows = compile_all(options.out, [int(a) for a in options.architectures.split(",")], options.jobs, options.only)
    if options.page is not None:
        write_section(options.page, "Resources", markdown(rows))
    print(f"Written: {options.out / 'resources.md'}")


if __name__ == "__main__":
    main()
