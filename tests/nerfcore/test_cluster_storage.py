"""Files of captures between machines: an S3 server of moto, and a folder."""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.cluster import storage as module
from fieldwork.nerfcore.cluster.run import USER_FAULTS
from fieldwork.nerfcore.cluster.storage import Storage, StorageError, TakenError
from fieldwork.nerfcore.cluster.worker import Refusal
from fieldwork.nerfcore.cluster.working_copy import Copy, Saving, placed
from fieldwork.nerfcore.errors import FieldworkError, SettingError
from fieldwork.nerfcore.files import atomic_path
from fieldwork.nerfcore.params import ReconstructParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import ImageRecord, Project, SemanticClass
from fieldwork.nerfcore.project.store import edit_project, load_project, save_project
from fieldwork.nerfcore.workflows import stage_task
from fieldwork.nerfcore.workflows.campaign import plan
from fieldwork.nerfcore.workflows.captures import Capture
from fieldwork.nerfcore.workflows.reconstruct import reconstruct, stages_of
from fieldwork.nerfcore.workflows.stage_task import capture_name, run_stage, tracked_paths
from fieldwork.nerfcore.workflows.stages import STAGES
from fieldwork.tests.nerfcore.support import reconstructed as support

pytest.importorskip("fsspec", reason="the extra “cluster” is not installed")


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """Address of a bucket on a server of this process."""
    pytest.importorskip("s3fs", reason="the extra “cluster” is not installed")
    server = pytest.importorskip("moto.server", reason="moto is not installed").ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("campaigns")
        yield "s3://campaigns"
    server.stop()


