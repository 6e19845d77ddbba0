"""A server to test against, and one face for both clients."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import scpsfm

NO_SERVER = "needs a server"

PATIENCE = 60.0
"""Seconds; nothing in these tests takes nearly so long, and what does hangs."""


def binary() -> Path:
    """The server's program; without it the test is skipped, unless SCPSFM_REQUIRE_SERVER forbids it."""
    named = os.environ.get("SCPSFM_BIN")
    if named and Path(named).is_file():
        return Path(named)
    missing = "SCPSFM_BIN names no server" if not named else f"SCPSFM_BIN: there is no file {named}"
    if os.environ.get("SCPSFM_REQUIRE_SERVER") == "1":
        pytest.fail(missing)
    pytest.skip(f"{NO_SERVER}: {missing}")


class Server:
    """A server process, with a data directory that outlives it."""

    def __init__(
        self, data: Path, *flags: str, environment: dict[str, str] | None = None, http_listen: str = "off"
    ) -> None:
        self._data = data
        self._http_listen = http_listen
        self.http_url: str | None = None
        """Of the JSON port, where it is on."""
        self._flags = flags
        self._environment = {**os.environ, **(environment or {})}
        self.address = "127.0.0.1:0"
        self.start()

    def start(self) -> None:
        """Starts it; after the first time on the same port."""
        command = [str(binary()), "serve", "--listen", self.address.rpartition("//")[2]]
        command += [
            "--http-listen",
            self._http_listen,
            "--metrics-listen",
            "127.0.0.1:0",
            "--data-dir",
            str(self._data),
            *self._flags,
        ]
        log = (self._data.parent / f"{self._data.name}.log").open("ab")
        with log:
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, env=self._environment)
        assert self.process.stdout is not None
        watchdog = threading.Timer(PATIENCE, self.process.kill)
        watchdog.start()
        for line in self.process.stdout:
            kind, _, url = line.decode().strip().partition(" ")
            if kind == "grpc":
                self.address = url
            if kind == "http":
                self.http_url = url
            if self.address != "127.0.0.1:0" and (self._http_listen == "off" or self.http_url):
                break
        else:
            pytest.fail(f"the server ended with {self.process.wait()}; its log: {Path(log.name).read_text()[-2000:]}")
        watchdog.cancel()

    def kill(self) -> None:
        """As a crash ends it."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(PATIENCE)
        assert self.process.stdout is not None
        self.process.stdout.close()

    def stop(self) -> None:
        """Ends it."""
        if self.process.poll() is None:
            self.kill()


class Both:
    """Makes an async object look like its sync counterpart."""

    def __init__(self, inner: Any, loop: asyncio.AbstractEventLoop) -> None:
        self._inner = inner
        self._loop = loop

    def __enter__(self) -> Both:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _plain(self, value: Any) -> Any:
        if inspect.isasyncgen(value):
            return self._iterate(value)
        if inspect.iscoroutine(value):
            return self._plain(self._loop.run_until_complete(asyncio.wait_for(value, PATIENCE)))
        if isinstance(value, scpsfm.AsyncJob):
            return Both(value, self._loop)
        if isinstance(value, list):
            return [self._plain(entry) for entry in value]
        return value

    def _iterate(self, values: Any) -> Iterator[Any]:
        try:
            while True:
                try:
                    yield self._plain(self._loop.run_until_complete(anext(values)))
                except StopAsyncIteration:
                    return
        finally:
            self._loop.run_until_complete(values.aclose())

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._inner, name)
        if not callable(value):
            return self._plain(value)
        return lambda *given, **named: self._plain(value(*given, **named))


@contextlib.contextmanager
def client_of(kind: str, address: str, **named: Any) -> Iterator[Any]:
    """A client of either kind."""
    if kind == "sync":
        with scpsfm.Client(address, **named) as client:
            yield client
        return
    loop = asyncio.new_event_loop()
    try:
        with Both(scpsfm.AsyncClient(address, **named), loop) as client:
            yield client
    finally:
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.close()
