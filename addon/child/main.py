"""Entry of the child process that needs Blender; started by `nerfcore/blender/process.py` in one of two ways.

    python addon/child/main.py TASK REQUEST.json                              (a Python that has bpy)
    blender -b --factory-startup --python addon/child/main.py -- TASK REQUEST.json

One JSON object a line goes out on stdout: {"event": …} while it works, last {"result": …} or {"error": …}. Everything
else that is printed (Blender talks a lot) goes to stderr. The end of stdin means that the parent is gone: exit.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

TASKS = {
    "simulate": "addon.simulate.task:simulate",
    "dataset": "addon.photograph.dataset:dataset",
    "blend": "addon.child.package:write_blend",
}


def main() -> int:
    out = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()

    def emit(message: dict[str, Any]) -> None:
        out.write(json.dumps(message) + "\n")
        out.flush()

    task, request = sys.argv[-2:]
    try:
        function = _load(task)
        result = function(json.loads(Path(request).read_text("utf-8")), lambda **data: emit({"event": data}))
    except Exception as error:  # noqa: BLE001 - whatever it is, the parent must hear of it
        traceback.print_exc()
        for_user = getattr(error, "for_user", False)
        emit({"error": str(error) if for_user else f"{type(error).__name__}: {error}", "for_user": for_user})
        code = 1
    else:
        emit({"result": result})
        code = 0
    sys.stdout.flush()
    sys.stderr.flush()
    # Some bpy versions crash or hang while Python shuts down; all files are closed by now.
    os._exit(code)


def _exit_with_parent() -> None:
    while os.read(0, 1024):
        continue
    os._exit(130)


def _load(task: str) -> Callable[..., dict[str, Any]]:
    """The task's function, with the folder above imported as the package `fieldwork` whatever its name is."""
    import bpy  # noqa: F401 - in a plain Python, bmesh and mathutils exist only after this

    root = Path(__file__).resolve().parents[2]
    spec = importlib.util.spec_from_file_location(
        "fieldwork", root / "__init__.py", submodule_search_locations=[str(root)]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules["fieldwork"] = package
    spec.loader.exec_module(package)
    module, name = TASKS[task].split(":")
    return getattr(importlib.import_module(f"fieldwork.{module}"), name)


if __name__ == "__main__":
    main()
