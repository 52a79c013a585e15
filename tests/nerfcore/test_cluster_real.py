"""Campaigns of real stages (but for the poses, which are known) on a real Ray cluster, from photos to renders."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.mesh.stored import load_surface
from fieldwork.nerfcore.params import BatchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows import campaign
from fieldwork.nerfcore.workflows.batch import batch
from fieldwork.tests.nerfcore.support import cluster_real, reconstructed
from fieldwork.tests.nerfcore.support.ray_cluster import Cluster

pytest.importorskip("ray", reason="the extra “cluster” is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(560)]
STAGES = ["new", "poses", "train", "mesh", "evaluate", "render"]
NAMES = ("bowl", "jug")


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket on a server of this process; its address reaches the workers through their environment."""
    pytest.importorskip("s3fs", reason="the extra “cluster” is not installed")
    server = pytest.importorskip("moto.server", reason="moto is not installed").ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    names = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1"}
    for name, value in {"AWS_ENDPOINT_URL": f"http://{host}:{port}", **names}.items():
        monkeypatch.setenv(name, value)
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("campaigns")
    yield "s3://campaigns/objects"
    server.stop()


def photos(folder: Path) -> Path:
    """Two captures of ten photos each, and the list of both."""
    rows = []
    for name in NAMES:
        reconstructed.take_photos(folder / name)
        rows.append({"photos": name, "labels": f"{name}/labels", "preset": "draft", "set": reconstructed.SETTINGS})
    path = folder / "captures.json"
    path.write_text(json.dumps(rows))
    return path


def run(path: Path, cluster: Cluster, patch: pytest.MonkeyPatch, **values: Any) -> dict[str, Any]:
    patch.setattr(campaign, "STAGE_TASK", cluster_real.NAME)
    for name, value in cluster.access.items():
        patch.setenv(name, value)
    params = BatchParams(**{"list": path, "cluster": cluster.address, "keep_free": 0.2, **values})
    return batch(params, Reporter())


def check(path: Path, result: dict[str, Any]) -> None:
    """Every capture has all that `reconstruct` makes, and a second call has nothing to do."""
    assert len(result["done"]) == len(NAMES)
    known = json.loads(path.with_name("captures-report.json").read_text())["captures"]
    for key, entry in known.items():
        project = Path(key)
        assert list(entry["stages"]) == STAGES
        assert entry["result"]["evaluate"]["psnr"] > 5
        assert (project / "runs/main/field.safetensors").is_file()
        assert len(load_surface(project, "main")[0].faces) > 0
        assert list((project / "exports/main/renders").glob("*.png"))
    status = json.loads((path.parent / "captures-campaign/status.json").read_text())
    assert status["counts"]["done"] == len(NAMES)
    assert all((path.parent / "captures-campaign" / row["picture"]).is_file() for row in status["captures"])


def test_captures_go_through_all_stages_with_a_common_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = photos(tmp_path)
    with Cluster() as cluster:
        check(path, run(path, cluster, monkeypatch))
        assert run(path, cluster, monkeypatch)["skipped"] == len(NAMES)


def test_captures_go_through_all_stages_with_an_s3_storage(
    tmp_path: Path, s3: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The workers have folders of their own, and none sees the list's."""
    home, places = tmp_path / "home", [tmp_path / "one", tmp_path / "two"]
    home.mkdir()
    path = photos(home)
    with Cluster(0) as cluster:
        cluster.nodes = [cluster.add(FIELDWORK_WORK=str(place)) for place in places]
        check(path, run(path, cluster, monkeypatch, storage=s3))
    held = [len(list(place.rglob("field.safetensors"))) for place in places]
    assert sum(held) >= len(NAMES), "the fields were trained where the workers keep their files"
    # What came home names no folder of a worker.
    for name in NAMES:
        text = (home / f"{name}_fieldwork/project.json").read_text()
        assert not any(str(place) in text for place in places)
    # The home is found again by one machine: nothing of it is left to do.
    assert batch(BatchParams(list=path), Reporter())["skipped"] == len(NAMES)
