"""One writer at a time on a project, whichever door it came through; and what a failed verb leaves of a new one."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import InputError, ProjectError
from fieldwork.nerfcore.params import ImportParams, NewParams, PosesParams, ReconstructParams
from fieldwork.nerfcore.project.lock import lockable, project_lock
from fieldwork.nerfcore.project.schema import Project
from fieldwork.nerfcore.project.store import save_project
from PIL import Image

pytestmark = pytest.mark.usefixtures("each_file_system")

ROOT = Path(__file__).resolve().parents[2]
HOLD = (
    "import sys; from pathlib import Path; from nerfcore.project.lock import project_lock\n"
    "with project_lock(Path(sys.argv[1]), 'train'):\n"
    "    print('held', flush=True); sys.stdin.read()\n"
)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    save_project(tmp_path / "p", Project())
    return tmp_path / "p"


def holder(project: Path) -> subprocess.Popen[str]:
    """Another process that holds the project, as an engine does."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(project)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.parametrize("verb", ["poses", "align", "train", "evaluate", "mesh"])
def test_command_line_waits_for_nobody(project: Path, verb: str, capfd: pytest.CaptureFixture[str]) -> None:
    """The second writer gets a sentence that names the first one, and exit code 1."""
    other = holder(project)
    before = (project / "project.json").read_bytes()
    try:
        assert main([verb, str(project), "--json"]) == 1
    finally:
        other.communicate("")
    error = json.loads(capfd.readouterr().out)["error"]
    assert error["code"] == "project"
    assert f"is being worked on by train (process {other.pid})" in error["message"]
    assert (project / "project.json").read_bytes() == before
    # With the first one gone the same command comes as far as the project allows.
    assert main([verb, str(project), "--json"]) == 1
    assert "worked on" not in json.loads(capfd.readouterr().out)["error"]["message"]


def test_reconstruct_locks_its_project_once(project: Path, tmp_path: Path) -> None:
    params = ReconstructParams(photos=tmp_path / "photos", out=project)
    other = holder(project)
    try:
        with pytest.raises(ProjectError, match="worked on"), project_lock(lockable(params), "reconstruct"):
            pass
    finally:
        other.communicate("")


def test_a_killed_holder_lets_go(project: Path) -> None:
    other = holder(project)
    other.send_signal(signal.SIGKILL)
    other.wait()
    with project_lock(project, "poses"):
        assert (project / "jobs" / "engine.lock.owner").read_text() == f"poses (process {os.getpid()})"
    assert not (project / "jobs" / "engine.lock.owner").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="locks files in another way")
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.EIO, errno.ESTALE])
def test_a_folder_without_locks_or_that_is_gone_is_named(project: Path, number: int) -> None:
    code = (
        "import fcntl, os, sys\n"
        "def refused(*_): raise OSError(int(sys.argv[1]), os.strerror(int(sys.argv[1])))\n"
        "fcntl.flock = refused\n"
        "from nerfcore.cli import main\n"
        "sys.exit(main(['poses', sys.argv[2], '--json']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(number), str(project)],
        capture_output=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    error = json.loads(done.stdout)["error"]
    assert error["code"] == "disk"
    assert str(project / "jobs") in error["message"]


def test_a_disk_that_takes_no_changes_hides_nothing(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remove = Path.unlink

    def refused(path: Path, missing_ok: bool = False) -> None:
        if path.name == "engine.lock.owner":
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        remove(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refused)
    with pytest.raises(InputError, match="no photo"), project_lock(project, "poses"):
        raise InputError("It is no photo.")
    with project_lock(project, "poses"):
        pass


@pytest.mark.parametrize("photos", ["missing", "empty", "bad"])
def test_failed_new_leaves_nothing(tmp_path: Path, photos: str, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.jpg").write_bytes(b"no photo")
    assert main(["new", str(tmp_path / "deep" / "p"), "--photos", str(tmp_path / photos), "--json"]) == 1
    assert json.loads(capfd.readouterr().out)["error"]["code"] == "input"
    assert not (tmp_path / "deep").exists()
    # A folder that was there stays, as it was.
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "notes.txt").write_text("mine")
    assert main(["new", str(tmp_path / "own"), "--photos", str(tmp_path / photos), "--json"]) == 1
    assert [path.name for path in (tmp_path / "own").iterdir()] == ["notes.txt"]


def test_failed_new_keeps_what_can_go_on(tmp_path: Path) -> None:
    """Working copies that were finished are not thrown away."""

    def fails() -> None:
        with project_lock(tmp_path / "p", "new"):
            (tmp_path / "p" / "images").mkdir()
            raise InputError("something later")

    with pytest.raises(InputError):
        fails()
    assert (tmp_path / "p" / "images").is_dir()
    assert (tmp_path / "p" / "jobs" / "engine.lock").is_file()


def test_failed_new_leaves_an_existing_project_alone(project: Path, tmp_path: Path) -> None:
    assert main(["new", str(project), "--photos", str(tmp_path / "missing"), "--add", "--json"]) == 1
    assert (project / "project.json").is_file()


def test_a_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "holiday.png")
    assert main(["poses", str(tmp_path), "--json"]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.png"]


def test_which_verbs_lock_what(project: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    assert lockable(NewParams(project=new, photos=tmp_path)) == new
    assert lockable(ImportParams(dataset=tmp_path, project=new)) == new
    assert lockable(ReconstructParams(photos=tmp_path, out=new)) == new
    assert lockable(PosesParams(project=new)) is None
    assert lockable(PosesParams(project=project)) == project
