"""A real server, a network that breaks, and a real browser."""

from __future__ import annotations

import csv
import http.client
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

CONSOLE = Path(__file__).resolve().parents[2] / "src" / "http" / "console"

# What the page is allowed: its own files and its own server.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

# Path of each file and its media type.
FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/console.css": ("console.css", "text/css; charset=utf-8"),
    "/console.js": ("console.js", "text/javascript; charset=utf-8"),
}

# Longer than anything takes on a busy machine; a test that fails waits so long, one that passes does not.
PATIENCE = 120


def missing() -> list[str]:
    """What these tests need and this machine lacks."""
    lacks = []
    if not os.environ.get("SCPSFM_BIN"):
        lacks.append("SCPSFM_BIN, the server's program")
    if not (chromium() and shutil.which("chromedriver")):
        lacks.append("chromium and chromedriver")
    if importlib.util.find_spec("selenium") is None:
        lacks.append("the Python package selenium")
    if axe() is None:
        lacks.append("SCPSFM_AXE, the file axe.min.js of axe-core")
    return lacks


def chromium() -> str | None:
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def axe() -> Path | None:
    """The checker of accessibility."""
    named = os.environ.get("SCPSFM_AXE")
    return Path(named) if named else None


def until(what: str, condition: Callable[[], Any]) -> Any:
    """The first true value of a condition; its last error if there is none."""
    deadline = time.monotonic() + PATIENCE
    error: Exception | None = None
    while time.monotonic() < deadline:
        try:
            if value := condition():
                return value
        except Exception as caught:  # an element that is being replaced, a server that is starting
            error = caught
        time.sleep(0.05)
    raise AssertionError(f"waited in vain until {what}") from error


class Server:
    """A server of the program under test, with a data directory of its own."""

    def __init__(self, folder: Path, env: dict[str, str] | None = None, workers: int = 1) -> None:
        self.folder, self.env, self.workers = folder, env or {}, workers
        self.url = ""
        self.start()

    def start(self) -> None:
        port = "127.0.0.1:0"
        flags = ["--listen", port, "--metrics-listen", port, "--http-listen", port, "--workers", str(self.workers)]
        self.log = open(self.folder / "server.log", "ab")  # noqa: SIM115 (the server has it)
        self.process = subprocess.Popen(
            [os.environ["SCPSFM_BIN"], "serve", *flags, "--data-dir", str(self.folder / "data")],
            stdout=subprocess.PIPE, stderr=self.log, env={**os.environ, **self.env}, text=True,
        )
        assert self.process.stdout
        for line in self.process.stdout:
            if line.startswith("http "):
                self.url = line.split()[1]
                return
        raise AssertionError(f"the server does not serve HTTP: {(self.folder / 'server.log').read_text()[-2000:]}")

    def stop(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        if self.process.stdout:
            self.process.stdout.close()
        self.log.close()

    def call(self, method: str, path: str, body: Any = None, key: str | None = None) -> Any:
        headers = {"content-type": "application/json"}
        if key:
            headers["authorization"] = f"Bearer {key}"
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, data=data, headers=headers, method=method)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{method} {path}: {error.code} {error.read().decode()[:500]}") from None

    def create(self, track_set: Any, *, key: str | None = None, input: str | None = None, **job: Any) -> str:
        source = {"input": input} if input else {"trackSet": track_set}
        return str(self.call("POST", "/v1/tenants/-/jobs", {**source, "job": job}, key)["name"])

    def state(self, name: str) -> str:
        return str(self.call("GET", f"/v1/{name}")["state"])

    def serves_the_page(self) -> bool:
        try:
            with urllib.request.urlopen(self.url + "/", timeout=PATIENCE) as answer:
                return str(answer.headers.get("content-type", "")).startswith("text/html")
        except urllib.error.HTTPError:
            return False


