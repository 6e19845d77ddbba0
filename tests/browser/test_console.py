"""The console at `/` in a real browser, with a real server behind it."""

from __future__ import annotations

import urllib.request
from pathlib import Path
from typing import Any

import pytest
import support
from support import CONSOLE, FILES, LONG, POLICY, Browser, Network, Server, down, until

HOSTILE = '<img src=x onerror="document.title=\'taken\'">'
NORTH = "north-0123456789abcdef0123456789abcdef"
SOUTH = "south-0123456789abcdef0123456789abcdef"


def short(name: str) -> str:
    return name.split("/")[-1]


def open_job(browser: Browser, site: str, name: str) -> None:
    browser.open(site)
    browser.driver.get(f"{site}/#/{name}")
    browser.sees(f"Job {short(name)}", "h2")


def confirm(browser: Browser, words: str) -> None:
    """Answers the dialog: its button has the same words as the one that opened it."""
    until("the dialog is open", lambda: browser.all("#confirm-dialog[open]"))
    button = browser.waits_for("#confirm-yes")
    assert button.text == words
    button.click()


def badge(browser: Browser) -> str:
    return browser.text(".head .badge")


def states(browser: Browser) -> dict[str, str]:
    """Numbers of the overview by state."""
    words = (button.text.split("\n") for button in browser.all(".states button"))
    return {state: count for count, state in words}


def test_the_page_is_small_and_allowed_only_itself(site: str) -> None:
    total = 0
    for path, (name, kind) in FILES.items():
        with urllib.request.urlopen(site + path) as answer:
            content = answer.read()
            assert content == (CONSOLE / name).read_bytes(), path
            assert answer.headers["content-type"].split(";")[0] == kind.split(";")[0]
            assert answer.headers["content-security-policy"] == POLICY
            assert answer.headers["x-content-type-options"] == "nosniff"
        total += len(content)
    assert total < 100_000
    script = (CONSOLE / "console.js").read_text()
    for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "localStorage"):
        assert way not in script, way


def test_a_job_is_seen_from_queued_to_its_result(
    server: Server, site: str, browser: Browser, scene: dict[str, Any]
) -> None:
    ahead = server.create(scene, settings=LONG)
    until("a worker has it", lambda: server.state(ahead) == "JOB_STATE_RUNNING")
    job = server.create(scene, settings={"seed": "5"}, labels={"site": "north"})
    browser.open(site)
    browser.waits_for(f"a[href='#/{job}']").click()
    browser.sees("Queued", ".head .badge")
    server.call("POST", f"/v1/{ahead}:cancel", {})
    browser.sees("Succeeded", ".head .badge")
    browser.sees("Solved", "dl.large")
    summary = server.call("GET", f"/v1/{job}")["summary"]
    shown = browser.text("dl.large")
    assert summary["grade"].removeprefix("GRADE_") in shown
    assert f"{summary['focalPx']:.5g}"[:4] in shown and "±" in shown
    assert f"{summary['inlierTrackCount']}\nof 120" in shown
    browser.sees("Cameras, one row for each camera group")
    browser.sees("960")
    folded = "return [...document.querySelectorAll('details')].map((of) => of.textContent).join(' ')"
    assert "Classifying tracks and observations" in str(browser.driver.execute_script(folded))
    until("there are curves of the events", lambda: browser.all("figure:not([hidden]) svg polyline"))
    scene_is_drawn(browser)
    assert browser.errors() == []


def test_second_structures_are_listed(server: Server, site: str, browser: Browser, tmp_path: Path) -> None:
    job = server.create(support.scene(tmp_path / "scene", views=10, tracks=200, outliers=0.4, second_motion=0.25))
    open_job(browser, site, job)
    browser.sees("Rigid motions that rejected tracks agree on", "caption")
    result = server.call("GET", f"/v1/{job}/result")
    (structure,) = result["secondStructures"]
    tracks = result["tracks"]["secondStructureNumbers"].count(1)
    row = f"1 moving body {tracks} {len(structure['poses'])} {len(structure['points'])}"
    assert row in [row.text for row in browser.all("tbody tr")]
    assert browser.findings() == [] and browser.errors() == []


