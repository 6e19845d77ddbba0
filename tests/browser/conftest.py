from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import support

IS_REQUIRED = os.environ.get("SCPSFM_REQUIRE_BROWSER") == "1"
LACKS = support.missing()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if LACKS and not IS_REQUIRED:
        for item in items:
            item.add_marker(pytest.mark.skip(reason=f"needs {'; '.join(LACKS)}"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says loudly what was left out."""
    if LACKS and not IS_REQUIRED:
        count = len(terminalreporter.stats.get("skipped", []))
        words = f"SKIPPED {count} tests of the console in a browser: missing are {'; '.join(LACKS)}"
        terminalreporter.write_sep("!", words, red=True, bold=True)


@pytest.fixture(autouse=True)
def _what_is_needed() -> None:
    assert not LACKS, f"SCPSFM_REQUIRE_BROWSER is set, and missing are {'; '.join(LACKS)}"


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    assert not LACKS, LACKS
    return support.scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture
def server(tmp_path: Path) -> Iterator[support.Server]:
    server = support.Server(tmp_path)
    yield server
    server.stop()


@pytest.fixture
def network(server: support.Server) -> Iterator[support.Network]:
    network = support.Network(server)
    yield network
    network.stop()


@pytest.fixture
def site(server: support.Server, request: pytest.FixtureRequest) -> str:
    """Where the page is: the server itself, or what adds the page to a server that does not serve it."""
    if server.serves_the_page():
        return server.url
    return str(request.getfixturevalue("network").url)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[support.Browser]:
    browser = support.Browser(tmp_path / "profile")
    yield browser
    try:
        asked = browser.requested()
        # Before the page is opened, the browser shows one of its own, with parts that no page of a server can ask for.
        own = ("data:", "about:", "chrome:", "chrome-untrusted:")
        outside = [url for url in asked if not url.startswith((browser.base + "/", *own))]
        assert not outside, f"the page asked others: {outside}"
    finally:
        browser.stop()
