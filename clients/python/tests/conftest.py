from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import scpsfm

from . import scene, support
from .fake import Fake, Running


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says loudly what was left out."""
    skipped = terminalreporter.stats.get("skipped", [])
    left_out = sum(support.NO_SERVER in str(report.longrepr) for report in skipped)
    if left_out:
        words = f"SKIPPED {left_out} tests against a real server: SCPSFM_BIN must name its program"
        terminalreporter.write_sep("!", words, red=True, bold=True)


@pytest.fixture(autouse=True)
def _no_access_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("SCPSFM_API_KEY", "SCPSFM_TENANT"):
        monkeypatch.delenv(variable, raising=False)


@pytest.fixture(scope="session")
def small() -> scene.Scene:
    return scene.make(seed=1)


@pytest.fixture
def running(small: scene.Scene) -> Iterator[Running]:
    server = Running(Fake(scene.true_result(small)))
    yield server
    server.stop()


@pytest.fixture
def fake(running: Running) -> Fake:
    return running.fake


@pytest.fixture(params=["sync", "async"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


QUICK = scpsfm.RetryPolicy(patience_s=20.0, first_pause_s=0.001, longest_pause_s=0.01)


@pytest.fixture
def client(running: Running, kind: str) -> Iterator[Any]:
    with support.client_of(kind, running.address, retry=QUICK) as client:
        yield client


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[support.Server]:
    folder: Path = tmp_path_factory.mktemp("server")
    server = support.Server(folder / "data", "--workers", "1")
    yield server
    server.stop()


@pytest.fixture
def http_server(tmp_path: Path) -> Iterator[support.Server]:
    server = support.Server(tmp_path / "data", "--workers", "1", http_listen="127.0.0.1:0")
    yield server
    server.stop()


@pytest.fixture
def real(server: support.Server, kind: str) -> Iterator[Any]:
    with support.client_of(kind, server.address) as client:
        yield client
