from __future__ import annotations

import asyncio
import time
from types import SimpleNamespace

import pytest
import viser
from viser._messages import GuiUpdateMessage
from viser.infra import ClientId

from workbench.ui import controls
from workbench.ui.checked import checked_int
from workbench.ui.controls import Control


class Page:
    """What a browser tells the server when someone moves an input, and the notices it was sent."""

    def __init__(self, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> None:
        self.server = server
        self.notices: list[str] = []
        client = SimpleNamespace(add_notification=lambda title, body, **_: self.notices.append(body))
        monkeypatch.setattr(server.gui, "_resolve_client", lambda client_id: client)

    def moves(self, handle: viser.GuiInputHandle, value: object) -> None:
        message = GuiUpdateMessage(handle._impl.uuid, {"value": value})
        loop = self.server.gui._event_loop
        asyncio.run_coroutine_threadsafe(
            self.server.gui._handle_gui_updates(ClientId(1), message), loop
        ).result(5)


@pytest.fixture
def page(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> Page:
    return Page(server, monkeypatch)


def wait_for(condition) -> None:
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


def env_slider(page: Page, sent: list[int], settle: float = 0.0) -> Control:
    slider = page.server.gui.add_slider("env", min=0, max=15, step=1, initial_value=0)
    return Control(slider, lambda value: checked_int(value, 0, 15, "env"), sent.append, settle=settle)


def test_what_a_person_moves_is_asked_of_the_session(page: Page) -> None:
    sent: list[int] = []
    control = env_slider(page, sent)
    page.moves(control.handle, 7)
    wait_for(lambda: sent == [7])


def test_what_the_session_says_is_shown_and_not_sent_back(page: Page) -> None:
    sent: list[int] = []
    control = env_slider(page, sent)
    control.show(5)
    assert control.handle.value == 5
    time.sleep(0.1)
    assert sent == []


def test_slider_in_someone_s_hand_is_left_alone_for_a_moment(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    control = env_slider(page, [])
    page.moves(control.handle, 7)
    wait_for(lambda: control._touched > 0)
    control.show(3)
    assert control.handle.value == 7
    monkeypatch.setattr(controls, "HANDS_OFF", 0.0)
    control.show(3)
    assert control.handle.value == 3


def test_value_out_of_range_is_refused_with_a_word_and_taken_back(page: Page) -> None:
    sent: list[int] = []
    control = env_slider(page, sent)
    page.moves(control.handle, 99999)
    wait_for(lambda: page.notices)
    assert sent == []
    assert "0 to 15" in page.notices[0]
    control.show(2)
    assert control.handle.value == 2


def test_text_that_is_still_being_typed_is_not_sent(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[int] = []
    control = env_slider(page, sent, settle=3600.0)
    for value in (1, 12):
        page.moves(control.handle, value)
    wait_for(lambda: control._waiting is not None)
    control.show(0)
    assert sent == []
    monkeypatch.setattr(control, "_settle", 0.0)
    control.show(0)
    assert sent == [12]