def picture(browser: Browser) -> str:
    return str(browser.driver.execute_script("return document.getElementById('scene').toDataURL()"))


def scene_is_drawn(browser: Browser) -> None:
    """Something is drawn, and keyboard and pointer turn it."""
    from selenium.webdriver import ActionChains

    canvas = browser.waits_for("canvas#scene")
    script = (
        "const c = document.getElementById('scene');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height);"
        "let n = 0; for (let k = 3; k < d.data.length; k += 4) n += d.data[k] > 0; return n;"
    )
    until("the scene is drawn", lambda: browser.driver.execute_script(script) > 300)
    before = picture(browser)
    browser.driver.execute_script("arguments[0].focus()", canvas)
    for key in ("\ue014", "\ue013", "+"):
        browser.press(key)
        after = until("the key changes the picture", lambda: picture(browser) != before and picture(browser))
        before = after
    ActionChains(browser.driver).click_and_hold(canvas).move_by_offset(60, 20).release().perform()
    until("the pointer changes the picture", lambda: picture(browser) != before)


def test_losses_and_progress_are_seen_while_a_job_runs_and_it_is_cancelled_and_deleted(
    server: Server, site: str, browser: Browser, scene: dict[str, Any]
) -> None:
    job = server.create(scene, settings=LONG)
    open_job(browser, site, job)
    browser.sees("Running", ".head .badge")
    for curve in ("L_num", "L_proj", "L_DAQ", "Inlier tracks"):
        browser.sees(curve, "figcaption")
    browser.sees("network iteration", ".steps")
    first = browser.text("figcaption")
    until("the curves go on", lambda: browser.text("figcaption") != first)
    browser.button("Cancel job").click()
    confirm(browser, "Cancel job")
    browser.sees("Cancelled", ".head .badge")
    assert server.state(job) == "JOB_STATE_CANCELLED"
    browser.sees("Cancelled", "#live")
    browser.button("Retry job").click()
    browser.sees("waits again", "#notices")
    browser.sees("Running", ".head .badge")
    browser.button("Cancel job").click()
    confirm(browser, "Cancel job")
    browser.sees("Cancelled", ".head .badge")
    browser.button("Delete job").click()
    confirm(browser, "Delete job")
    browser.sees("is deleted", "#notices")
    browser.sees("There are no jobs yet.")
    assert server.call("GET", "/v1/tenants/-/jobs") == {}
    assert browser.errors() == []


def test_a_dialog_that_is_left_changes_nothing(
    server: Server, site: str, browser: Browser, scene: dict[str, Any]
) -> None:
    from selenium.webdriver.common.keys import Keys

    job = server.create(scene, settings=LONG)
    open_job(browser, site, job)
    browser.button("Cancel job").click()
    until("the dialog is open", lambda: browser.all("#confirm-dialog[open]"))
    browser.press(Keys.ESCAPE)
    until("the dialog is closed", lambda: not browser.all("#confirm-dialog[open]"))
    browser.button("Cancel job").click()
    browser.button("Back").click()
    until("the dialog is closed", lambda: not browser.all("#confirm-dialog[open]"))
    assert server.state(job) in ("JOB_STATE_QUEUED", "JOB_STATE_RUNNING")


