"""A command key does not also move the 3-D view."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from tests.drive.page import close_notice, page_at
from tests.drive.waiting import until
from workbench.commands import COMMANDS
from workbench.live.commands import Step
from workbench.live.timeline_commands import StepBack
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.page.widgets.keys_and_palette import register
from workbench.page.widgets.visitors import PATH, Visitors

pytestmark = pytest.mark.browser


@pytest.mark.slow
def test_command_keys_do_not_move_the_view(browser: Browser) -> None:
    gated_server = open_server(ServerOptions(port=0))
    stepped, walked = threading.Event(), threading.Event()
    visitors = Visitors(gated_server.server, COMMANDS)
    gated_server.add_channel(PATH, visitors.serve)
    events = {Step(): stepped, StepBack(): walked}
    visitors.do = lambda command, visitor: events[command].set()
    register(gated_server.server, visitors, {Step, StepBack}, "live page")
    # It is drawn after the commands: a key that is pressed before the page knows them is lost.
    gated_server.server.gui.add_markdown("the commands are there")
    try:
        with page_at(browser, gated_server.url, 1000, 600) as (page, _):
            expect(page.get_by_text("the commands are there")).to_be_visible(timeout=60_000)
            until(lambda: len(gated_server.server.get_clients()) == 1, "the page")
            (client,) = gated_server.server.get_clients().values()
            until(lambda: client.camera.image_width > 300, "the view")
            close_notice(page)  # it stands where the view is dragged
            before = client.camera.position.copy()
            for key in ("s", "ArrowLeft", "w", "e", "ArrowUp"):
                page.keyboard.down(key)
                page.wait_for_timeout(
                    300
                )  # the duration is under test: viser moves its view while a key is down
                page.keyboard.up(key)
            until(lambda: stepped.is_set() and walked.is_set(), "the commands")
            # View updates arrive in order: after that of a drag, all earlier ones have arrived.
            np.testing.assert_allclose(client.camera.position, before, atol=1e-6)
            page.mouse.move(200, 400)
            page.mouse.down()
            page.mouse.move(260, 400, steps=6)
            page.mouse.up()
            until(lambda: not np.allclose(client.camera.position, before), "the view that is dragged")
            height = client.camera.position[2]
            assert height == pytest.approx(before[2], abs=1e-3), "a key moved the view up or down"
    finally:
        gated_server.close()
