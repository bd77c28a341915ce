"""The response headers: what they forbid, and that each exception in the page's policy is needed."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh
import trimesh.visual
import trimesh.visual.material
from PIL import Image
from playwright.sync_api import Page

from tests.drive.knocking import ask
from tests.drive.page import page_at
from tests.drive.waiting import until
from workbench.commands import COMMANDS
from workbench.machine.folders import web_assets_folder
from workbench.page.door.gated_server import GatedServer
from workbench.page.door.responses import DIRECTIVES
from workbench.page.widgets.visitors import PATH, Visitors


@pytest.fixture
def filled(gated_server: GatedServer) -> GatedServer:
    """A page with one of each thing that a policy could break: blobs, data, workers, wasm, frames."""
    server = gated_server.server
    server.gui.add_html(
        "<div id='from-html' style='color: red'>html</div><img id='logo' src='/workbench/logo.svg'>"
        "<iframe src='/workbench/logo.svg'></iframe>"
    )
    server.gui.add_image(np.zeros((8, 8, 3), np.uint8))
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((len(box.vertices), 2)),
        material=trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.new("RGB", (4, 4), (200, 30, 30))
        ),
    )
    server.scene.add_mesh_trimesh("/box", box)
    server.scene.add_camera_frustum("/frustum", fov=1.0, aspect=1.0, image=np.zeros((8, 8, 3), np.uint8))
    server.scene.configure_environment_map("city", background=True)
    return gated_server


def policy_errors_of(page: Page) -> list[str]:
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    return complaints


# Without a browser --------------------------------------------------------------------------------


def test_no_template_has_inline_code():
    for template in (web_assets_folder() / "panels").glob("*.html"):
        assert not re.findall(r'(?:^|\s)on[a-z]+="', template.read_text(encoding="utf-8")), template


def test_code_comes_only_from_files_and_known_hashes():
    sources = DIRECTIVES["script-src"].split()
    assert "'unsafe-inline'" not in sources and "'unsafe-eval'" not in sources
    assert not [source for source in sources if source.startswith(("http", "blob:", "data:", "*"))]
    assert DIRECTIVES["default-src"] == "'none'"


def test_every_reply_isolates_the_page_and_denies_devices(gated_server):
    for path in ("/", "/none", "/workbench/logo.svg", "/workbench/none", "/?token=wrong"):
        headers = ask(gated_server, path)[1]
        assert (
            headers["X-Content-Type-Options"] == "nosniff" and headers["Referrer-Policy"] == "no-referrer"
        ), path
        assert headers["X-Frame-Options"] == "SAMEORIGIN", path
        assert "frame-ancestors 'self'" in headers["Content-Security-Policy"], path
        assert headers["Cross-Origin-Opener-Policy"] == "same-origin", path
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin", path
        for device in ("camera", "microphone", "geolocation", "usb", "serial", "display-capture"):
            assert f"{device}=()" in headers["Permissions-Policy"], path


# In a real browser --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.browser
def test_a_real_browser_opens_the_page_without_errors(filled, browser):
    with page_at(browser, "about:blank", 640, 480, drawn=True) as (page, complaints):
        page.on(
            "requestfailed",
            lambda request: complaints.append(f"{request.url[:100]} {request.failure}"),
        )
        page.goto(filled.url, wait_until="domcontentloaded")
        page.wait_for_selector("#from-html", timeout=60_000)
        page.wait_for_function("() => document.getElementById('logo').naturalWidth > 0", timeout=60_000)
        until(filled.server.get_clients, "the page")
        assert page.url == f"http://127.0.0.1:{filled.port}/", "the token is no longer in the address bar"
        assert page.evaluate("document.cookie") == "", "no script can read it"
        (cookie,) = page.context.cookies()
        assert (cookie.get("httpOnly"), cookie.get("sameSite")) == (True, "Strict")
        # No event marks the last refusal, so give everything this long to load.
        page.wait_for_timeout(3000)
        page.reload(wait_until="domcontentloaded")  # with the cookie only
        page.wait_for_selector("#from-html", timeout=60_000)
    assert complaints == []


@pytest.mark.slow
@pytest.mark.browser
def test_code_injected_as_html_does_not_run(gated_server, browser):
    attacks = (
        '<img src="/none" onerror="document.title=\'ran\'">',
        "<svg onload=\"document.title='ran'\"></svg>",
        "<script>document.title='ran'</script>",
        "<iframe srcdoc=\"<script>parent.document.title='ran'</script>\"></iframe>",
        "<a id='link' href=\"javascript:document.title='ran'\">x</a>",
        "<div onclick=\"wb.follow(this);document.title='ran'\" id='click'>x</div>",
        "<object data=\"javascript:document.title='ran'\"></object><embed src='data:text/html,x'>",
        "<style onload=\"document.title='ran'\"></style><base href='//evil.example/'>",
    )
    handle = gated_server.server.gui.add_html("".join(attacks) + "<p id='there'>x</p>")
    refused = {"inline event handler": 4, "inline script": 2, "JavaScript URL": 1, "plugin": 1, "base URI": 1}
    with page_at(browser, gated_server.url) as (page, complaints):
        page.wait_for_selector("#there", timeout=60_000)
        page.evaluate("document.getElementById('link').click(); document.getElementById('click').click()")
        page.evaluate(
            """() => { const s = document.createElement('script'); s.textContent = "document.title='ran'";
            document.head.append(s) }"""
        )

        def were() -> dict[str, int]:
            page.wait_for_timeout(50)  # for Playwright to receive them
            return {what: sum(what in complaint for complaint in complaints) for what in refused}

        until(lambda: were() == refused, "the browser's report of each refusal", seen=were)
        assert page.title() != "ran"
    handle.remove()


@pytest.mark.slow
@pytest.mark.browser
def test_a_page_whose_token_was_renewed_says_what_to_do(gated_server, browser):
    gated_server.add_channel(PATH, Visitors(gated_server.server, COMMANDS).serve)
    with page_at(browser, gated_server.url) as (page, _):
        page.wait_for_selector("[data-page]", state="attached")
        gated_server.renew_token()
        page.wait_for_selector("text=Open the address that the terminal shows", timeout=60_000)
        page.goto(gated_server.url, wait_until="domcontentloaded")
        page.wait_for_selector("canvas", timeout=60_000)


@pytest.mark.browser
@pytest.mark.slow
def test_each_exception_is_needed(filled, browser, monkeypatch):
    # In Chromium 'self' includes ws:, but not in every browser; input.js needs connect-src 'self' when the connection
    # is refused, see the test above.
    elsewhere = {("connect-src", source) for source in ("'self'", "ws://{authority}", "wss://{authority}")}
    # viser's scripts, by hash; without one of them there is no page.
    exceptions = [
        (name, source)
        for name, sources in DIRECTIVES.items()
        for source in sources.split()
        if source != "'none'" and name != "frame-ancestors" and (name, source) not in elsewhere
    ]

    def load() -> list[str]:
        page = browser.new_page(viewport={"width": 640, "height": 480})
        complaints = policy_errors_of(page)
        page.goto(filled.url, wait_until="domcontentloaded")
        # The first error is enough; to see none, wait until everything has loaded.
        for _ in range(80):
            page.wait_for_timeout(100)
            if complaints:
                break
        page.close()
        return complaints

    assert load() == []
    needless = []
    for name, source in exceptions:
        others = " ".join(other for other in DIRECTIVES[name].split() if other != source) or "'none'"
        with monkeypatch.context() as without:
            without.setitem(DIRECTIVES, name, others)
            if not load():
                needless.append(f"{name} {source}")
    assert needless == []