def test_hostile_text_is_shown_as_text(server: Server, site: str, browser: Browser, scene: dict[str, Any]) -> None:
    views = [{**view, "name": f"{HOSTILE}{place}"} for place, view in enumerate(scene["views"])]
    labels = {"note": HOSTILE, "<b>key</b>": "\u202e</td><script>document.title='taken'</script>"}
    job = server.create({**scene, "views": views}, labels=labels)
    browser.open(site)
    browser.sees(HOSTILE, "table")
    browser.waits_for(f"a[href='#/{job}']").click()
    browser.sees("Succeeded", ".head .badge")
    browser.sees(HOSTILE, "dl")
    until("there are views", lambda: browser.all("summary"))
    for summary in browser.all("summary"):
        summary.click()
    browser.sees(f"{HOSTILE}7", "td")
    assert browser.all("img, td script, bdi > *") == []
    assert browser.driver.title == f"Job {short(job)} - scpsfm"
    # What an address names becomes no markup and no call either.
    for part in (f"/tenants/default/jobs/{HOSTILE}", "/tenants/../../openapi.json", f"/?label={HOSTILE}=1&state=<b>"):
        browser.driver.get(f"{site}/#{part}")
        browser.driver.refresh()
        browser.waits_for("h2")
        assert browser.all("img, main b img") == []
        assert "taken" not in browser.driver.title
    assert browser.errors() == []


def test_a_label_and_a_state_filter_the_list(
    server: Server, site: str, browser: Browser, scene: dict[str, Any]
) -> None:
    ahead = server.create(scene, settings=LONG, labels={"site": "south 3"})
    until("a worker has it", lambda: server.state(ahead) == "JOB_STATE_RUNNING")
    jobs = [server.create(scene, labels={"site": "north"} if place % 2 else {"site": 'a"\\'}) for place in range(60)]
    browser.open(site)
    until("all are counted", lambda: states(browser)["Queued"] == "60" and states(browser)["Running"] == "1")
    until("a page of them is listed", lambda: len(browser.all("tbody tr")) == 50)
    browser.button("Older jobs").click()
    until("the others are listed", lambda: len(browser.all("tbody tr")) == 11)
    assert not browser.all(f"a[href='#/{jobs[-1]}']") and browser.all(f"a[href='#/{ahead}']")
    browser.button("Newer jobs").click()
    until("the first page is listed", lambda: browser.all(f"a[href='#/{jobs[-1]}']"))
    browser.button("Running").click()
    until("one is listed", lambda: [row.get_attribute("href") for row in browser.all("td a[href*=jobs]")]
          == [f"{site}/#/{ahead}"])
    browser.button("Running").click()
    for text, count in (("site=north", 30), ("site=south 3", 1), ('site=a"\\', 30), ("site=nowhere", 0)):
        field = browser.waits_for("#label")
        field.clear()
        field.send_keys(text)
        browser.button("Filter").click()
        until(f"{text} is filtered", lambda count=count: len(browser.all("tbody tr")) == count
              and "Jobs that match" in browser.text("h3"))
    browser.sees("No job matches the filter.")
    field = browser.waits_for("#label")
    field.clear()
    field.send_keys('si"te=north')
    browser.button("Filter").click()
    browser.sees("cannot be filtered by", "#notices")
    assert browser.errors() == []


def test_what_ends_without_a_result_says_why(
    server: Server, site: str, browser: Browser, scene: dict[str, Any]
) -> None:
    late = server.create(scene, settings=LONG, timeLimit="0.5s")
    open_job(browser, site, late)
    browser.sees("Deadline exceeded", ".failure")
    # Too few tracks: nothing is reconstructed, and the warnings say so in words.
    few = [k for k, track in enumerate(scene["trackIndices"]) if track < 4]
    arrays = {name: [scene[name][k] for k in few] for name in ("viewIndices", "trackIndices", "xs", "ys")}
    none = server.create({**scene, **arrays})
    browser.driver.get(f"{site}/#/{none}")
    browser.sees("No reconstruction", "dl.large")
    assert browser.all(".warnings li")
    browser.sees("There is no metric reconstruction to draw")
    browser.driver.get(f"{site}/#/tenants/default/jobs/none")
    browser.sees("JOB_NOT_FOUND", "#notices")
    browser.sees("There is no such job.")


def test_a_refusal_is_shown(server: Server, site: str, browser: Browser, scene: dict[str, Any]) -> None:
    job = server.create(scene)
    open_job(browser, site, job)
    browser.sees("Succeeded", ".head .badge")
    browser.button("Delete job").click()
    # Not before: a page that still reads the job when it goes shows no button any more.
    server.call("DELETE", f"/v1/{job}")
    confirm(browser, "Delete job")
    browser.sees("The job was not deleted", "#notices .bad")
    browser.sees("JOB_NOT_FOUND", "#notices .bad")


