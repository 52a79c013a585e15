"""What compiled CUDA kernels take of a multiprocessor, read from their binaries: no GPU and no CUDA toolkit needed.

Registers, stack and static shared memory stand in the ELF file (attributes of `.nv.info`, sizes of `.nv.shared.*`),
dynamic shared memory in the file Warp writes beside it, accesses to local memory (spilled registers and arrays) in the
disassembly, where NVIDIA's `nvdisasm` is installed (`pip install nvidia-cuda-nvdisasm`).
"""

from __future__ import annotations

import importlib.metadata
import json
import re
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection

# Attributes of .nv.info, named as in cuobjdump's output.
REGCOUNT, MIN_STACK_SIZE = 0x2F, 0x12
_SIZED_VALUE = 4  # format byte of an attribute that is followed by its length


@dataclass(frozen=True)
class Resources:
    """Of one kernel for one architecture: registers and stack bytes a thread, shared bytes a block, instructions that
    read and write local memory (None: not measured)."""

    kernel: str
    architecture: int
    registers: int
    stack: int
    shared: int
    local_loads: int | None
    local_stores: int | None


def _attributes(data: bytes) -> list[tuple[int, bytes]]:
    """(attribute, value) pairs of an .nv.info section."""
    found, place = [], 0
    while place + 4 <= len(data):
        kind, attribute, size = struct.unpack_from("<BBH", data, place)
        length = size if kind == _SIZED_VALUE else 0
        found.append((attribute, data[place + 4 : place + 4 + length]))
        place += 4 + length
    return found


def disassembler() -> Path | None:
    """NVIDIA's nvdisasm as installed by its wheel; None when it is not."""
    try:
        files = importlib.metadata.files("nvidia-cuda-nvdisasm") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    return next((Path(str(f.locate())) for f in files if f.stem == "nvdisasm"), None)


def _local_accesses(binary: Path) -> dict[str, tuple[int, int]] | None:
    """Loads from and stores to local memory by kernel; None without a disassembler."""
    program = disassembler()
    if program is None:
        return None
    text = subprocess.run([str(program), "-c", str(binary)], capture_output=True, text=True, check=True).stdout
    counts: dict[str, tuple[int, int]] = {}
    for part in re.split(r"^\s*\.section\s+\.text\.", text, flags=re.MULTILINE)[1:]:
        name = re.split(r"[\s,]", part, maxsplit=1)[0].strip('"')
        counts[name] = (len(re.findall(r"\bLDL\b", part)), len(re.findall(r"\bSTL\b", part)))
    return counts


def read_resources(binary: Path, meta: Path, architecture: int) -> list[Resources]:
    """Resources of every kernel in a `.cubin`; `meta` is the file Warp wrote with it."""
    dynamic = json.loads(meta.read_text(encoding="utf-8"))
    local = _local_accesses(binary)
    rows = []
    with open(binary, "rb") as file:
        elf = ELFFile(file)
        symbols = elf.get_section_by_name(".symtab")
        info = elf.get_section_by_name(".nv.info")
        if not isinstance(symbols, SymbolTableSection) or info is None:
            raise RuntimeError(f"{binary} has no kernel information")
        values: dict[str, dict[int, int]] = {}
        for attribute, value in _attributes(info.data()):
            if attribute in (REGCOUNT, MIN_STACK_SIZE):
                symbol, number = struct.unpack("<II", value)
                values.setdefault(symbols.get_symbol(symbol).name, {})[attribute] = number
        for name, found in values.items():
            if REGCOUNT not in found or not name.endswith("_forward"):
                continue
            static = elf.get_section_by_name(f".nv.shared.{name}")
            shared = (static["sh_size"] if static is not None else 0) + dynamic.get(f"{name}_smem_bytes", 0)
            loads, stores = (None, None) if local is None else local[name]
            kernel = re.sub(r"_[0-9a-f]{8}_cuda_kernel_forward$", "", name)
            stack = found.get(MIN_STACK_SIZE, 0)
            rows.append(Resources(kernel, architecture, found[REGCOUNT], stack, shared, loads, stores))
    return rows


def markdown(rows: list[tuple[str, Resources]]) -> str:
    """A table: a row a module and kernel, for each architecture registers / stack / shared / local accesses."""
    architectures = sorted({r.architecture for _, r in rows})
    cells = {(module, r.kernel, r.architecture): r for module, r in rows}
    lines = [
        "Registers a thread · stack bytes a thread · shared bytes a block · loads from + stores to local memory.",
        "",
        "| module | kernel | " + " | ".join(f"sm_{a}" for a in architectures) + " |",
        "| --- | --- |" + " --- |" * len(architectures),
    ]
    for module, kernel in dict.fromkeys((m, r.kernel) for m, r in rows):
        texts = []
        for architecture in architectures:
            r = cells.get((module, kernel, architecture))
            local = "not measured" if r is None or r.local_loads is None else f"{r.local_loads} + {r.local_stores}"
            texts.append("–" if r is None else f"{r.registers} · {r.stack} · {r.shared} · {local}")
        lines.append(f"| {module} | {kernel} | " + " | ".join(texts) + " |")
    return "\n".join(lines) + "\n"
