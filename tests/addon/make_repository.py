"""A static extension repository: index.json, index.html with a drag-and-drop link, and the zip.

    .venv/bin/python tests/addon/make_repository.py dist/repository

Serve the folder over HTTPS, or add it in Blender as a local repository's remote URL (file:///…/index.json).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from matrix import build_zip, extension_tool


def make_repository(folder: Path) -> list[Path]:
    """Write the repository of the current sources into `folder`, which is emptied first; returns its files."""
    python = Path(sys.executable)
    shutil.rmtree(folder, ignore_errors=True)
    built = build_zip(python, folder)
    command = [python, extension_tool(python), "server-generate", "--repo-dir", folder, "--html"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    files = [built, folder / "index.json", folder / "index.html"]
    for path in files:
        if not path.is_file():
            raise FileNotFoundError(path)
    return files


if __name__ == "__main__":
    for path in make_repository(Path(sys.argv[1] if len(sys.argv) > 1 else "dist/repository")):
        print(path)
