"""Everything that only a GPU can show, in one go: `make gpu-check`, or where there is no network, with torch for CUDA and
the engine's libraries on PYTHONPATH, in the checkout:

    python3 -m fieldwork.nerfcore.bench.gpu_check [--out FOLDER] [--page FILE] [BENCH OPTIONS…]

Kernels against their twins, steps without synchronisation and recorded steps (tests marked `gpu`); the suite `gpu`, whose
figures go into the page; profiles of the fused kernels where NVIDIA's `ncu` is installed. A part that fails does not keep
the others from running.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]  # the checkout


def commands(python: str, out: Path, page: Path, bench: list[str], profiler: str | None) -> dict[str, list[str]]:
    """What is run, in this order, by name."""
    tests, run = out / "tests.xml", [python, "-m", "pytest", "-m", "gpu", "-p", "no:cacheprovider"]
    found = {
        "kernels and steps": [*run, "tests/nerfcore", "--junitxml", str(tests)],
        "figures": [python, "-m", "fieldwork.nerfcore", "bench", "--suite", "gpu", "--page", str(page)]
        + ["--tests", str(tests), *bench],
    }
    if profiler is not None:
        kernels = ["--kernel-name", "regex:fused_", "--launch-count", "6", "--set", "full", "-f"]
        test = [*run, "tests/nerfcore/test_fused.py", "-k", "standard and cuda"]
        found["profile"] = [profiler, *kernels, "-o", str(out / "fused"), *test]
    return found


def main() -> int:
    """Run all of it; the exit status is that of the first part that failed."""
    parser = argparse.ArgumentParser(prog="gpu_check", description=(__doc__ or "").split(":")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench" / "gpu")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "benchmarks.md")
    options, bench = parser.parse_known_args()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "tests.xml").unlink(missing_ok=True)
    failed = 0
    planned = commands(sys.executable, options.out.resolve(), options.page.resolve(), bench, shutil.which("ncu"))
    for name, command in planned.items():
        print(f"== {name}: {' '.join(command)}", flush=True)
        status = subprocess.run(command, cwd=ROOT, check=False).returncode
        print(f"== {name}: {'done' if status == 0 else f'failed ({status})'}", flush=True)
        failed = failed or status
    return failed


if __name__ == "__main__":
    sys.exit(main())
