"""Make sure that the pip `bpy` finds the system libraries it links with; called by `make venv`.

Blender's wheel needs a few X11 and GL libraries even without a display. On Debian as root they are installed, elsewhere
the command is printed. Nothing is printed when all is well.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

PACKAGES = [
    "libx11-6",
    "libxi6",
    "libxxf86vm1",
    "libxfixes3",
    "libxrender1",
    "libxkbcommon0",
    "libsm6",
    "libice6",
    "libgl1",
    "libegl1",
    "libgomp1",
    "libxext6",
]


def missing_library() -> str:
    """The loader's complaint when `import bpy` fails for want of a library, else an empty string."""
    run = subprocess.run([sys.executable, "-c", "import bpy"], capture_output=True, text=True, check=False)
    lines = [line for line in run.stderr.splitlines() if "cannot open shared object" in line]
    return lines[-1] if lines else ""


def main() -> None:
    complaint = missing_library()
    if not complaint:
        return
    command = ["apt-get", "install", "-y", "--no-install-recommends", *PACKAGES]
    if os.geteuid() == 0 and shutil.which("apt-get"):
        print(f"Blender's Python module needs system libraries ({complaint}); installing them.")
        subprocess.run(["apt-get", "update", "-qq"], check=False)
        if subprocess.run(command, check=False).returncode == 0 and not missing_library():
            return
    print(f"Blender's Python module cannot be loaded: {missing_library()}\nInstall: sudo {' '.join(command)}")
    sys.exit(1)


if __name__ == "__main__":
    main()
