"""The animated HTML page of a scene plays from the disk without any network request."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.drive.episodes import made
from tests.drive.page import page_at
from workbench.share.scene_html import write_scene_html

DRAWN = """before => {
    const said = document.querySelector(".wb-caption").innerText;
    const step = parseInt(said.split("step ")[1]);
    return said !== before && Object.values(window.__viserSceneTree.getState()).some(node => {
        const p = node.message?.props?.batched_positions;
        if (!p) return false;
        const x = new DataView(p.buffer, p.byteOffset, 4).getFloat32(0, true);
        return Math.abs(x - 0.03 * step) < 1e-4;
    });
}"""
"""Whether the caption shows another step than before, and the cube is drawn at its pose of that step."""


@pytest.mark.slow
def test_a_scene_page_plays_without_a_server(tmp_path: Path, browser: Browser) -> None:
    episode = made(20, seed=7, speed=0.03, task="Made & <b>", control_dt=0.1)
    path, done = tmp_path / "a.html", []
    write_scene_html(path, episode, on_progress=done.append)
    assert done == sorted(done) and done[-1] == 1.0
    asked: list[str] = []
    with page_at(browser, "about:blank", 320, 240, drawn=True) as (tab, _):
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(path.as_uri())
        time_shown = tab.locator("input").first
        tab.wait_for_function(
            "() => document.querySelector('input') && parseFloat(document.querySelector('input').value) > 0.3"
        )
        assert float(time_shown.input_value()) <= 3.2
        # The caption shows the episode's own time, and stops at its end while the last state is held.
        tab.wait_for_function(
            "() => document.querySelector('#wb-time').textContent === 'step 20 of 20, 2.00 of 2.00 s'"
        )
        caption = tab.locator(".wb-caption")
        assert "Made & <b>, seed 7" in caption.inner_text()
        assert not time_shown.is_visible(), "the player's clock runs on while the last state is held"
        tab.keyboard.press("Space")
        before = caption.inner_text()
        for x in (120, 60):
            tab.locator(".mantine-Slider-root").first.click(position={"x": x, "y": 5})
            tab.wait_for_function(DRAWN, arg=before)
            before = caption.inner_text()
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []


def test_a_scene_page_overwrites_no_file(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text("mine")
    with pytest.raises(FileExistsError):
        write_scene_html(tmp_path / "a.html", made())
    assert (tmp_path / "a.html").read_text() == "mine"
