"""The campaign's end of the line to Ray: starts the bridge, and another one when the cluster's head was lost."""

from __future__ import annotations

import collections
import importlib.util
import json
import logging
import os
import queue
import re
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

from ..errors import FieldworkError, InputError, SettingError
from .refusals import START, why

log = logging.getLogger("fieldwork.cluster")
INSTALL = 'Install it on this machine and on the workers: pip install "fieldwork[cluster]".'
BRIDGE_STARTS = 60.0  # seconds at most
SILENT = 45.0  # seconds after which a bridge that says nothing is given up
PAUSE = 2.0  # seconds between two attempts to reach a head that is gone


class ClusterError(FieldworkError):
    """The cluster cannot be reached, or was lost."""

    code = "cluster"


def require_ray() -> None:
    """Raise SettingError where the optional extra is not installed."""
    if importlib.util.find_spec("ray") is None:
        raise SettingError("--cluster needs Ray, which is not installed here.", INSTALL)


def check_wheel(wheel: Path | None) -> None:
    """Raise InputError unless a wheel that was given is one."""
    if wheel is not None and not (wheel.suffix == ".whl" and zipfile.is_zipfile(wheel)):
        raise InputError(f"--wheel {wheel} is no wheel.", "Give the .whl file that `pip wheel` made of Fieldwork.")


def check_address(address: str) -> None:
    """Raise SettingError unless it is auto, HOST:PORT or ray://HOST:PORT."""
    if address != "auto" and not re.fullmatch(r"(ray://)?[\w.\-\[\]:]+:\d{1,5}", address):
        raise SettingError(
            f"--cluster {address}: that is no address of a cluster.", "Give auto, HOST:PORT or ray://HOST:PORT."
        )


class Link:
    """Messages to and from the bridge. `reconnect` seconds is waited for a head that is gone."""

    def __init__(self, address: str, wheel: Path | None = None, reconnect: float = 300.0) -> None:
        require_ray()
        check_address(address)
        check_wheel(wheel)
        self.address, self.wheel, self.reconnect = address, wheel, reconnect
        self.joined = False
        self.process: subprocess.Popen[bytes] | None = None
        self.messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self.tail: collections.deque[str] = collections.deque(maxlen=30)
        self.heard = time.monotonic()

    def open(self, check: Any) -> dict[str, Any]:
        """Start the bridge: its first message, with the nodes. Raises ClusterError; Cancelled through `check`."""
        self.close()
        self.messages = queue.Queue()
        self.tail.clear()
        path = os.pathsep.join(entry for entry in sys.path if entry)
        environment = {
            **os.environ,
            "PYTHONPATH": path,
            "PYTHONIOENCODING": "utf-8",
            "RAY_USAGE_STATS_ENABLED": "0",  # Ray would tell its makers that it is used
            "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
            "RAY_gcs_rpc_server_reconnect_timeout_s": "10",
        }
        command = [sys.executable, "-m", f"{__package__}.bridge", self.address, "joined" if self.joined else "new"]
        self.process = subprocess.Popen(
            [*command, str(self.wheel.absolute()) if self.wheel else ""],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C reaches us first
        )
        readers = [
            threading.Thread(target=target, args=(stream, self.messages), daemon=True)
            for target, stream in ((self._read, self.process.stdout), (self._log, self.process.stderr))
        ]
        for reader in readers:
            reader.start()
        deadline = time.monotonic() + BRIDGE_STARTS
        while time.monotonic() < deadline:
            check()
            try:
                message = self.messages.get(timeout=0.2)
            except queue.Empty:
                continue
            if message is not None and message["kind"] == "ready":
                self.joined, self.heard = self.joined or message["joined"], time.monotonic()
                return message
            self.close()
            for reader in readers:
                reader.join(timeout=2.0)
            reason, hint = why(self.address, message["message"] if message else "", list(self.tail))
            raise ClusterError(f"The cluster {self.address} cannot be reached: {reason}.", hint)
        self.close()
        raise ClusterError(f"The cluster {self.address} has not answered for {BRIDGE_STARTS:.0f} s.", START)

    def open_again(self, check: Any) -> dict[str, Any]:
        """Wait for a head that is gone. Raises ClusterError when it stays away."""
        deadline = time.monotonic() + self.reconnect
        while True:
            try:
                return self.open(check)
            except ClusterError as error:
                log.info("the cluster is not back yet: %s", error)
                if time.monotonic() > deadline:
                    raise ClusterError(
                        f"The cluster {self.address} was lost and did not come back within {self.reconnect:.0f} s.",
                        "Start its head again, then run the same command: finished work is kept.",
                    ) from error
            end = time.monotonic() + PAUSE
            while time.monotonic() < end:
                check()
                time.sleep(0.1)

    def send(self, **command: Any) -> None:
        """Give the bridge something to do; one that is gone is noticed by `get`."""
        assert self.process is not None
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(command).encode() + b"\n")
            self.process.stdin.flush()
        except OSError as error:
            log.info("the bridge is gone: %s", error)
            self.messages.put(None)

    def get(self, timeout: float) -> dict[str, Any] | None:
        """The next message, {} when there is none in time, None when the bridge is gone."""
        try:
            message = self.messages.get(timeout=timeout)
        except queue.Empty:
            return None if time.monotonic() - self.heard > SILENT else {}
        self.heard = time.monotonic()
        return None if message is None or message["kind"] == "fatal" else message

    def close(self) -> None:
        """End the bridge; a cluster that it started ends with it."""
        process, self.process = self.process, None
        if process is None:
            return
        try:
            assert process.stdin is not None
            process.stdin.close()
        except BrokenPipeError:
            log.info("the bridge had ended")
        try:
            process.wait(timeout=4.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(timeout=10)

    def _read(self, stream: Any, messages: queue.Queue[dict[str, Any] | None]) -> None:
        with stream:
            for line in stream:
                try:
                    messages.put(json.loads(line))
                except ValueError:
                    self.tail.append(line.decode("utf-8", "replace").strip())
        messages.put(None)

    def _log(self, stream: Any, _: Any) -> None:
        with stream:
            for line in stream:
                text = line.decode("utf-8", "replace").strip()
                if text:
                    self.tail.append(text)
                    log.debug("ray: %s", text)
