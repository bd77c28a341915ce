"""Rerun's viewer on the page's server: what is served, to whom, and that no other server is asked."""

from __future__ import annotations

import gzip
import http.client
import threading
import urllib.parse
from pathlib import Path

import pytest
import rerun as rr
from playwright.sync_api import Browser, Request

from tests.drive.page import page_at
from tests.drive.waiting import until
from workbench.commands import COMMANDS
from workbench.episodes.rerun.viewer import VIEWER_FILES, web_viewer_folder
from workbench.page.door.access import cookie_name
from workbench.page.door.file_response import Downloads
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.visitors import PATH, Visitors
from workbench.share.rerun_panel import RerunPages, RerunView


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "Push ä <b>.rrd"
    stream = rr.RecordingStream("workbench", recording_id="one")
    stream.save(path)
    for step in range(30):
        stream.set_time("step", sequence=step)
        stream.log("reward", rr.Scalars(1.0))
    stream.disconnect()
    return path


@pytest.fixture
def pages(child_process: None, gated_server: GatedServer) -> RerunPages:
    return RerunPages(gated_server, Downloads(gated_server.add_route))


def get(gated_server: GatedServer, path: str, **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", gated_server.port, timeout=30)
    cookie = {"Cookie": f"{cookie_name(gated_server.port)}={gated_server.url.partition('token=')[2]}"}
    try:
        connection.request("GET", path, headers={**cookie, **headers})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def test_a_file_is_sent_completely_and_only_under_its_generated_address(
    gated_server: GatedServer, tmp_path: Path
) -> None:
    offers = Downloads(gated_server.add_route)
    big = tmp_path / "big one.rrd"
    big.write_bytes(bytes(range(256)) * 20_000)
    address = offers.address(big)
    assert address == offers.address(big)
    status, headers, body = get(gated_server, address)
    assert (status, body == big.read_bytes()) == (200, True)
    assert headers["Content-Length"] == str(big.stat().st_size)
    assert "sandbox" in headers["Content-Security-Policy"]
    assert get(gated_server, f"/offered/{'x' * 22}/big%20one.rrd")[0] == 404
    assert get(gated_server, f"/offered/{urllib.parse.quote(str(big))}")[0] == 404
    assert get(gated_server, address, Cookie="")[0] == 403
    saved = get(gated_server, offers.address(big, download=True))[1]
    assert saved["Content-Disposition"] == "attachment; filename*=UTF-8''big%20one.rrd"
    big.unlink()
    assert get(gated_server, address)[0] == 404


def test_the_viewer_is_sent_compressed_to_clients_that_accept_it(
    gated_server: GatedServer, pages: RerunPages, recording: Path
) -> None:
    viewer = get(gated_server, pages.address([recording]))[2].decode().partition('location.replace("')[2]
    root = viewer.partition('"')[0]
    assert get(gated_server, root + "index.html")[1]["Content-Type"] == VIEWER_FILES["index.html"]
    for name, kind in list(VIEWER_FILES.items())[1:]:
        packed = (web_viewer_folder() / f"{name}.gz").read_bytes()
        status, headers, body = get(gated_server, root + name, **{"Accept-Encoding": "gzip"})
        assert (status, headers["Content-Type"], headers["Content-Encoding"]) == (200, kind, "gzip")
        assert body == packed
        assert "connect-src 'self'" in headers["Content-Security-Policy"]
    status, headers, body = get(gated_server, root + "re_viewer.js")
    assert "Content-Encoding" not in headers
    assert body == gzip.decompress((web_viewer_folder() / "re_viewer.js.gz").read_bytes())
    for name in ("", "../secret", "index.html.gz"):
        assert get(gated_server, root + name)[0] == 404


@pytest.mark.slow
def test_the_page_opens_the_recording_beside_the_scene_and_asks_no_other_server(
    gated_server: GatedServer, pages: RerunPages, recording: Path, browser: Browser
) -> None:
    library = gated_server.server.gui.add_panel()
    with library.add_tab("Library"):
        gated_server.server.gui.add_html("...")
    library.dock_left()
    library.minimize()
    visitors = Visitors(gated_server.server, COMMANDS)
    gated_server.add_channel(PATH, visitors.serve)
    view = RerunView(gated_server.server, pages, lambda fold: 850)
    visitors.do = view.do
    stopping = threading.Event()

    def draw() -> None:
        while not stopping.wait(0.1):
            view.draw([recording], moments={recording: 12})

    threading.Thread(target=draw, daemon=True).start()
    asked: list[Request] = []
    failed: dict[str, str | None] = {}
    with page_at(browser, "about:blank", 1280, 720, drawn=True) as (tab, _):
        tab.on("request", lambda request: asked.append(request))
        tab.on("requestfailed", lambda request: failed.update({request.url: request.failure}))
        tab.goto(gated_server.url)
        with tab.expect_response(lambda answer: "/offered/" in answer.url, timeout=120_000) as answer:
            tab.get_by_role("button", name="Open in rerun").click()
        assert answer.value.status == 200
        frame = tab.frame_locator("iframe.wb-rerun")
        frame.locator("canvas.visible").wait_for(timeout=90_000)
        # The viewer's own state: the cursor of the timeline "step" is at 12.
        inside = next(frame for frame in tab.frames if "/rerun/viewer-" in frame.url)
        state = "() => new TextDecoder().decode(window._handle.viewer_state())"
        until(
            lambda: "step\x10\x01\x1a\x02\x08\x0c" in inside.evaluate(state), "the moment that was asked for"
        )
        tab.get_by_text("from step 12").wait_for()
        width = "document.querySelector('iframe.wb-rerun').clientWidth"
        until(lambda: tab.evaluate(width) > 450, "half of the page")
        assert tab.evaluate("document.activeElement.tagName") != "IFRAME", (
            "the page must keep the keyboard focus"
        )
        tab.get_by_role("button", name="Close rerun").click()
        tab.locator("iframe.wb-rerun").wait_for(state="detached")
    stopping.set()
    ours = f"http://127.0.0.1:{gated_server.port}/"
    foreign = {
        r.url
        for r in asked
        if not r.url.startswith((ours, f"ws://127.0.0.1:{gated_server.port}", "data:", "blob:"))
    }
    assert {url: failed.get(url) for url in foreign} == dict.fromkeys(foreign, "csp")
    assert foreign, "rerun's page no longer asks other servers; the policy can be simpler"
