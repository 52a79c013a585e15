"""A process in which Ray, fsspec and s3fs cannot be imported: everything but --cluster and --storage works, and these say
how to install what they need."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

# Stands in front of all that the process imports, as if the extra was not installed.
HIDE = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("ray", "fsspec", "s3fs", "aiobotocore", "moto"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hidden())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name == "ray" else found(name, package)
"""
ALL_MODULES = """
import importlib, pkgutil
from fieldwork import nerfcore
for module in pkgutil.walk_packages(nerfcore.__path__, nerfcore.__name__ + "."):
    room, _, inner = module.name.removeprefix(nerfcore.__name__ + ".").partition(".")
    # The bridge is run by a process of its own, which has Ray.
    if room in ("cluster", "workflows", "blocks") and inner != "bridge":
        importlib.import_module(module.name)
assert not {"ray", "fsspec", "s3fs"} & set(sys.modules)
"""
RUN = "from fieldwork.nerfcore import cli\nsys.exit(cli.main({arguments!r}))"


def run(code: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "FIELDWORK_LOG": ""}
    return subprocess.run(
        [sys.executable, "-c", HIDE + code], capture_output=True, text=True, timeout=300, env=environment
    )


def verb(*arguments: str) -> tuple[int, dict[str, Any]]:
    found = run(RUN.format(arguments=[*arguments, "--json"]))
    return found.returncode, json.loads(found.stdout)


def test_the_modules_of_campaigns_load_without_it() -> None:
    found = run(ALL_MODULES)
    assert found.returncode == 0, found.stderr


@pytest.mark.parametrize(
    "extra",
    [
        ("batch", "--cluster", "auto"),
        pytest.param(("batch", "--cluster", "head:6379", "--dry-run"), marks=pytest.mark.slow),
        pytest.param(("blocks", "--cluster", "auto"), marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_what_needs_it_says_how_to_install_it(extra: tuple[str, ...], tmp_path: Path) -> None:
    name, *options = extra
    (tmp_path / "list.csv").write_text("photos\na\n")
    place = tmp_path / "list.csv" if name == "batch" else tmp_path
    before = sorted(tmp_path.rglob("*"))
    code, answer = verb(name, str(place), *options)
    assert code == 1
    assert "which is not installed here" in answer["error"]["message"]
    assert 'pip install "fieldwork[cluster]"' in answer["error"]["hint"]
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_a_batch_on_one_machine_works_without_it(tmp_path: Path) -> None:
    """It reads the list and gives each capture its turn; here both have no photos, which each is told."""
    for name in ("a", "b"):
        (tmp_path / name / "photos").mkdir(parents=True)
    path = tmp_path / "list.csv"
    path.write_text("photos\na/photos\nb/photos\n")
    code, answer = verb("batch", str(path))
    assert code == 1
    assert [Path(each["project"]).name for each in answer["failed"]] == ["a_fieldwork", "b_fieldwork"]
    assert all("no photos" in each["error"] for each in answer["failed"])
    code, answer = verb("batch", str(path), "--dry-run")
    assert (code, answer["captures"]) == (0, 2)
