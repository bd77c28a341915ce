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

from workbench.session.clearance import Answer, AskedFile, Question, Since
from workbench.ui import trust_dialog
from workbench.ui.trust_dialog import ALWAYS, DO_NOT, ONCE, TrustDialog, question_html

PUSH = AskedFile("/work/push.py", "0123456789ab", "import helper\n")
HELPER = AskedFile("helper.py", "ba9876543210", "A = 1\n")
PLAIN = Question("Push-v1", False, (PUSH, HELPER))


def about(name: str) -> Question:
    return replace(PLAIN, files=(replace(PUSH, name=name),))


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
    second = asked(dialog, about("/work/other.py"))
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
    futures = {name: asked(dialog, about(name)) for name in ("a.py", "b.py", "c.py")}
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
    many = tuple(AskedFile(f"m{k}.py", f"{k:012}", f"# {k}\n") for k in range(300))
    evil = AskedFile("/w/<script>.py", "0123456789ab", "x = '</pre><script>alert(1)</script>\u202e'\n")
    said = question_html(Question("Push-v1", False, (evil, *many), ("<b>",)))
    assert "<script>" not in said and "<b><" not in said and "&lt;script&gt;.py" in said
    assert "&lt;/pre&gt;" in said and "\\u202e" in said, "the text, escaped"
    assert all(one.name in said and one.hash in said and one.text in said for one in many)
    assert "It imports from beside it (300)" in said and "trusted" not in said and "every save" not in said
    held = (AskedFile("push.py", "0" * 12, ""), HELPER)
    said = question_html(Question("<i>Push</i>-v1", True, held))
    assert "&lt;i&gt;Push" in said and "hold the text of their task" in said
    assert "what it may import (1)" in said and "It imports" not in said


def test_what_changed_since_it_was_trusted_is_marked_file_by_file() -> None:
    other = AskedFile("new.py", "1" * 12, "", Since.NEW)
    files = (PUSH, replace(HELPER, since=Since.CHANGED), other)
    said = question_html(replace(PLAIN, files=files, trusted_before=True, gone=("old.py",)))
    main, helper, new = said.split("<details>")[1:]
    assert "wb-tag" not in main and ">changed<" in helper and ">new<" in new
    assert "What has changed since is marked; gone since: old.py" in said
    said = question_html(replace(PLAIN, trusted_before=True))
    assert "Which of them has changed since is not known" in said


def test_what_going_live_means_is_said_before() -> None:
    said = question_html(replace(PLAIN, followed=True))
    assert "every save of this file and of the modules beside it runs without asking" in said
    assert "Judge again takes the file as it is" in said
    assert "Its text may run already" in question_html(replace(PLAIN, followed=True, agreed=True))
    assert "until the workbench ends" in ONCE


def test_where_imports_are_computed_no_module_is_said_to_be_imported() -> None:
    assert "it may import all that lies beside it (1)" in question_html(replace(PLAIN, computed=True))


def test_what_of_a_text_is_not_shown_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust_dialog, "MOST_OF_ONE", 10)
    monkeypatch.setattr(trust_dialog, "MOST_OF_ALL", 12)
    said = question_html(PLAIN)
    assert "The last 4 characters are not shown here: read the file itself" in said
    assert "import hel" in said and "import help" not in said and "read the recording" not in said
    assert "read the recording's .json" in question_html(replace(PLAIN, recorded_text=True))
