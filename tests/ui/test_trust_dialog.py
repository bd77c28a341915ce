"""The window that asks whether code may run, on a real server without a browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import pytest
import viser

from workbench.session.clearance import Answer, Question
from workbench.ui.trust_dialog import ALWAYS, DO_NOT, ONCE, TrustDialog, question_html

PLAIN = Question("/work/push.py", "Push-v1", False, "0123456789ab", ("helper.py",), (), False)


def asked(
    dialog: TrustDialog, question: Question = PLAIN, stopped: Callable[[], bool] = lambda: False
) -> Future[Answer]:
    """Ask on a thread of its own, as whatever wants to run code does."""
    future: Future[Answer] = Future()
    threading.Thread(target=lambda: future.set_result(dialog.ask(question, stopped)), daemon=True).start()
    return future


def buttons(server: viser.ViserServer) -> dict[str, Any]:
    """Those of the window, by their labels."""
    handles = server.gui._gui_input_handle_from_uuid.values()
    return {handle.label: handle for handle in handles if isinstance(handle, viser.GuiButtonHandle)}


def window_with(server: viser.ViserServer, text: str) -> dict[str, Any]:
    deadline = time.monotonic() + 20
    while text not in shown(server) or ALWAYS not in buttons(server):
        assert time.monotonic() < deadline, f"no window with {text}"
        time.sleep(0.01)
    return buttons(server)


def shown(server: viser.ViserServer) -> str:
    handles = [
        child
        for modal in list(server.gui._modal_handle_from_uuid.values())
        for child in list(modal._children.values())
    ]
    return "".join(child.content for child in handles if isinstance(child, viser.GuiHtmlHandle))


def press(handle: Any) -> None:
    for callback in list(handle._impl.update_cb):
        callback(viser.GuiEvent(None, None, handle))


@pytest.fixture
def dialog(server: viser.ViserServer) -> TrustDialog:
    return TrustDialog(server)


@pytest.mark.parametrize(
    ("label", "answer"), [(DO_NOT, Answer.NO), (ONCE, Answer.ONCE), (ALWAYS, Answer.ALWAYS)]
)
def test_a_press_is_the_answer_and_the_window_goes(
    dialog: TrustDialog, server: viser.ViserServer, label: str, answer: Answer
) -> None:
    future = asked(dialog)
    press(window_with(server, "/work/push.py")[label])
    assert future.result(20) is answer
    assert not buttons(server) and not server.gui._modal_handle_from_uuid
    assert not server.gui._command_handle_from_uuid, "Escape is free again"


def test_only_the_first_answer_counts_and_none_comes_before_its_question(
    dialog: TrustDialog, server: viser.ViserServer
) -> None:
    future = asked(dialog)
    old = window_with(server, "/work/push.py")
    press(old[DO_NOT])
    press(old[ALWAYS])
    assert future.result(20) is Answer.NO
    second = asked(dialog, replace(PLAIN, file="/work/other.py"))
    window_with(server, "/work/other.py")
    press(old[ALWAYS])
    assert not second.done()
    press(buttons(server)[DO_NOT])
    assert second.result(20) is Answer.NO


def test_escape_is_a_no(dialog: TrustDialog, server: viser.ViserServer) -> None:
    future = asked(dialog)
    window_with(server, "/work/push.py")
    (escape,) = server.gui._command_handle_from_uuid.values()
    for callback in list(escape._impl.trigger_cb):  # type: ignore[attr-defined]
        callback(None)  # type: ignore[arg-type]
    assert future.result(20) is Answer.NO


def test_questions_come_one_after_the_other(dialog: TrustDialog, server: viser.ViserServer) -> None:
    futures = {name: asked(dialog, replace(PLAIN, file=name)) for name in ("a.py", "b.py", "c.py")}
    order = []
    for _ in futures:
        deadline = time.monotonic() + 20
        while not (names := [name for name in futures if name in shown(server)]):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        (name,) = names
        order.append(name)
        press(window_with(server, name)[ONCE])
        assert futures[name].result(20) is Answer.ONCE
    assert set(order) == set(futures)


def test_a_page_that_is_rebuilt_shows_the_question_again(
    dialog: TrustDialog, server: viser.ViserServer
) -> None:
    future = asked(dialog)
    window_with(server, "/work/push.py")
    with server.atomic():
        server.gui.reset()
    press(window_with(server, "/work/push.py")[ONCE])
    assert future.result(20) is Answer.ONCE


def test_what_is_withdrawn_and_what_is_asked_at_the_end_is_a_no(
    dialog: TrustDialog, server: viser.ViserServer
) -> None:
    stop = threading.Event()
    future = asked(dialog, PLAIN, stop.is_set)
    window_with(server, "/work/push.py")
    stop.set()
    assert future.result(20) is Answer.NO and not buttons(server)
    future = asked(dialog)
    window_with(server, "/work/push.py")
    dialog.close()
    assert future.result(20) is Answer.NO and asked(dialog).result(20) is Answer.NO


def test_the_window_says_what_would_run_and_escapes_it() -> None:
    question = Question(
        "/w/<script>.py",
        "Push-v1",
        False,
        "0123456789ab",
        tuple(f"m{k}.py" for k in range(12)),
        ("<b>",),
        True,
    )
    said = question_html(question)
    assert "<script>" not in said and "<b><" not in said and "&lt;script&gt;.py" in said
    assert "m7.py" in said and "m8.py" not in said and "and 4 more" in said
    assert "0123456789ab" in said and "trusted another text of this file before" in said
    said = question_html(Question("push.py", "<i>Push</i>-v1", True, "0" * 12, (), (), False))
    assert "&lt;i&gt;Push" in said and "hold the text of their task" in said