@pytest.fixture(params=["s3", "folder"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "folder":
        return (tmp_path / "store").as_uri()
    return f"{request.getfixturevalue('s3')}/{tmp_path.name}"


def machine(root: Path, url: str) -> Copy:
    root.mkdir(exist_ok=True)
    return Copy(Storage(url), root, "vase-1", [root / "vase"])


def test_captures_may_lie_in_a_folder_called_jobs(tmp_path: Path) -> None:
    place = tmp_path / "one/jobs/vase"
    (place / "jobs").mkdir(parents=True)
    (place / "jobs/engine.lock").touch()
    (place / "project.json").write_text("{}")
    copy = Copy(Storage((tmp_path / "store").as_uri()), tmp_path / "one", "vase-1", [place])
    assert list(copy.storage.files("vase-1")) == []
    assert copy.upload() == 1
    assert list(copy.storage.files("vase-1")) == ["jobs/vase/project.json"]


def test_what_one_machine_uploads_the_other_fetches(tmp_path, url):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    inner = tmp_path / "one/vase/runs"
    inner.mkdir(parents=True)
    (inner / "field.bin").write_bytes(os.urandom(200_000))
    (inner / "same.bin").write_bytes((inner / "field.bin").read_bytes())
    (tmp_path / "one/vase/project.json").write_text(
        f'{{"photos": "{tmp_path}/one/vase/photos", "of": "{tmp_path}/one"}}'
    )
    (tmp_path / "one/vase/jobs").mkdir()
    (tmp_path / "one/vase/jobs/engine.lock").touch()
    assert one.changed()
    assert one.upload() == 3
    assert not one.changed()
    assert one.upload() == 0
    assert two.fetch() == 3
    assert two.fetch() == 0
    copied = tmp_path / "two/vase/runs/field.bin"
    assert copied.read_bytes() == (inner / "field.bin").read_bytes()
    assert copied.stat().st_mtime_ns == (inner / "field.bin").stat().st_mtime_ns
    assert not (tmp_path / "two/vase/jobs").exists()
    assert f"{tmp_path}/two/vase/photos" in (tmp_path / "two/vase/project.json").read_text()
    storage = Storage(url)
    assert len(storage.fs.find(f"{storage.root}/objects")) == 2, "equal contents are there once"
    # Changes, additions and removals go back.
    assert not two.changed(), "what was only fetched is not uploaded again"
    copied.write_bytes(b"better")
    (tmp_path / "two/vase/new.txt").write_text("new")
    (tmp_path / "two/vase/runs/same.bin").unlink()
    assert two.upload() == 2
    one.fetch()
    assert (inner / "field.bin").read_bytes() == b"better"
    assert (tmp_path / "one/vase/new.txt").read_text() == "new"
    assert not (inner / "same.bin").exists()


def test_only_what_is_wanted_is_fetched_and_the_rest_stays(tmp_path, url):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    for name in ("a", "b"):
        (tmp_path / f"one/vase/{name}").mkdir(parents=True)
        (tmp_path / f"one/vase/{name}/x.bin").write_bytes(name.encode())
    one.upload()
    assert two.fetch(lambda name: "/a/" in name) == 1
    (tmp_path / "two/vase/a/x.bin").write_bytes(b"changed")
    two.upload()
    assert set(Storage(url).files("vase-1")) == {"vase/a/x.bin", "vase/b/x.bin"}


def test_an_upload_that_breaks_off_leaves_the_old_state(tmp_path, url, monkeypatch):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    (tmp_path / "one/vase").mkdir()
    for name in ("x", "y"):
        (tmp_path / "one/vase" / name).write_bytes(b"old")
    one.upload()
    for name in ("x", "y"):
        (tmp_path / "one/vase" / name).write_bytes(b"newer")
    monkeypatch.setattr(Storage, "set_files", lambda *_: (_ for _ in ()).throw(StorageError("gone.")))
    with pytest.raises(StorageError):
        one.upload()
    monkeypatch.undo()
    two.fetch()
    assert {(tmp_path / "two/vase" / name).read_bytes() for name in ("x", "y")} == {b"old"}
    assert one.upload() == 2


def test_damaged_contents_and_paths_that_lead_outside_are_refused(tmp_path, url):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    (tmp_path / "one/vase").mkdir()
    (tmp_path / "one/vase/x").write_bytes(b"whole")
    one.upload()
    storage = Storage(url)
    (place,) = storage.fs.find(f"{storage.root}/objects")
    storage.fs.pipe_file(place, b"halved")
    with pytest.raises(StorageError, match="damaged contents of"):
        two.fetch()
    assert not (tmp_path / "two/vase/x").exists()
    storage.set_files("vase-1", {"../outside": ["0" * 64, 1, 1]})
    with pytest.raises(StorageError, match="outside of the campaign's folder"):
        two.fetch()


def test_another_or_an_emptied_storage_takes_no_files_away(tmp_path, url):
    """The list's folder holds the only copy of the photos."""
    photo = tmp_path / "one/vase/photo.jpg"
    photo.parent.mkdir(parents=True)
    photo.write_bytes(b"photo")
    machine(tmp_path / "one", url).upload()
    other = machine(tmp_path / "one", (tmp_path / "another store").as_uri())
    assert other.changed(), "it has nothing yet"
    other.fetch()
    assert photo.exists()
    one = machine(tmp_path / "one", url)
    one.storage.fs.rm(one.storage.root, recursive=True)
    one.fetch()
    assert photo.exists()


@pytest.mark.parametrize("lost", ["everything", "contents"])
def test_what_a_storage_has_lost_is_uploaded_again(tmp_path, url, lost):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    (tmp_path / "one/vase").mkdir()
    (tmp_path / "one/vase/photo.jpg").write_bytes(b"photo")
    one.upload()
    two.fetch()
    (tmp_path / "two/vase/field.bin").write_bytes(b"only the worker has it")
    two.upload()
    storage = one.storage
    storage.fs.rm(storage.root if lost == "everything" else f"{storage.root}/objects", recursive=True)
    one.mend(storage.objects())
    assert one.changed()
    one.upload()
    shutil.rmtree(tmp_path / "two")
    assert machine(tmp_path / "two", url).fetch() == 1
    assert (tmp_path / "two/vase/photo.jpg").read_bytes() == b"photo"


def test_files_that_a_worker_lost_stay_with_the_others(tmp_path, url):
    """Its copies lie in a temporary folder, which systems tidy up."""
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    (tmp_path / "one/vase").mkdir()
    photo = tmp_path / "one/vase/photo.jpg"
    photo.write_bytes(b"photo")
    one.upload()
    two.fetch()
    (tmp_path / "two/vase/photo.jpg").unlink()
    two.fetch(lambda name: not name.endswith(".jpg"))
    (tmp_path / "two/vase/field.bin").write_bytes(b"trained")
    two.upload()
    one.fetch()
    assert photo.exists()
    assert (tmp_path / "one/vase/field.bin").exists()


def test_what_was_changed_here_meanwhile_stays(tmp_path, url):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    (tmp_path / "one/vase").mkdir()
    for name in ("label.png", "project.json"):
        (tmp_path / "one/vase" / name).write_text("{}")
    one.upload()
    two.fetch()
    (tmp_path / "two/vase/project.json").write_text('{"from": "two"}')
    two.upload()
    (tmp_path / "one/vase/label.png").write_text("edited while the campaign ran")
    assert one.fetch(keep_changes=True) == 1
    assert (tmp_path / "one/vase/label.png").read_text() == "edited while the campaign ran"
    assert "two" in (tmp_path / "one/vase/project.json").read_text()
    assert one.changed(), "it is uploaded the next time"


def stage_begins(copy: Copy, *parts: str) -> None:
    """A stage that reads what has one of these in its path."""
    reads = lambda name: any(part in name for part in parts)  # noqa: E731
    copy.fetch(reads)
    copy.begin(reads)


def put(root: Path, name: str, contents: bytes) -> Path:
    path = root / "vase" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(contents)
    return path


def test_what_a_killed_stage_left_does_not_come_over_what_another_worker_made(tmp_path: Path, url: str) -> None:
    killed, other = machine(tmp_path / "killed", url), machine(tmp_path / "other", url)
    put(tmp_path / "other", "project.json", b"{}")
    other.upload()
    stage_begins(killed, "project", "runs/")
    put(tmp_path / "killed", "runs/field.bin", b"a checkpoint that was uploaded")
    killed.upload(databases=False)
    put(tmp_path / "killed", "runs/field.bin", b"the last one")
    put(tmp_path / "killed", "poses/sfm/database.db", b"half of it")
    stage_begins(other, "project", "runs/", "sfm/")
    for name in ("runs/field.bin", "poses/sfm/database.db"):
        put(tmp_path / "other", name, b"whole")
    other.upload()
    # It comes back, for a stage that reads neither.
    stage_begins(killed, "project")
    assert not killed.changed()
    put(tmp_path / "killed", "project.json", b'{"a": 1}')
    assert killed.upload() == 1
    other.fetch()
    for name in ("runs/field.bin", "poses/sfm/database.db"):
        assert (tmp_path / "other/vase" / name).read_bytes() == b"whole"


def test_a_worker_uploads_nothing_that_its_stage_found_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, worker, url = tmp_path / "home", tmp_path / "worker", (tmp_path / "store").as_uri()
    module_of_stages = "fieldwork.nerfcore.workflows.stage_task"
    monkeypatch.setattr(f"{module_of_stages}.work_folder", lambda _: worker)
    monkeypatch.setattr(f"{module_of_stages}.do_stage", lambda *_: {"result": None})
    params = ReconstructParams(photos=home / "photos", out=home / "vase")
    field = put(home, "runs/main/field.bin", b"whole")
    copy = Copy(Storage(url), home, capture_name(params, home), tracked_paths(params))
    copy.upload()
    put(worker, "runs/main/field.bin", b"half of it")
    values = {"capture": params.model_dump(mode="json"), "folder": str(home), "storage": url}
    run_stage({**values, "stage": "new"}, Reporter())
    copy.fetch()
    assert field.read_bytes() == b"whole"


def test_a_stage_begins_with_what_the_storage_has_and_with_a_killed_one_s_matches(tmp_path: Path, url: str) -> None:
    """Results that were made and never uploaded would be taken for those that the others have."""
    worker, home = machine(tmp_path / "worker", url), machine(tmp_path / "home", url)
    put(tmp_path / "home", "project.json", b"{}")
    home.upload()
    stage_begins(worker, "")
    left = put(tmp_path / "worker", "exports/mesh.json", b"{}")
    put(tmp_path / "worker", "poses/sfm/database.db", b"half of it")
    stage_begins(worker, "")
    assert not left.exists()
    assert worker.upload() == 1, "the matches, which this stage goes on with"
    home.fetch()
    assert (tmp_path / "home/vase/poses/sfm/database.db").read_bytes() == b"half of it"


def test_edits_of_a_project_and_what_a_worker_made_of_it_meanwhile_are_both_kept(tmp_path: Path, url: str) -> None:
    home, worker = machine(tmp_path / "home", url), machine(tmp_path / "worker", url)
    here, there = tmp_path / "home/vase", tmp_path / "worker/vase"
    stone, glass = (SemanticClass(id=k, name=name, color=(1, 0, 0)) for k, name in ((1, "stone"), (2, "glass")))
    photos = [ImageRecord(name=name) for name in "ab"]
    save_project(here, Project(classes=[stone, glass], images=photos))
    home.upload()
    worker.fetch()
    with edit_project(here) as project:
        project.classes = [stone.model_copy(update={"name": "granite"})]
        project.frame.bounds = [[0, 0, 0], [1, 1, 1]]
        project.images[0].label = "labels/a.png"
        project.record("classes", {}, {})
    with edit_project(there) as project:
        project.images[0].status = "unregistered"
        project.frame.up_confidence = 0.5
        project.record("train", {}, {"steps": 9})
    worker.upload()
    warned: list[str] = []
    home.fetch(keep_changes=True, warn=warned.append)
    both = load_project(here)
    assert [(c.id, c.name) for c in both.classes] == [(1, "granite")]
    assert both.former_class_ids == [2]
    assert (both.frame.bounds, both.frame.up_confidence) == ([[0, 0, 0], [1, 1, 1]], 0.5)
    assert [(i.name, i.label, i.status) for i in both.images] == [
        ("a", "labels/a.png", "unregistered"),
        ("b", None, "ok"),
    ]
    assert {step.verb for step in both.provenance} == {"classes", "train"}
    assert warned == []
    assert home.upload() == 1, "the next campaign begins with it"
    worker.fetch()
    assert load_project(there) == both


def test_an_alignment_of_poses_that_a_worker_made_anew_is_told(tmp_path: Path) -> None:
    url = (tmp_path / "store").as_uri()
    home, worker = machine(tmp_path / "home", url), machine(tmp_path / "worker", url)
    save_project(tmp_path / "home/vase", Project())
    home.upload()
    worker.fetch()
    for place, scale in (("home", 2.0), ("worker", 3.0)):
        with edit_project(tmp_path / place / "vase") as project:
            project.frame.world_from_sfm = np.diag([scale] * 3 + [1]).tolist()
    worker.upload()
    warned: list[str] = []
    home.fetch(keep_changes=True, warn=warned.append)
    assert load_project(tmp_path / "home/vase").frame.world_from_sfm[0][0] == 3
    assert "Align it again" in warned[0]


def test_a_file_that_was_changed_here_and_by_a_worker_stays_and_is_told(tmp_path: Path, url: str) -> None:
    home, worker = machine(tmp_path / "home", url), machine(tmp_path / "worker", url)
    for name in ("label.png", "old.png", "same.png"):
        put(tmp_path / "home", name, b"first")
    home.upload()
    worker.fetch()
    for name in ("label.png", "new.png"):
        put(tmp_path / "worker", name, b"by the worker")
    put(tmp_path / "worker", "same.png", b"alike")
    (tmp_path / "worker/vase/old.png").unlink()
    worker.upload()
    mine = [put(tmp_path / "home", name, b"drawn") for name in ("label.png", "new.png", "old.png")]
    put(tmp_path / "home", "same.png", b"alike")
    warned: list[str] = []
    home.fetch(keep_changes=True, warn=warned.append)
    assert {path.read_bytes() for path in mine} == {b"drawn"}
    assert sorted(text.split(" was changed here and by a worker")[0] for text in warned) == sorted(map(str, mine))
    home.upload()
    worker.fetch()
    assert {(tmp_path / "worker/vase" / path.name).read_bytes() for path in mine} == {b"drawn"}


def test_a_worker_that_was_given_up_uploads_nothing_over_the_one_that_went_on(tmp_path: Path, url: str) -> None:
    first, second = machine(tmp_path / "first", url), machine(tmp_path / "second", url)
    first.take()
    put(tmp_path / "first", "field.bin", b"half")
    first.upload()
    second.take()
    second.fetch()
    put(tmp_path / "second", "field.bin", b"whole")
    second.upload()
    put(tmp_path / "first", "field.bin", b"two thirds")
    with pytest.raises(TakenError, match="Another worker has gone on with vase-1"):
        first.upload()
    assert TakenError.code in USER_FAULTS, "or it is tried again, and takes it back"
    third = machine(tmp_path / "third", url)
    third.fetch()
    assert (tmp_path / "third/vase/field.bin").read_bytes() == b"whole"


def test_an_attempt_that_was_given_up_before_it_had_begun_does_not_take_its_capture_back(
    tmp_path: Path, url: str
) -> None:
    machine(tmp_path / "head", url).take("first")
    late, second, other = (machine(tmp_path / name, url) for name in ("late", "second", "other"))
    second.take("first", attempt=2)
    put(tmp_path / "second", "field.bin", b"whole")
    with pytest.raises(TakenError, match="Another worker has gone on with vase-1"):
        late.take("first", attempt=1)
    assert second.upload() == 1
    second.take("first", attempt=3)  # of the next stage
    machine(tmp_path / "head", url).take("second")  # another campaign
    with pytest.raises(TakenError):
        late.take("first", attempt=4)
    with pytest.raises(TakenError):
        second.upload()
    other.take("second", attempt=1)


def test_a_stage_whose_capture_another_worker_took_ends_without_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one takes it while the first one's contents are on their way."""
    url = (tmp_path / "store").as_uri()
    monkeypatch.setenv("FIELDWORK_WORK", str(tmp_path / "work"))
    folder = tmp_path / "campaign"
    capture = ReconstructParams(photos=folder / "photos", out=folder / "vase")

    def made(values: dict[str, Any], _: Reporter) -> dict[str, Any]:
        put(Path(values["folder"]), "late.bin", b"late")
        machine(tmp_path / "other", url).storage.set_holder(capture_name(capture, folder), "somebody else")
        return {}

    monkeypatch.setattr(stage_task, "do_stage", made)
    values = {"capture": capture.model_dump(mode="json"), "stage": "train", "folder": str(folder), "storage": url}
    with pytest.raises(StorageError, match="Another worker has gone on"):
        run_stage(values, Reporter())
    assert Storage(url).files(capture_name(capture, folder)) == {}


def test_files_are_uploaded_from_a_disk_without_hard_links(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    one = machine(tmp_path / "one", (tmp_path / "store").as_uri())
    (tmp_path / "one/vase/.fieldwork-new-x7").mkdir(parents=True)
    (tmp_path / "one/vase/photo.jpg").write_bytes(b"photo")
    (tmp_path / "one/vase/.fieldwork-new-x7/mesh.ply").write_bytes(b"half of a mesh")
    one.upload()
    assert set(one.storage.files("vase-1")) == {"vase/photo.jpg"}


def test_a_storage_that_is_not_there_is_told(tmp_path, s3, monkeypatch):
    with pytest.raises(SettingError, match="cannot be used"):
        Storage("nothing-like://x/y")
    with pytest.raises(StorageError, match=r"cannot be reached|lacks a file"):
        Storage("s3://no-such-bucket/x").set_files("a", {})


@pytest.mark.parametrize(
    ("url", "kind"), [("ftp://me:secret@127.0.0.1:1/x", StorageError), ("nothing-like://me:secret@x/y", SettingError)]
)
def test_what_is_wrong_with_a_storage_is_told_without_its_password(url: str, kind: type[FieldworkError]) -> None:
    with pytest.raises(kind, match=r"://me:…@.* cannot be (reached|used)") as failure:
        Storage(url)
    assert "secret" not in str(failure.value)


def test_a_storage_s_own_errors_are_told_without_its_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = Storage(tmp_path.as_uri())

    def fails(*_: Any) -> None:
        raise OSError("no route to ftp://me:secret@host/x")

    monkeypatch.setattr(storage.fs, "find", fails)
    with pytest.raises(StorageError, match="no route to ftp://me:…@host/x"):
        storage.objects()


def test_missing_credentials_are_told(tmp_path, s3, monkeypatch):
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    for name in ("AWS_SHARED_CREDENTIALS_FILE", "AWS_CONFIG_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(StorageError, match=r"cannot be reached while .*credentials"):
        Storage(s3).files("vase-1")
    s3fs.S3FileSystem.clear_instance_cache()


def test_checkpoints_are_saved_while_a_stage_runs(tmp_path, url):
    one, two = machine(tmp_path / "one", url), machine(tmp_path / "two", url)
    (tmp_path / "one/vase").mkdir()
    with Saving(one, every=0.1):
        (tmp_path / "one/vase/field.bin").write_bytes(b"checkpoint")
        deadline = time.monotonic() + 60
        while not two.fetch() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert (tmp_path / "two/vase/field.bin").read_bytes() == b"checkpoint"
        with atomic_path(tmp_path / "one/vase/field.bin") as temporary:
            temporary.write_bytes(b"the end")
    two.fetch()
    assert (tmp_path / "two/vase/field.bin").read_bytes() == b"the end"


def test_places_move_with_the_folder():
    value = {"a": ["/one/x", "/onelike/x", 3], "b": "/one"}
    assert placed(value, "/one", "/two") == {"a": ["/two/x", "/onelike/x", 3], "b": "/two"}


def test_captures_outside_of_the_list_s_folder_are_refused(tmp_path):
    inside = {"photos": tmp_path / "photos", "out": tmp_path / "p"}
    assert len(plan([Capture(ReconstructParams(**inside))], tmp_path)) == 6
    for change in ({"out": tmp_path.parent / "p"}, {"blend": Path("/elsewhere/a.blend")}):
        with pytest.raises(SettingError, match="is outside of"):
            plan([Capture(ReconstructParams(**{**inside, **change}))], tmp_path)
    far = [Capture(ReconstructParams(**{**inside, "photos": Path("/elsewhere/photos")}))]
    assert plan(far, tmp_path)
    with pytest.raises(SettingError, match="are sent files of"):
        plan(far, tmp_path, "s3://bucket/x")


def test_a_worker_writes_nowhere_but_in_its_folder(tmp_path):
    (tmp_path / "campaign").mkdir()
    (tmp_path / "campaign/p").symlink_to(tmp_path / "elsewhere")
    for out in (tmp_path / "elsewhere", tmp_path / "campaign/p"):
        capture = ReconstructParams(photos=tmp_path / "photos", out=out).model_dump(mode="json")
        with pytest.raises(Refusal, match="outside of the campaign's folder"):
            run_stage({"capture": capture, "stage": "new", "folder": str(tmp_path / "campaign")}, Reporter())
    assert not (tmp_path / "elsewhere").exists()


def test_each_stage_on_another_machine_makes_what_one_machine_makes(tmp_path, s3, monkeypatch):
    """Photos of a ball, each stage with an empty disk; at home nothing is left to do."""
    home = tmp_path / "home"
    support.take_photos(home / "photos")
    support.fake(monkeypatch)
    params = ReconstructParams(photos=home / "photos", out=home / "p", preset="draft", set=support.SETTINGS)
    url = f"{s3}/{tmp_path.name}"
    copy = Copy(Storage(url), home, capture_name(params, home), tracked_paths(params))
    copy.upload()
    values: dict[str, Any] = {"capture": params.model_dump(mode="json"), "folder": str(home), "storage": url}
    for number, stage in enumerate(stages_of(params)):
        worker = tmp_path / f"worker{number}"
        monkeypatch.setattr(module, "work_folder", lambda _, worker=worker: worker)
        monkeypatch.setattr("fieldwork.nerfcore.workflows.stage_task.work_folder", lambda _, worker=worker: worker)
        made = run_stage({**values, "stage": stage}, Reporter())
        assert not made["reused"]
        assert str(worker) not in str(made)
        shutil.rmtree(worker)
    copy.fetch()
    assert (home / "p/runs/main/field.safetensors").is_file()
    assert str(tmp_path / "worker") not in (home / "p/project.json").read_text()
    result = reconstruct(params, Reporter())
    assert result["reused"] == [verb for verb in STAGES if verb != "blend"]
