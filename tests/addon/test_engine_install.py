"""The installer, with packages made here: offline, broken off, cancelled, refused."""

from __future__ import annotations

import json
import sys
import threading
import time
import tomllib
import zipfile
from pathlib import Path

import pytest
from fieldwork.addon import engine_install as module
from fieldwork.addon.engine_install import InstallCancelled, InstallError, Options, install

ROOT = Path(__file__).resolve().parents[2]


def make_wheel(folder: Path, name: str = "tiny", version: str = "1.0") -> Path:
    """A package of one line."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}-{version}-py3-none-any.whl"
    info = f"{name}-{version}.dist-info"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr(f"{name}.py", "answer = 42\n")
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", f"{name}.py,,\n{info}/METADATA,,\n{info}/WHEEL,,\n{info}/RECORD,,\n")
    return path


@pytest.fixture
def options(tmp_path, monkeypatch):
    monkeypatch.delenv(module.ENVIRONMENT, raising=False)
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    return Options(
        folder=tmp_path / "ein Ordner" / "engine",
        base=Path(sys.executable),
        device="cpu",
        wheels=str(tmp_path / "wheels"),
        online=False,
    )


@pytest.fixture
def lock(tmp_path):
    path = tmp_path / "tiny.lock"
    path.write_text("# a comment\ntiny==1.0\n")
    return path


@pytest.fixture
def content_doctor(monkeypatch):
    monkeypatch.setattr(module, "_find_uv", lambda options, run: None)
    found = {"ok": True, "device": "cpu", "torch": "0"}
    monkeypatch.setattr(module, "_doctor", lambda python, folder: found)
    return found


def go(options, lock, cancelled=None):
    said = []
    result = install(
        options, lambda fraction, text: said.append((fraction, text)), cancelled or threading.Event(), lock
    )
    fractions = [fraction for fraction, _ in said]
    assert fractions == sorted(fractions)
    return result


def test_offline_install_makes_an_environment_of_its_own(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    before = set(Path(sys.prefix).rglob("tiny*"))
    go(options, lock)
    python = module.python_in(options.folder / "venv")
    run = module.subprocess.run([python, "-c", "import tiny; print(tiny.answer)"], capture_output=True, check=True)
    assert run.stdout.strip() == b"42"
    assert set(Path(sys.prefix).rglob("tiny*")) == before, "the base Python was touched"
    assert module.find_python("", options.folder, tmp_path) == python
    assert module.installed(options.folder)["doctor"]["device"] == "cpu"
    assert "tiny" in (options.folder / module.LOG).read_text()
    module.remove(options.folder)
    assert module.installed(options.folder) is None
    assert module.find_python("", options.folder, tmp_path) is None
    assert not (options.folder / "venv").exists()


def test_broken_package_says_so_and_the_next_try_goes_on(options, lock, tmp_path, content_doctor):
    broken = make_wheel(tmp_path / "wheels")
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InstallError, match="Press Install again"):
        go(options, lock)
    assert module.installed(options.folder) is None
    marker = options.folder / "venv" / "marker"
    marker.touch()
    broken.write_bytes(whole)
    go(options, lock)
    assert marker.exists(), "the environment was kept"
    assert module.installed(options.folder)


def test_engine_that_does_not_run_is_not_installed(options, lock, tmp_path):
    # All of it: no `uv` can be had offline, so pip does the work; then the engine lacks its packages.
    make_wheel(tmp_path / "wheels")
    with pytest.raises(InstallError, match="does not run"):
        go(options, lock)
    assert module.installed(options.folder) is None


def test_unexpected_device_is_refused(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    with pytest.raises(InstallError, match="runs on cpu, not on cuda"):
        go(Options(**{**vars(options), "device": "cuda"}), lock)


def test_doctor_with_problems_is_refused(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    content_doctor.update(ok=False, problems=["Warp computes wrongly."])
    with pytest.raises(InstallError, match="Warp computes wrongly"):
        go(options, lock)


def test_cancel_ends_the_running_tool(options, lock, tmp_path):
    slow = tmp_path / "python"
    slow.write_text("#!/bin/sh\nsleep 60\n")
    slow.chmod(0o755)
    cancelled = threading.Event()
    threading.Timer(0.5, cancelled.set).start()
    begin = time.monotonic()
    with pytest.raises(InstallCancelled):
        go(Options(**{**vars(options), "base": slow}), lock, cancelled)
    assert time.monotonic() - begin < 3.0


@pytest.mark.parametrize(("version", "reason"), [("3 9 64", "3.11 or newer"), ("3 12 32", "64 bits")])
def test_unsuitable_base_python_is_refused(options, lock, tmp_path, version, reason):
    old = tmp_path / "python"
    old.write_text(f"#!/bin/sh\necho {version}\n")
    old.chmod(0o755)
    with pytest.raises(InstallError, match=reason):
        go(Options(**{**vars(options), "base": old}), lock)


def test_full_disk_is_told_before_anything_is_loaded(options, lock, monkeypatch):
    monkeypatch.setitem(module.NEEDED_GB, "cpu", 1e9)
    with pytest.raises(InstallError, match="Free some space"):
        go(options, lock)


def test_background_installer_ends_with_its_error(options, monkeypatch):
    def fail(*_):
        raise InstallError("No.")

    monkeypatch.setattr(module, "install", fail)
    thread = module.Installer(options)
    thread.start()
    thread.join(10)
    assert thread.error == "No."


def test_choice_of_the_python(options, tmp_path, monkeypatch):
    checkout = tmp_path / "checkout"
    python = module.python_in(checkout / ".venv")
    python.parent.mkdir(parents=True)
    python.touch()
    assert module.find_python("", options.folder, checkout) == python
    assert module.find_python(str(checkout / ".venv"), options.folder, checkout) == python
    monkeypatch.setenv(module.ENVIRONMENT, "/x/python")
    assert module.find_python("/y", options.folder, checkout) == Path("/x/python")


def test_lock_serves_what_the_project_needs():
    from packaging.requirements import Requirement

    wanted = [
        Requirement(text) for text in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    ]
    lines = [line for line in module.LOCK.read_text().splitlines() if line and not line.startswith("#")]
    locked = [Requirement(line) for line in lines]
    for python in ("3.11", "3.13", "3.14"):
        for system in ("linux", "win32", "darwin"):
            environment = {"python_full_version": f"{python}.0", "python_version": python, "sys_platform": system}
            chosen = {r.name.lower(): r for r in locked if r.marker is None or r.marker.evaluate(environment)}
            for requirement in wanted:
                (version,) = chosen[requirement.name.lower()].specifier
                assert requirement.specifier.contains(version.version), requirement


def test_state_of_a_half_installed_engine(options):
    options.folder.mkdir(parents=True)
    (options.folder / module.COMPLETE).write_text(json.dumps({"lock": "x"}))
    assert module.installed(options.folder) is None, "the environment is gone"
    (options.folder / module.COMPLETE).write_text("{")
    assert module.installed(options.folder) is None