def test_a_job_of_an_uploaded_input_is_created_again(
    server: Server, site: str, browser: Browser, scene: dict[str, Any]
) -> None:
    uploaded = server.call("POST", "/v1/tenants/-/inputs", {"trackSet": scene})["name"]
    job = server.create(None, input=uploaded, settings={"method": "METHOD_GEOMETRY", "seed": "9"}, labels={"a": "b"})
    open_job(browser, site, job)
    browser.button("Create again").click()
    until("another job is shown", lambda: "/jobs/" in browser.driver.current_url and short(job) not in
          browser.text("h2"))
    browser.sees("Succeeded", ".head .badge")
    again = next(one for one in server.call("GET", "/v1/tenants/-/jobs")["jobs"] if one["name"] != job)
    first = server.call("GET", f"/v1/{job}")
    assert [again[field] for field in ("settings", "labels", "input")] == [
        first[field] for field in ("settings", "labels", "input")
    ]
    # What came with its job cannot be created again, and the page says why.
    direct = server.create(scene)
    browser.driver.get(f"{site}/#/{direct}")
    browser.sees("the API does not give it back")


def test_a_key_is_asked_for_and_shows_the_jobs_of_its_tenant_only(
    tmp_path: Path, browser: Browser, scene: dict[str, Any]
) -> None:
    server = Server(tmp_path, {"SCPSFM_AUTH__KEYS": f"north:{NORTH},south:{SOUTH}"})
    network = Network(server)
    site = server.url if network.serves_the_page else network.url
    try:
        jobs = {key: server.create(scene, key=key, labels={"of": key[:5]}) for key in (NORTH, SOUTH)}
        browser.open(site)

        def enter(key: str) -> None:
            until("the key is asked for", lambda: browser.all("#key-dialog[open]"))
            browser.waits_for("#key").send_keys(key)
            browser.waits_for("#key-form .primary").click()

        enter("wrong-0123456789abcdef0123456789abcdef")
        browser.sees("API_KEY_UNKNOWN", "#key-reason")
        enter(NORTH)
        browser.sees(short(jobs[NORTH]), "table")
        browser.sees("Tenant north", "header")
        assert short(jobs[SOUTH]) not in browser.text()
        storage = browser.driver.execute_script(
            "return [JSON.stringify(sessionStorage), JSON.stringify(localStorage), document.cookie, location.href]"
        )
        assert NORTH in storage[0] and not any(NORTH in other for other in storage[1:])
        browser.driver.get(f"{site}/#/{jobs[SOUTH]}")
        browser.sees("JOB_NOT_FOUND", "#notices")
        browser.button("Forget API key").click()
        enter(SOUTH)
        browser.sees(short(jobs[SOUTH]), "table")
        assert short(jobs[NORTH]) not in browser.text()
        # Refused calls are all that the console of the browser tells.
        assert all("401" in error or "404" in error for error in browser.errors())
    finally:
        network.stop()
        server.stop()


def test_a_broken_stream_goes_on_after_the_last_event(
    server: Server, network: Network, browser: Browser, scene: dict[str, Any]
) -> None:
    network.cuts = [1, 2, 3]
    job = server.create(scene, settings=LONG)
    open_job(browser, network.url, job)
    until("it has connected again and again", lambda: len(network.streams) == 4)
    asked = [int(stream.get("last-event-id", 0)) for stream in network.streams]
    assert asked == [0, 1, 3, 6], "nothing is missed or repeated"
    browser.sees("network iteration", ".steps")


