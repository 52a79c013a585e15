"""Atomic writes: the old file survives whatever goes wrong."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from fieldwork.nerfcore import files
from fieldwork.nerfcore.errors import DiskError
from fieldwork.nerfcore.files import atomic_path, require_writable, staged, write_json, write_section, write_text

pytestmark = pytest.mark.usefixtures("each_file_system")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 kB."""
    folder = tmp_path / "small disk ü"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command here")
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_numbers_that_json_has_not_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1}
    assert os.listdir(tmp_path) == ["a.json"]


def test_replaces_and_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "Übung 1" / "a.json"
    write_json(path, {"a": 1})
    write_json(path, {"ä": 2})
    assert path.read_text(encoding="utf-8") == '{\n "ä": 2\n}\n'
    assert os.listdir(path.parent) == ["a.json"]


def test_failure_inside_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_full_disk_keeps_the_old_file(small_disk: Path) -> None:
    path = small_disk / "a.txt"
    write_text(path, "old")
    with pytest.raises(DiskError, match="No space left"):
        write_text(path, "x" * 1_000_000)
    assert path.read_text() == "old"
    assert os.listdir(small_disk) == ["a.txt"]
    write_text(path, "new")  # and there is room again
    assert path.read_text() == "new"


def test_read_only_folder_is_named(small_disk: Path) -> None:
    path = small_disk / "a.txt"
    write_text(path, "old")
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    try:
        with pytest.raises(DiskError, match="cannot be written") as caught:
            write_text(path, "new")
        assert str(path) in str(caught.value)
        assert path.read_text() == "old"
    finally:
        subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs Linux, whose /proc takes no files")
def test_a_folder_that_takes_no_files_is_named() -> None:
    with pytest.raises(DiskError, match=r"/proc/sub/a\.glb cannot be written: /proc takes no files"):
        require_writable(Path("/proc/sub/a.glb"))


def test_a_network_folder_that_gives_no_rights_takes_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "chmod", refused)
    write_text(tmp_path / "a.txt", "there")
    assert (tmp_path / "a.txt").read_text() == "there"


@pytest.mark.skipif(sys.platform == "win32", reason="has no such users")
def test_photos_that_may_only_be_read_are_imported() -> None:
    """As they come from the cards of some cameras. The owner of the system may write everything: somebody else tries it."""
    code = (
        "import os, random, shutil, sys, tempfile; from pathlib import Path; from nerfcore.data.copying import copy_file\n"
        "if os.geteuid() == 0: os.seteuid(65534)\n"
        "copy_file(Path(sys.argv[1]), Path(sys.argv[2]), 'a')"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(files.__file__).parents[1])}
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o777)
        source = Path(folder, "photo.jpg")
        source.write_bytes(b"a photo")
        source.chmod(0o444)
        subprocess.run([sys.executable, "-c", code, source, folder], check=True, env=environment)
        copy = Path(folder, "a.jpg")
        assert copy.read_bytes() == b"a photo"
        assert copy.stat().st_mtime_ns == source.stat().st_mtime_ns


def test_what_killed_processes_left_goes_a_day_later(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from nerfcore.files import staged\n"
        "with staged(Path(sys.argv[1])) as place:\n"
        "    (place / 'mesh.ply').write_text('half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(files.__file__).parents[1])}
    for _ in range(2):
        subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False, env=environment)
    old, new = sorted(tmp_path.iterdir())
    os.utime(old, (1.0, 1.0))
    with staged(tmp_path) as place:
        (place / "mesh.ply").write_text("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == [new.name, "mesh.ply"]


def test_keeps_the_suffix_for_image_writers(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a.exr") as temporary:
        assert temporary.suffix == ".exr"
        temporary.write_bytes(b"x")
    assert (tmp_path / "a.exr").read_bytes() == b"x"


def test_a_section_of_a_page_is_replaced_and_the_rest_is_kept(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    write_section(page, "GPU", "first")
    assert page.read_text("utf-8") == "## GPU\n\nfirst\n"
    page.write_text("# Page\n\n## GPU\n\nold\n\n### deeper\n\nold too\n\n## CPU\n\nkept \\1\n", encoding="utf-8")
    write_section(page, "GPU", "new \\1")
    assert page.read_text("utf-8") == "# Page\n\n## GPU\n\nnew \\1\n\n## CPU\n\nkept \\1\n"
