"""Pose estimation stopped, killed and out of space: what is finished is kept."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fieldwork.nerfcore.errors import Cancelled, DiskError, PosesError
from fieldwork.nerfcore.params import PosesParams
from fieldwork.nerfcore.poses import process
from fieldwork.nerfcore.poses.estimate import estimate_poses
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.captures import poses


def verified_pairs(project: Path) -> int:
    (database,) = (project / "poses" / "sfm").glob("*.db")
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as connection:
        return connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]


@pytest.mark.parametrize(
    "stage",
    [
        pytest.param("Finding features", marks=pytest.mark.slow),
        "Matching features",
        pytest.param("Placing cameras", marks=pytest.mark.slow),
    ],
)
def test_cancel_is_prompt_and_work_is_kept(unposed_fountain: Path, tmp_path: Path, stage: str) -> None:
    project = Path(shutil.copytree(unposed_fountain, tmp_path / "p"))

    class Stops(Reporter):
        asked = 0.0

        def stage(self, name: str) -> None:
            if name == stage:
                threading.Timer(0.3, self.stop).start()

        def stop(self) -> None:
            self.asked = time.monotonic()
            self.cancel()

    report = Stops()
    with pytest.raises(Cancelled):
        estimate_poses(PosesParams(project=project, preset="fast"), report)
    assert time.monotonic() - report.asked < 2
    assert not (project / "poses" / "poses.json").exists()
    pairs = verified_pairs(project)
    # A quick machine may finish matching before it hears of the cancel.
    if stage != "Matching features":
        assert pairs == (55 if stage == "Placing cameras" else 0)
    assert poses(project)["registered"] == 11


@pytest.mark.parametrize(
    "stage",
    [
        pytest.param("Finding features", marks=pytest.mark.slow),
        pytest.param("Matching features", marks=pytest.mark.slow),
        "Placing cameras",
        pytest.param("Checking poses", marks=pytest.mark.slow),
        pytest.param("Final adjustment", marks=pytest.mark.slow),
    ],
)
def test_killed_in_each_stage_then_run_again(
    unposed_fountain: Path, tmp_path: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = Path(shutil.copytree(unposed_fountain, tmp_path / "p"))
    started: list[subprocess.Popen] = []
    popen = subprocess.Popen

    def remember(*args: object, **kwargs: object) -> subprocess.Popen:
        started.append(popen(*args, **kwargs))  # type: ignore[call-overload]
        return started[-1]

    monkeypatch.setattr(process.subprocess, "Popen", remember)

    class Kills(Reporter):
        def stage(self, name: str) -> None:
            if name == stage:
                started[0].send_signal(signal.SIGKILL)

    with pytest.raises(PosesError, match="was killed"):
        estimate_poses(PosesParams(project=project, preset="fast"), Kills())
    assert poses(project)["registered"] == 11


def test_mapping_goes_on_from_a_snapshot(fountain: Path, tmp_path: Path) -> None:
    """What a killed mapping left: whole snapshots, and a newer half one that must not be touched."""
    import zlib  # noqa: F401

    import pycolmap
    from fieldwork.nerfcore.poses import mapping

    class Counts:
        messages: list[str] = []

        def stage(self, name: str) -> None: ...

        def progress(self, fraction: float, message: str = "") -> None:
            self.messages.append(message)

    (database,) = (fountain / "poses" / "sfm").glob("*.db")
    shutil.copy(database, tmp_path / "f.db")
    names = sorted(path.name for path in (fountain / "images").iterdir())
    six = pycolmap.Reconstruction(str(fountain / "poses" / "sparse"))
    six.transcribe_image_ids_to_database(pycolmap.Database.open(str(tmp_path / "f.db")))
    for image_id in sorted(six.reg_image_ids())[6:]:
        six.deregister_frame(six.image(image_id).frame_id)
    memory = tmp_path / "memory"
    for name in ("1", "2"):
        (memory / "snapshots" / name).mkdir(parents=True)
        six.write(str(memory / "snapshots" / name))
        time.sleep(0.02)
    half = memory / "snapshots" / "2" / "points3D.bin"
    half.write_bytes(half.read_bytes()[:1000])
    tell = Counts()
    models = mapping.build(tmp_path / "f.db", fountain / "images", tmp_path / "out", False, names, tell, memory=memory)
    assert models[0].num_reg_images() == 11
    assert [message.split()[0] for message in tell.messages] == ["6", "7", "8", "9", "10", "11"]
    # The outcome is remembered, and the snapshots are gone.
    tell.messages.clear()
    again = mapping.build(tmp_path / "f.db", fountain / "images", tmp_path / "out", False, names, tell, memory=memory)
    assert again[0].num_reg_images() == 11
    assert not tell.messages
    assert not (memory / "snapshots").exists()


def test_worker_ends_with_its_parent(unposed_fountain: Path, tmp_path: Path) -> None:
    project = Path(shutil.copytree(unposed_fountain, tmp_path / "p"))
    code = (
        "import sys; from pathlib import Path; from fieldwork.nerfcore.poses import process; import subprocess\n"
        "popen = subprocess.Popen\n"
        "def tell(*a, **k):\n    p = popen(*a, **k); print(p.pid, flush=True); return p\n"
        "process.subprocess.Popen = tell\n"
        "from fieldwork.nerfcore.poses.estimate import estimate_poses\n"
        "from fieldwork.nerfcore.params import PosesParams\n"
        "from fieldwork.nerfcore.progress import Reporter\n"
        f"estimate_poses(PosesParams(project=Path({str(project)!r})), Reporter())\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline and Path(f"/proc/{worker}").exists():
        state = Path(f"/proc/{worker}/stat").read_text().rsplit(")", 1)[1].split()[0]
        if state == "Z":  # ended; nobody has collected it
            break
        time.sleep(0.1)
    else:
        assert not Path(f"/proc/{worker}").exists()


def test_full_disk_while_matching(unposed_fountain: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    project = Path(shutil.copytree(unposed_fountain, disk / "p"))
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(project / "poses")]
    (project / "poses").mkdir()
    mounted = subprocess.run(command, capture_output=True, text=True, check=False) if shutil.which("mount") else None
    if mounted is None or mounted.returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        with pytest.raises(DiskError, match="No space left") as caught:
            poses(project)
        assert "run it again" in caught.value.hint
        subprocess.run(["mount", "-o", "remount,size=100m", str(project / "poses")], check=True)
        assert poses(project)["registered"] == 11
    finally:
        subprocess.run(["umount", str(project / "poses")], check=True)


def test_works_as_plain_nerfcore(fountain: Path, tmp_path: Path) -> None:
    """The engine imports the package as `nerfcore`; the worker must be found under that name too."""
    project = tmp_path / "p"
    shutil.copytree(fountain, project)
    root = Path(__file__).resolve().parents[2]
    code = (
        "from pathlib import Path; from nerfcore.verbs import run_verb; from nerfcore.params import PosesParams\n"
        "from nerfcore.progress import Reporter\n"
        f"r = run_verb('poses', PosesParams(project=Path({str(project)!r}), preset='fast', restart=True), Reporter())\n"
        "print(r['registered'])\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    assert done.stdout.strip() == "11", done.stderr