def test_a_server_that_is_away_is_said_and_found_again(
    server: Server, network: Network, browser: Browser, scene: dict[str, Any]
) -> None:
    job = server.create(scene, settings=LONG)
    open_job(browser, network.url, job)
    browser.sees("Running", ".head .badge")
    with down(network):
        browser.sees("Next try in", "#notices")
    until("the notice is gone", lambda: browser.text("#notices") == "")
    server.call("POST", f"/v1/{job}:cancel", {})
    browser.sees("Cancelled", ".head .badge")
    browser.driver.get(f"{network.url}/#/")
    browser.sees(short(job), "table")
    with down(network):
        browser.sees("Next try in", "#notices")
    until("the notice is gone", lambda: browser.text("#notices") == "")


def test_it_works_by_keyboard_alone(server: Server, site: str, browser: Browser, scene: dict[str, Any]) -> None:
    from selenium.webdriver.common.keys import Keys

    job = server.create(scene, settings=LONG)
    until("a worker has it", lambda: server.state(job) == "JOB_STATE_RUNNING")
    browser.open(site)
    browser.sees(short(job), "table")
    browser.tab_to("Skip to content")
    browser.press(Keys.ENTER)
    # A space presses a button.
    browser.tab_to("Running")
    browser.press(Keys.SPACE)
    until("the list is filtered", lambda: "state=RUNNING" in browser.driver.current_url)
    browser.sees(short(job), "table")
    browser.tab_to(short(job))
    browser.press(Keys.ENTER)
    browser.sees("Running", ".head .badge")
    until("the new page begins at its heading", lambda: browser.focused().startswith("Job "))
    browser.tab_to("Cancel job")
    browser.press(Keys.ENTER)
    until("the dialog is open", lambda: browser.all("#confirm-dialog[open]"))
    assert browser.focused() == "Back", "what does no harm comes first"
    browser.press(Keys.TAB)
    browser.press(Keys.ENTER)
    browser.sees("Cancelled", ".head .badge")
    browser.tab_to("Delete job")
    browser.press(Keys.ENTER)
    until("the dialog is open", lambda: browser.all("#confirm-dialog[open]"))
    browser.press(Keys.TAB)
    browser.press(Keys.ENTER)
    browser.sees("is deleted", "#notices")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(
    server: Server, site: str, browser: Browser, scene: dict[str, Any], scheme: str
) -> None:
    done = server.create(scene, labels={"site": "north"})
    until("it has ended", lambda: server.state(done) == "JOB_STATE_SUCCEEDED")
    running = server.create(scene, settings=LONG)
    late = server.create(scene, timeLimit="0.001s")
    browser.open(site)
    browser.scheme(scheme)
    browser.sees(short(done), "table")
    assert browser.findings() == []
    browser.driver.get(f"{site}/#/{running}")
    browser.sees("L_proj", "figcaption")
    assert browser.findings() == []
    browser.button("Cancel job").click()
    until("the dialog is open", lambda: browser.all("#confirm-dialog[open]"))
    assert browser.findings() == []
    browser.button("Back").click()
    server.call("POST", f"/v1/{running}:cancel", {})
    browser.driver.get(f"{site}/#/{late}")
    browser.waits_for(".failure")
    assert browser.findings() == []
    browser.driver.get(f"{site}/#/{done}")
    browser.waits_for("canvas#scene")
    for summary in browser.all("summary"):
        summary.click()
    assert browser.findings() == []
    # A narrow window scrolls its tables, not the page.
    browser.driver.set_window_size(500, 900)
    widths = "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    until("the page fits", lambda: len({*browser.driver.execute_script(widths)}) == 1)
    assert browser.findings() == []


def test_a_hidden_page_asks_nothing(server: Server, network: Network, browser: Browser, scene: dict[str, Any]) -> None:
    job = server.create(scene, settings=LONG)
    open_job(browser, network.url, job)
    browser.sees("network iteration", ".steps")
    until("it follows", lambda: len(network.streams) == 1)
    hide = (
        "Object.defineProperty(document, 'visibilityState', {value: arguments[0], configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'));"
    )
    browser.driver.execute_script(hide, "hidden")
    browser.driver.execute_script(hide, "visible")
    until("it goes on", lambda: len(network.streams) == 2)
    assert int(network.streams[1]["last-event-id"]) > 0
    assert browser.text("#notices") == ""
