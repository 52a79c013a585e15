"""Why a cluster cannot be reached, in words: Ray writes it into its log, among much else, or only says that nobody answered."""

from __future__ import annotations

import os
import re
import socket
import ssl
from collections.abc import Iterable

START = "Start one (ray start --head), or use --cluster auto."
TOKEN = "Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN_PATH to the file of the token that the cluster was started with."
CERTIFICATES = "Set RAY_USE_TLS=1, and RAY_TLS_SERVER_CERT, RAY_TLS_SERVER_KEY and RAY_TLS_CA_CERT to files of the same authority on all machines."
PROBE = 3.0  # seconds
LOG_LINE = re.compile(r"^\[[^\]]*\]\s+\S+:\d+:\s+")  # [2026-01-31 12:00:00,000 E 1 2] rpc_client.h:204: …


def why(address: str, message: str, said: Iterable[str]) -> tuple[str, str]:
    """The reason, without a full stop, and what to do.

    Args:
        message: what the bridge says of its end; empty where it just ended. said: the last lines of Ray's log.
    """
    lines = [message, *said]
    if any("InvalidAuthToken" in line or "AuthenticationError" in line for line in lines):
        return "it does not accept the token of this machine", TOKEN
    if any("WRONG_VERSION_NUMBER" in line for line in lines):
        return "it is not encrypted, and RAY_USE_TLS is set here", "Unset RAY_USE_TLS, or start the cluster with it."
    if any("Handshake failed" in line or "CERTIFICATE_VERIFY_FAILED" in line for line in lines):
        return "its certificate and the one of this machine are not of one authority", CERTIFICATES
    if not encrypts() and speaks_tls(address):
        return "it is encrypted, and RAY_USE_TLS is not set here", CERTIFICATES
    last = next((line for line in [message, *reversed(lines[1:])] if line), "it ended")
    return LOG_LINE.sub("", last).partition(". ")[0].rstrip("."), START


def encrypts() -> bool:
    """Whether Ray encrypts what this process says."""
    return os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true")


def speaks_tls(address: str) -> bool:
    """Whether a TLS server answers at HOST:PORT; “auto” is where RAY_ADDRESS says."""
    place = os.environ.get("RAY_ADDRESS", "") if address == "auto" else address
    host, _, port = place.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return False
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE  # nothing is said to it but hello
    context.set_alpn_protocols(["h2"])
    try:
        with socket.create_connection((host.strip("[]"), int(port)), PROBE) as plain, context.wrap_socket(plain):
            return True
    except ssl.SSLError as error:
        return "ALERT" in str(error).upper().replace(" ", "_")  # it wants a certificate of ours
    except OSError:
        return False
