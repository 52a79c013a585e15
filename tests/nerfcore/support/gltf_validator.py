"""The glTF validator of Khronos, an npm package, where it is installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from fieldwork.nerfcore import __file__ as package

FOLDER = Path(package).parents[1] / "build" / "node"
MISSING = "needs node and `npm install --prefix build/node gltf-validator`"
VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(
  (report) => console.log(JSON.stringify(report)));
"""
ERROR, WARNING, HINT = 0, 1, 2  # severities of messages; HINT: what the validator does not know of


def is_there() -> bool:
    return shutil.which("node") is not None and (FOLDER / "node_modules/gltf-validator").is_dir()


def report_of(path: Path | str) -> dict[str, Any]:
    """What the validator says of a GLB file: see its schema of reports."""
    environment = {**os.environ, "NODE_PATH": str(FOLDER / "node_modules")}
    done = subprocess.run(["node", "-e", VALIDATE, str(path)], env=environment, capture_output=True, check=True)
    return json.loads(done.stdout)