class Network:
    """Stands between browser and server: remembers requests, breaks streams, and can be down."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.serves_the_page = server.serves_the_page()
        self.streams: list[dict[str, str]] = []
        self.is_down = False
        # Streams that are cut off after so many events, one entry each.
        self.cuts: list[int] = []
        network = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_: Any) -> None:
                pass

            def pass_on(self) -> None:
                network.pass_on(self)

            do_GET = do_POST = do_DELETE = pass_on

        self.listener = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.listener.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.listener.server_port}"
        threading.Thread(target=self.listener.serve_forever, daemon=True).start()

    def stop(self) -> None:
        self.listener.shutdown()
        self.listener.server_close()

    def pass_on(self, handler: BaseHTTPRequestHandler) -> None:
        handler.close_connection = True
        if self.is_down:
            # At once, and not when the browser's patience ends.
            handler.connection.shutdown(socket.SHUT_RDWR)
            return
        path = handler.path.split("?")[0]
        if not self.serves_the_page and handler.command == "GET" and path in FILES:
            self.give_file(handler, path)
            return
        body = handler.rfile.read(int(handler.headers.get("content-length") or 0))
        upstream = http.client.HTTPConnection(self.server.url.removeprefix("http://"), timeout=PATIENCE)
        try:
            upstream.request(handler.command, handler.path, body, dict(handler.headers))
            answer = upstream.getresponse()
            self.give_answer(handler, answer)
        except OSError:
            pass
        finally:
            upstream.close()

    def give_file(self, handler: BaseHTTPRequestHandler, path: str) -> None:
        name, kind = FILES[path]
        content = (CONSOLE / name).read_bytes()
        handler.send_response(200)
        headers = {"content-type": kind, "content-length": str(len(content)), "content-security-policy": POLICY,
                   "x-content-type-options": "nosniff"}
        for header, value in headers.items():
            handler.send_header(header, value)
        handler.end_headers()
        handler.wfile.write(content)

    def give_answer(self, handler: BaseHTTPRequestHandler, answer: http.client.HTTPResponse) -> None:
        is_stream = str(answer.headers.get("content-type", "")).startswith("text/event-stream")
        limit = None
        if is_stream:
            self.streams.append({name.lower(): value for name, value in handler.headers.items()})
            limit = self.cuts.pop(0) if self.cuts else None
        handler.send_response(answer.status)
        for header, value in answer.headers.items():
            if header.lower() not in ("transfer-encoding", "connection", "date", "server"):
                handler.send_header(header, value)
        handler.end_headers()
        events = 0
        while chunk := answer.read1(65536):
            for line in chunk.splitlines(keepends=True):
                # In two pieces: events come cut anywhere.
                middle = len(line) // 2 if is_stream else 0
                handler.wfile.write(line[:middle])
                handler.wfile.flush()
                handler.wfile.write(line[middle:])
                # The blank line that ends an event.
                events += line == b"\n"
                if limit is not None and events >= limit:
                    return
            handler.wfile.flush()
            if self.is_down:
                return


class Browser:
    """A browser that a person might sit at: it is asked for what is seen."""

    def __init__(self, profile: Path) -> None:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = str(chromium())
        for flag in (
            "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--window-size=1200,1000",
            f"--user-data-dir={profile}",
        ):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        self.driver.set_script_timeout(PATIENCE)
        self.base = ""

    def open(self, url: str) -> None:
        self.base = url
        self.driver.get(url + "/")

    def all(self, selector: str) -> list[Any]:
        return list(self.driver.find_elements("css selector", selector))

    def text(self, selector: str = "body") -> str:
        return "\n".join(element.text for element in self.all(selector))

    def sees(self, text: str, selector: str = "body") -> None:
        until(f"{text!r} is seen in {selector}", lambda: text in self.text(selector))

    def waits_for(self, selector: str) -> Any:
        shown = lambda: next((element for element in self.all(selector) if element.is_displayed()), None)  # noqa: E731
        return until(f"{selector} is seen", shown)

    def button(self, words: str) -> Any:
        """The button of these words that can be pressed now."""

        def find() -> Any:
            buttons = (element for element in self.all("button") if element.is_displayed() and element.is_enabled())
            return next((button for button in buttons if button.text.split("\n")[-1] == words), None)

        return until(f"the button {words!r} can be pressed", find)

    def press(self, *keys: str) -> None:
        from selenium.webdriver import ActionChains

        ActionChains(self.driver).send_keys(*keys).perform()

    def focused(self) -> str:
        """Words of what has the focus."""
        script = "const e = document.activeElement; return e.getAttribute('aria-label') || e.textContent || e.id;"
        return str(self.driver.execute_script(script)).strip()

    def tab_to(self, words: str, most: int = 60) -> None:
        """Goes with the tab key to what has these words."""
        from selenium.webdriver.common.keys import Keys

        for _ in range(most):
            self.press(Keys.TAB)
            if self.focused().endswith(words):
                outline = self.driver.execute_script("return getComputedStyle(document.activeElement).outlineStyle")
                assert outline != "none", f"the focus on {words!r} is not visible"
                return
        raise AssertionError(f"the tab key does not reach {words!r}")

    def scheme(self, scheme: str) -> None:
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def findings(self) -> list[str]:
        """What axe calls serious or critical, with the elements."""
        checker = axe()
        assert checker
        self.driver.execute_script(checker.read_text(encoding="utf-8"))
        script = "const done = arguments[arguments.length - 1]; axe.run().then((found) => done(found.violations));"
        return [
            f"{found['id']}: {node['html'][:160]} {node.get('failureSummary', '')[:300]}"
            for found in self.driver.execute_async_script(script)
            if found["impact"] in ("serious", "critical")
            for node in found["nodes"]
        ]

    def errors(self) -> list[str]:
        """Messages of the console; of refused calls, which browsers tell too, only those that nothing explains."""
        entries = self.driver.get_log("browser")
        return [entry["message"] for entry in entries if entry["level"] in ("SEVERE", "WARNING")]

    def requested(self) -> set[str]:
        """Addresses that the page asked for."""
        messages = (json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance"))
        return {
            str(message["params"]["request"]["url"])
            for message in messages
            if message["method"] == "Network.requestWillBeSent"
        }

    def stop(self) -> None:
        self.driver.quit()


@contextmanager
def down(network: Network) -> Iterator[None]:
    network.is_down = True
    try:
        yield
    finally:
        network.is_down = False


def scene(folder: Path, seed: int = 0, views: int = 8, tracks: int = 120, outliers: float = 0.3,
          second_motion: float = 0.0) -> dict[str, Any]:
    """A scene of the program's own generator, as a TrackSet."""
    flags = ["--views", views, "--tracks", tracks, "--outliers", outliers, "--noise", 0.001, "--seed", seed,
             "--second-motion", second_motion]
    command = [os.environ["SCPSFM_BIN"], "synth", "--out", folder, *flags]
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL)
    with open(folder / "observations.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        "trackCount": tracks,
        "views": [{"name": f"{view}.jpg", "size": {"widthPx": 1000, "heightPx": 1000}} for view in range(views)],
        "viewIndices": [int(row["view"]) for row in rows],
        "trackIndices": [int(row["track"]) for row in rows],
        "xs": [float(row["x"]) for row in rows],
        "ys": [float(row["y"]) for row in rows],
    }


# A solve that does not end while a test looks on.
LONG = {"method": "METHOD_SCPSFM", "iterations": 10000, "networkWidth": 0.5}
