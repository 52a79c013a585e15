"""The manifest is valid, and the zip holds what runs and nothing else."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from fieldwork import nerfcore

ROOT = Path(nerfcore.__file__).parents[1]


@pytest.fixture(scope="module")
def tool() -> list[str]:
    """Blender's own program for extension packages."""
    spec = find_spec("bpy")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("needs the bpy package")
    place = Path(next(iter(spec.submodule_search_locations)))
    return [sys.executable, str(next(place.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")))]


def run(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def archive(tool, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    run([*tool, "build", "--source-dir", str(ROOT), "--output-dir", str(out)])
    (built,) = out.iterdir()
    return built


def test_manifest_is_valid_and_agrees_with_the_package(tool):
    assert "rror" not in run([*tool, "validate", str(ROOT)])
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert manifest["version"] == project["version"] == nerfcore.__version__
    assert len(manifest["tagline"]) <= 64
    assert "blender" not in manifest["name"].lower()
    assert all(len(reason) <= 64 for reason in manifest["permissions"].values())


def test_the_zip_is_valid_and_holds_all_sources(tool, archive):
    assert "rror" not in run([*tool, "validate", str(archive)])
    names = set(zipfile.ZipFile(archive).namelist())
    folders = ("addon", "operators", "panels", "nerfcore")
    sources = {p.relative_to(ROOT).as_posix() for folder in folders for p in (ROOT / folder).rglob("*.py")}
    assert sources <= names
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "pyproject.toml"} <= names
    presets = {p.relative_to(ROOT).as_posix() for p in (ROOT / "nerfcore").rglob("*.json")}
    assert presets <= names


def test_the_zip_is_small_and_holds_nothing_that_does_not_run(archive):
    assert archive.stat().st_size < 2 * 2**20
    allowed = ("addon/", "operators/", "panels/", "nerfcore/")
    loose = {"__init__.py", "blender_manifest.toml", "LICENSE", "README.md", "pyproject.toml"}
    for name in zipfile.ZipFile(archive).namelist():
        assert name.startswith(allowed) or name in loose, f"{name} does not belong into the extension"
        assert "__pycache__" not in name


def test_the_zipped_sources_stand_alone(archive, tmp_path):
    """The engine's Python runs `nerfcore` from the installed extension, whatever its folder is called."""
    zipfile.ZipFile(archive).extractall(tmp_path / "ext")
    code = "import nerfcore.verbs as v, nerfcore.blender.process as b; print(len(v.VERBS), b.CHILD)"
    done = subprocess.run(
        [sys.executable, "-s", "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "ext"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    count, child = done.stdout.split()
    assert int(count) >= 12
    assert Path(child) == tmp_path / "ext/addon/child/main.py"
    assert Path(child).is_file()


REMOTE = """
bpy.context.preferences.system.use_online_access = True  # the operator asks for it, though the address is a file
repo = bpy.context.preferences.extensions.repos.new(name="Fieldwork", module="fieldwork_site", remote_url=url)
bpy.ops.extensions.repo_sync(repo_index=list(bpy.context.preferences.extensions.repos).index(repo))
bpy.ops.extensions.package_install(
    repo_index=list(bpy.context.preferences.extensions.repos).index(repo), pkg_id="fieldwork", enable_on_install=True
)
answer({"enabled": "bl_ext.fieldwork_site.fieldwork" in bpy.context.preferences.addons,
        "operators": len(dir(bpy.ops.fieldwork))})
"""


def test_blender_installs_from_the_static_repository(tool, tmp_path, bpy_script, monkeypatch):
    script = Path(__file__).with_name("make_repository.py")
    run([sys.executable, str(script), str(tmp_path / "site")])
    assert {p.suffix for p in (tmp_path / "site").iterdir()} == {".zip", ".json", ".html"}
    monkeypatch.setenv("BLENDER_USER_RESOURCES", str(tmp_path / "user"))
    facts = bpy_script(REMOTE, url=(tmp_path / "site/index.json").as_uri())
    assert facts["enabled"]
    assert facts["operators"] > 10
