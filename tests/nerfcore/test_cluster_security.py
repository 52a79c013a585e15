"""Encryption and tokens of Ray: a campaign with both, and that whoever lacks one of them is refused, with a sentence."""

from __future__ import annotations

import re
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from fieldwork.nerfcore.cluster.link import ClusterError, Link
from fieldwork.nerfcore.cluster.refusals import START, speaks_tls, why
from fieldwork.nerfcore.params import BatchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows import campaign
from fieldwork.nerfcore.workflows.batch import batch
from fieldwork.tests.nerfcore.support import cluster_work
from fieldwork.tests.nerfcore.support.ray_cluster import Cluster, Node, write_list

pytest.importorskip("cryptography", reason="there is nothing to make certificates with")
from fieldwork.tests.nerfcore.support.certificates import Authority

VARIABLES = ["RAY_USE_TLS", "RAY_TLS_SERVER_CERT", "RAY_TLS_SERVER_KEY", "RAY_TLS_CA_CERT"]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("tls") / "ours", "ours")


@pytest.fixture(scope="module")
def cluster(authority: Authority) -> Iterator[Cluster]:
    pytest.importorskip("ray", reason="the extra “cluster” is not installed")
    found = Cluster(1)
    found.access |= authority.access("node")
    with found:
        yield found


def give(patch: pytest.MonkeyPatch, access: dict[str, str]) -> None:
    for name, value in access.items():
        patch.setenv(name, value)


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_campaign_is_encrypted_and_has_a_token(
    tmp_path: Path, cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    give(monkeypatch, cluster.access)
    monkeypatch.setattr(campaign, "STAGE_TASK", cluster_work.NAME)
    path = write_list(tmp_path, ["a", "b"])
    result = batch(BatchParams(list=path, cluster=cluster.address, keep_free=0.2), Reporter())
    assert len(result["done"]) == 2
    assert speaks_tls(cluster.address)


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("lacks", ["certificate", "authority", "token", "right token"])
def test_a_client_that_lacks_something_is_refused(
    lacks: str, tmp_path: Path, cluster: Cluster, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = {name: value for name, value in cluster.access.items() if name not in VARIABLES}
    (tmp_path / "token").write_text("0" * 64)
    access, reason, hint = {
        "certificate": (token, "is encrypted, and RAY_USE_TLS is not set", "RAY_TLS_CA_CERT"),
        "authority": ({**token, **Authority(tmp_path / "other", "other").access("client")}, "one authority", "TLS_CA"),
        "token": ({**authority.access("client"), "RAY_AUTH_MODE": "disabled"}, "token of this", "RAY_AUTH_TOKEN_PATH"),
        "right token": (
            {**cluster.access, "RAY_AUTH_TOKEN_PATH": str(tmp_path / "token")},
            "token of this",
            "RAY_AUTH_TOKEN_PATH",
        ),
    }[lacks]
    give(monkeypatch, access)
    link = Link(cluster.address)
    with pytest.raises(ClusterError, match=reason) as refused:
        link.open(lambda: None)
    assert hint in refused.value.hint
    assert link.process is None, "the bridge has ended"


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_worker_without_a_certificate_does_not_join(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    token = {name: value for name, value in cluster.access.items() if name not in VARIABLES}
    node = Node(cluster.worker_arguments(), **token)
    assert not node.wait()
    node.kill()
    give(monkeypatch, cluster.access)
    link = Link(cluster.address)
    nodes = link.open(lambda: None)["nodes"]
    link.close()
    assert sum(node["cores"] for node in nodes) == 1.0


@pytest.mark.parametrize(
    ("message", "said", "reason"),
    [
        ("", ["x", "RPC error: InvalidAuthToken: Authentication token is missing"], "does not accept the token"),
        ("", ["ssl_transport_security.cc:1432] Handshake failed with fatal error"], "not of one authority"),
        ("", ["Handshake failed … SSL routines:WRONG_VERSION_NUMBER."], "is not encrypted"),
        ("", ["[2026-11-24 02:14:17,876 E 28731 28735] rpc_client.h:204: Failed to connect to GCS within 10 seconds. "
              "GCS may have been killed. See the log."], "^Failed to connect to GCS within 10 seconds$"),
        ("ValueError: no such host", ["Of a log."], "^ValueError: no such host$"),
        ("", [], "^it ended$"),
    ],
)  # fmt: skip
def test_why_a_cluster_cannot_be_reached(message: str, said: list[str], reason: str) -> None:
    found, hint = why("127.0.0.1:9", message, said)
    assert re.search(reason, found)
    assert (hint == START) == reason.startswith("^")


@pytest.fixture(params=["plain", "encrypted", "certificates wanted"])
def server(request: pytest.FixtureRequest, authority: Authority) -> Iterator[tuple[str, int]]:
    """What kind of server it is, and its port."""
    access = authority.access("server")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(access["RAY_TLS_SERVER_CERT"], access["RAY_TLS_SERVER_KEY"])
    context.load_verify_locations(access["RAY_TLS_CA_CERT"])
    context.set_alpn_protocols(["h2"])
    if request.param == "certificates wanted":
        context.verify_mode = ssl.CERT_REQUIRED
        context.maximum_version = ssl.TLSVersion.TLSv1_2  # refuses at once, not with the first words
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer() -> None:
            caller, _ = listening.accept()
            with caller:
                try:
                    if request.param == "plain":
                        caller.sendall(b"220 hello\r\n")
                    else:
                        context.wrap_socket(caller, server_side=True).close()
                except OSError:  # the caller hung up
                    return

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield request.param, listening.getsockname()[1]
        thread.join(timeout=60)


def test_an_encrypted_server_is_known(server: tuple[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    kind, port = server
    monkeypatch.delenv("RAY_USE_TLS", raising=False)
    reason, _ = why(f"127.0.0.1:{port}", "", ["Failed to connect to GCS."])
    assert reason.startswith("it is encrypted") == (kind != "plain")


def test_nobody_is_asked_where_no_address_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert not speaks_tls("auto")
    assert not speaks_tls("127.0.0.1:9")
