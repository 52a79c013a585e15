"""The installer, with packages made here: offline, broken off, cancelled, refused."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import threading
import time
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from fieldwork.addon.engine import install as module
from fieldwork.addon.engine import place, tools
from fieldwork.addon.engine.install import InstallCancelled, InstallError, Options, install
from fieldwork.addon.engine.link import Link

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


@pytest.fixture(scope="module")
def copying_python(tmp_path_factory):
    """A Python that copies an environment instead of making one, which takes seconds every time."""
    if sys.platform == "win32":
        return Path(sys.executable)
    folder = tmp_path_factory.mktemp("python")
    subprocess.run([sys.executable, "-m", "venv", folder / "made"], check=True)
    script = folder / "python"
    script.write_text(
        f'#!/bin/sh\n[ "$1 $2" = "-m venv" ] && exec cp -a "{folder}/made" "$3"\nexec "{sys.executable}" "$@"\n'
    )
    script.chmod(0o755)
    return script


@pytest.fixture
def options(tmp_path, monkeypatch, copying_python):
    monkeypatch.delenv(place.ENVIRONMENT, raising=False)
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    return Options(
        folder=tmp_path / "ein Ordner" / "engine",
        base=copying_python,
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
    go(Options(**{**vars(options), "base": Path(sys.executable)}), lock)
    python = module.python_in(options.folder / "venv")
    run = subprocess.run([python, "-c", "import tiny; print(tiny.answer)"], capture_output=True, check=True)
    assert run.stdout.strip() == b"42"
    assert set(Path(sys.prefix).rglob("tiny*")) == before, "the base Python was touched"
    assert place.find_python("", options.folder, tmp_path) == python
    assert place.installed(options.folder)["doctor"]["device"] == "cpu"
    assert "tiny" in (options.folder / module.LOG).read_text()
    module.remove(options.folder)
    assert place.installed(options.folder) is None
    assert place.find_python("", options.folder, tmp_path) is None
    assert not (options.folder / "venv").exists()


@pytest.mark.usefixtures("each_file_system")
def test_broken_package_says_so_and_the_next_try_goes_on(options, lock, tmp_path, content_doctor):
    broken = make_wheel(tmp_path / "wheels")
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InstallError, match="Press Install again"):
        go(options, lock)
    assert place.installed(options.folder) is None
    marker = options.folder / "venv" / "marker"
    marker.touch()
    broken.write_bytes(whole)
    go(options, lock)
    assert marker.exists(), "the environment was kept"
    assert place.installed(options.folder)


def test_what_cannot_be_removed_is_told(tmp_path, monkeypatch):
    (tmp_path / "venv").mkdir()
    monkeypatch.setattr(module.shutil, "rmtree", lambda *_, **how: None)  # as Windows does while a program in it runs
    with pytest.raises(InstallError, match="venv is in use"):
        module.remove(tmp_path)


def test_habits_of_the_user_do_not_keep_packages_out_of_the_environment(
    options, lock, tmp_path, content_doctor, monkeypatch
):
    make_wheel(tmp_path / "wheels")
    settings = tmp_path / "pip.conf"
    settings.write_text("[install]\nuser = true\n")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(settings))
    go(options, lock)
    assert place.installed(options.folder)


@pytest.mark.parametrize(
    "said",
    [
        "WARNING: Retrying (Retry(total=0, connect=None)) after connection broken by 'NewConnectionError'\n"
        "ERROR: Could not find a version that satisfies the requirement tiny==1.0 (from versions: none)",
        "error: Request failed after 3 retries\n  Caused by: error sending request for url (https://pypi.org/simple/)",
    ],
    ids=["pip", "uv"],
)
def test_a_missing_network_is_told_as_such(tmp_path, said):
    with open(tmp_path / "log", "w") as log:
        run = tools.Runner(log, threading.Event(), lambda *_: None)
        with pytest.raises(InstallError, match=r"cannot be reached: check the network.* HTTPS_PROXY"):
            run([sys.executable, "-c", f"print({said!r}); exit(1)"], "The packages could not be installed")


@pytest.mark.parametrize("other", ["base", "device"])
def test_a_next_try_with_other_options_has_an_environment_of_its_own(
    options, lock, tmp_path, content_doctor, monkeypatch, other
):
    wheel = make_wheel(tmp_path / "wheels")
    wheel.rename(wheel.with_suffix(".away"))
    monkeypatch.setattr(module, "_check_disk", lambda options: None)
    with pytest.raises(InstallError, match="Press Install again"):
        go(options, lock)
    marker = options.folder / "venv" / "marker"
    marker.touch()
    wheel.with_suffix(".away").rename(wheel)
    base = tmp_path / "another python"
    base.symlink_to(options.base)
    content_doctor["device"] = "cuda"
    go(dataclasses.replace(options, **({"base": base} if other == "base" else {"device": "cuda"})), lock)
    assert not marker.exists()


def test_a_next_try_goes_on_only_in_an_environment_that_was_made_whole(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    base = tmp_path / "python"
    base.write_text(
        f'#!/bin/sh\n[ "$1 $2" = "-m venv" ] && mkdir -p "$3/bin" && touch "$3/bin/python" && exit 1\n'
        f'exec "{options.base}" "$@"\n'
    )  # as a kill leaves it, without its packages
    base.chmod(0o755)
    with pytest.raises(InstallError, match="environment cannot be made"):
        go(dataclasses.replace(options, base=base), lock)
    base.write_text(f'#!/bin/sh\nexec "{options.base}" "$@"\n')
    go(dataclasses.replace(options, base=base), lock)
    assert place.installed(options.folder)


def test_a_doctor_that_was_not_content_has_an_empty_environment_next_time(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    content_doctor.update(ok=False, problems=["tiny 1.0 does not load."])
    with pytest.raises(InstallError, match="does not load"):
        go(options, lock)
    marker = options.folder / "venv" / "marker"
    marker.touch()
    content_doctor.update(ok=True)
    go(options, lock)
    assert not marker.exists()


def test_engine_that_does_not_run_is_not_installed(options, lock, tmp_path):
    # All of it: no `uv` can be had offline, so pip does the work; then the engine lacks its packages.
    make_wheel(tmp_path / "wheels")
    with pytest.raises(InstallError, match="does not run"):
        go(Options(**{**vars(options), "base": Path(sys.executable)}), lock)
    assert place.installed(options.folder) is None


def test_unexpected_device_is_refused(options, lock, tmp_path, content_doctor, monkeypatch):
    make_wheel(tmp_path / "wheels")
    monkeypatch.setattr(module.shutil, "disk_usage", lambda folder: SimpleNamespace(free=100e9))
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


def test_what_a_base_python_says_before_its_version_does_not_matter(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\necho "Could not find platform libraries" >&2\nexec "{options.base}" "$@"\n')
    script.chmod(0o755)
    go(Options(**{**vars(options), "base": script}), lock)
    script.write_text("#!/bin/sh\necho Blender 5.0\n")
    with pytest.raises(InstallError, match="is not a Python"):
        go(Options(**{**vars(options), "base": script}), lock)


def test_debian_s_python_without_venv_is_told_as_such(options, lock, tmp_path, content_doctor):
    said = (
        "The virtual environment was not created successfully because ensurepip is not\n"
        "available.  On Debian/Ubuntu systems, you need to install the python3-venv\n"
        "package using the following command.\n\n    apt install python3.14-venv\n\n"
        "You may need to use sudo with that command.\n\nFailing command: /x/bin/python3\n"
    )
    script = tmp_path / "python"
    (tmp_path / "said").write_text(said)
    script.write_text(f'#!/bin/sh\n[ "$2" = venv ] && cat "{tmp_path}/said" && exit 1\nexec "{options.base}" "$@"\n')
    script.chmod(0o755)
    with pytest.raises(InstallError, match=r"lacks the package python3\.14-venv"):
        go(Options(**{**vars(options), "base": script}), lock)


def test_an_intel_mac_is_told(options, lock, tmp_path, monkeypatch):
    intel = tmp_path / "python"
    intel.write_text("#!/bin/sh\necho 3 12 64 x86_64\n")
    intel.chmod(0o755)
    monkeypatch.setattr(module.sys, "platform", "darwin")
    with pytest.raises(InstallError, match="Macs with Intel processors"):
        go(Options(**{**vars(options), "base": intel}), lock)


def test_tools_on_windows_have_no_window_and_end_with_their_children(tmp_path, monkeypatch):
    started, ended = [], []

    def popen(words, **how):
        started.append(how)
        raise OSError("there is no such tool")

    monkeypatch.setattr(tools.sys, "platform", "win32")
    monkeypatch.setattr(tools.subprocess, "CREATE_NO_WINDOW", 8, raising=False)
    monkeypatch.setattr(tools.subprocess, "Popen", popen)
    monkeypatch.setattr(tools.subprocess, "run", lambda words, **how: ended.append((words, how["creationflags"])))
    with open(tmp_path / "log", "w") as log, pytest.raises(InstallError, match="no such tool"):
        tools.Runner(log, threading.Event(), lambda *_: None)(["tool"], "It failed")
    tools._kill_tree(SimpleNamespace(pid=7))
    assert started[0]["creationflags"] == 8
    assert ended == [(["taskkill", "/F", "/T", "/PID", "7"], 8)]


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
    monkeypatch.setattr(module, "install", lambda *_: int("word"))
    thread = module.Installer(options)
    thread.start()
    thread.join(10)
    assert "invalid literal" in thread.error


def test_choice_of_the_python(options, tmp_path, monkeypatch):
    checkout = tmp_path / "checkout"
    python = module.python_in(checkout / ".venv")
    python.parent.mkdir(parents=True)
    python.touch()
    assert place.find_python("", options.folder, checkout) == python
    assert place.find_python(str(checkout / ".venv"), options.folder, checkout) == python
    monkeypatch.setenv(place.ENVIRONMENT, "/x/python")
    assert place.find_python("/y", options.folder, checkout) == Path("/x/python")


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


SYSTEMS = ["linux", "win32", "darwin"]


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("device", ["auto", "cpu", "cuda", "rocm", "mps"])
def test_each_device_gets_its_build_of_pytorch_or_a_sentence(options, lock, monkeypatch, system, device):
    """What uv is told; it knows the places of the builds."""
    monkeypatch.setattr(module.sys, "platform", system)
    chosen = Options(**{**vars(options), "device": device, "wheels": "", "online": True})
    exists = {"cuda": {"linux", "win32"}, "rocm": {"linux"}, "mps": {"darwin"}}.get(device, set(SYSTEMS))
    if system not in exists:
        with pytest.raises(InstallError, match="Choose “Automatic”"):
            module._check_device(device)
        return
    module._check_device(device)
    command = [str(word) for word in module._install_command(chosen, Path("uv"), lock, options.folder / "venv")]
    backend = command[command.index("--torch-backend") + 1] if "--torch-backend" in command else None
    assert backend == {"darwin": None}.get(system, "cpu" if device == "cpu" else "auto")
    assert command[-2:] == ["-r", str(lock)], "locked versions"
    assert "--no-index" not in command
    assert command[command.index("--python") + 1] == str(module.python_in(options.folder / "venv"))


@pytest.mark.parametrize(
    ("system", "device", "amd", "nvidia", "can"),
    [
        ("linux", "cpu", False, False, True),
        ("linux", "cuda", False, True, True),
        ("linux", "auto", False, True, True),
        ("linux", "auto", True, False, False),
        ("linux", "rocm", True, False, False),
        ("win32", "cpu", False, True, True),
        ("win32", "auto", False, False, True),
        ("win32", "auto", False, True, False),
        ("win32", "cuda", False, True, False),
        ("darwin", "mps", False, False, True),
        ("darwin", "auto", False, False, True),
    ],
)
def test_without_uv_only_a_build_that_suits_is_taken(options, lock, monkeypatch, system, device, amd, nvidia, can):
    monkeypatch.setattr(module.sys, "platform", system)
    monkeypatch.setattr(module.Path, "exists", lambda path: amd if str(path) == "/dev/kfd" else False)
    monkeypatch.setattr(module.shutil, "which", lambda name: "/bin/x" if nvidia and name == "nvidia-smi" else None)
    chosen = Options(**{**vars(options), "device": device, "wheels": "", "online": True})
    if can:
        assert "pip" in module._install_command(chosen, None, lock, options.folder / "venv")
    else:
        with pytest.raises(InstallError, match="needs the installer uv"):
            module._install_command(chosen, None, lock, options.folder / "venv")


def test_wheels_on_the_disk_are_taken_as_they_are(options, lock):
    for uv in (Path("uv"), None):
        command = module._install_command(
            Options(**{**vars(options), "device": "rocm"}), uv, lock, options.folder / "venv"
        )
        assert "--torch-backend" not in command
        assert "--no-index" in command
        assert command[command.index("--find-links") + 1] == options.wheels


@pytest.mark.parametrize(("words", "own"), [("--torch-backend <B>", False), ("an old help text", True)])
def test_an_old_uv_is_not_used(options, tmp_path, monkeypatch, words, own):
    found = tmp_path / "uv"
    found.write_text(f"#!/bin/sh\necho '{words}'\n")
    found.chmod(0o755)
    monkeypatch.setattr(module.shutil, "which", lambda name: str(found))
    with open(tmp_path / "log", "w") as log:
        uv = module._find_uv(options, module.Runner(log, threading.Event(), lambda *_: None))
    # Offline there is no other to be had.
    assert uv == (None if own else found)


def test_an_uv_that_does_not_run_is_not_used(options, tmp_path, monkeypatch):
    found = tmp_path / "uv"
    found.write_text("#!/bin/sh\necho 'No version is set for command uv'\nexit 126\n")
    found.chmod(0o755)
    monkeypatch.setattr(module.shutil, "which", lambda name: str(found))
    with open(tmp_path / "log", "w+") as log:
        assert module._find_uv(options, module.Runner(log, threading.Event(), lambda *_: None)) is None
        log.seek(0)
        assert "No version is set" in log.read()


def test_state_of_a_half_installed_engine(options):
    options.folder.mkdir(parents=True)
    (options.folder / place.COMPLETE).write_text(json.dumps({"lock": "x"}))
    assert place.installed(options.folder) is None, "the environment is gone"
    (options.folder / place.COMPLETE).write_text("{")
    assert place.installed(options.folder) is None


@pytest.mark.usefixtures("each_file_system")
def test_repair_keeps_the_working_engine_until_the_new_one_runs(options, lock, tmp_path, content_doctor, monkeypatch):
    make_wheel(tmp_path / "wheels")
    go(options, lock)
    first = place.find_python("", options.folder, tmp_path)
    make_wheel(tmp_path / "wheels", "more")
    lock.write_text("tiny==1.0\nmore==1.0\n")

    def fails(python, folder):
        assert python != first, "the new one is looked at"
        assert place.find_python("", options.folder, tmp_path) == first, "the old one serves meanwhile"
        raise InstallError("The engine does not run.")

    monkeypatch.setattr(module, "_doctor", fails)
    with pytest.raises(InstallError, match="does not run"):
        go(options, lock)
    assert place.find_python("", options.folder, tmp_path) == first
    assert not place.up_to_date(options.folder)
    subprocess.run([first, "-c", "import tiny"], check=True)
    monkeypatch.setattr(module, "_doctor", lambda python, folder: content_doctor)
    go(options, lock)
    second = place.find_python("", options.folder, tmp_path)
    assert second != first
    assert not first.exists(), "the old one is gone"
    subprocess.run([second, "-c", "import tiny, more"], check=True)
    assert not [path for path in options.folder.iterdir() if "old" in path.name or path.name == place.STAGING]


@pytest.mark.usefixtures("each_file_system")
def test_a_repair_begins_with_an_empty_environment(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    go(options, lock)
    left = options.folder / place.ENVIRONMENTS[1]
    python = module.python_in(left)
    python.parent.mkdir(parents=True)
    python.write_text("what could not be removed the last time")
    go(options, lock)
    subprocess.run([python, "-c", "import tiny"], check=True)


HOLDS = """
import sys, time
from pathlib import Path
from fieldwork.addon.engine.only_one import only_one
with only_one(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_one_installation_at_a_time(options, lock, tmp_path, content_doctor):
    make_wheel(tmp_path / "wheels")
    command = [sys.executable, "-c", HOLDS, options.folder]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout.readline().strip() == b"held"
            for change in (lambda: go(options, lock), lambda: module.remove(options.folder)):
                with pytest.raises(InstallError, match="Another Blender"):
                    change()
        finally:
            other.kill()
    go(options, lock)
    assert place.installed(options.folder)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows removes nothing in which a program runs")
def test_what_an_engine_runs_on_is_not_removed(options, lock, tmp_path, content_doctor):
    """Also not where the Blender that started it is gone; a repair leaves it in its place until the next one."""
    make_wheel(tmp_path / "wheels")
    go(options, lock)
    first, second = (options.folder / name for name in place.ENVIRONMENTS)
    engine = Link(module.python_in(first), tmp_path / "log", [sys.executable, "-c", "import sys; sys.stdin.read()"])
    engine.start()
    try:
        with pytest.raises(InstallError, match="runs for another Blender"):
            module.remove(options.folder)
        assert place.installed(options.folder)
        go(options, lock)
        assert place.environment(options.folder) == second
        subprocess.run([module.python_in(first), "-c", "import tiny"], check=True)
        with pytest.raises(InstallError, match="press Repair again"):
            go(options, lock)
    finally:
        engine.close()
    go(options, lock)
    assert place.environment(options.folder) == first
    assert not second.exists()
    module.remove(options.folder)
    assert not first.exists()


def test_an_engine_installed_before_there_were_two_places_is_found(options):
    python = module.python_in(options.folder / "venv")
    python.parent.mkdir(parents=True)
    python.touch()
    (options.folder / place.COMPLETE).write_text(json.dumps({"lock": "x"}))
    assert place.environment(options.folder) == options.folder / "venv"
    assert place.next_environment(options.folder) == options.folder / "venv-2"
