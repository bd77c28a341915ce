"""The dialog that asks whether code may run, on a real server without a browser."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace

import pytest

from tests.drive.panels import Panels
from tests.drive.waiting import until
from workbench.page.command import Command
from workbench.page.commands import AnswerTrust
from workbench.page.widgets.visitors import Visitor
from workbench.trust.clearance import CodeFile, Consent, Since, TrustQuestion
from workbench.trust.consent_dialog import ALWAYS, DO_NOT, ONCE, TrustDialog, question_html

PUSH = CodeFile("/home/me/push.py", "0123456789ab", "import helper\n")
HELPER = CodeFile("helper.py", "ba9876543210", "A = 1\n")
PLAIN = TrustQuestion("Push-v1", False, (PUSH, HELPER))


def about(name: str) -> TrustQuestion:
    return replace(PLAIN, files=(replace(PUSH, name=name),))


def asked(
    dialog: TrustDialog, question: TrustQuestion = PLAIN, stopped: Callable[[], bool] = lambda: False
) -> Future[Consent]:
    """Ask on a separate thread, as code loading does."""
    future: Future[Consent] = Future()
    threading.Thread(target=lambda: future.set_result(dialog.ask(question, stopped)), daemon=True).start()
    return future


def shown(
    dialog: TrustDialog,
    panels: Panels,
    question: TrustQuestion = PLAIN,
    stopped: Callable[[], bool] = lambda: False,
) -> Future[Consent]:
    """Ask, and wait for the window."""
    future = asked(dialog, question, stopped)
    window_with(panels, question.files[0].name)
    return future


def window_with(panels: Panels, text: str) -> None:
    until(lambda: text in panels.html() and panels.shows(ALWAYS), f"the window with {text}")


@pytest.fixture
def dialog(panels: Panels) -> TrustDialog:
    dialog = TrustDialog(panels.server)

    def do(command: Command, visitor: Visitor) -> None:
        assert isinstance(command, AnswerTrust)
        dialog.answer(command)

    panels.visitors.do = do
    return dialog


@pytest.mark.parametrize(
    ("label", "answer"), [(DO_NOT, Consent.NO), (ONCE, Consent.ONCE), (ALWAYS, Consent.ALWAYS)]
)
def test_a_press_answers_and_closes_the_dialog(
    dialog: TrustDialog, panels: Panels, label: str, answer: Consent
) -> None:
    future = shown(dialog, panels)
    panels.press(label)
    assert future.result(20) is answer
    assert not panels.shows(label) and panels.html() == ""


def test_only_the_first_answer_counts_and_none_before_its_question(
    dialog: TrustDialog, panels: Panels
) -> None:
    future = shown(dialog, panels)
    refuse, allow = (panels.button(label).command for label in (DO_NOT, ALWAYS))
    assert refuse is not None and allow is not None
    panels.do(refuse)
    panels.do(allow)
    assert future.result(20) is Consent.NO
    panels.do(allow)
    second = shown(dialog, panels, about("/home/me/other.py"))
    panels.do(allow)
    assert not second.done() and len(panels.client.notices) == 3
    panels.press(DO_NOT)
    assert second.result(20) is Consent.NO and len(panels.client.notices) == 3


def test_enter_in_a_newly_opened_dialog_runs_nothing(dialog: TrustDialog, panels: Panels) -> None:
    future = shown(dialog, panels, replace(PLAIN, more=2))
    others = "Don't run the other 2 either"
    # The first button has the focus.
    assert [one.text for one in panels.buttons()] == [DO_NOT, others, ONCE, ALWAYS]
    panels.press(others)
    assert future.result(20) is Consent.NONE


def test_questions_are_shown_one_after_the_other(dialog: TrustDialog, panels: Panels) -> None:
    futures = {name: asked(dialog, about(name)) for name in ("a.py", "b.py", "c.py")}
    order = []
    for _ in futures:
        (name,) = until(lambda: [name for name in futures if name in panels.html()], "the next question")
        order.append(name)
        window_with(panels, name)
        panels.press(ONCE)
        assert futures[name].result(20) is Consent.ONCE
    assert set(order) == set(futures)


def test_escape_answers_no_to_the_shown_question_only(dialog: TrustDialog, panels: Panels) -> None:
    assert not dialog.say_no()
    first, stop = shown(dialog, panels, about("a.py")), threading.Event()
    withdrawn, last = asked(dialog, about("b.py"), stop.is_set), asked(dialog, about("c.py"))
    stop.set()
    assert withdrawn.result(20) is Consent.NO
    assert "a.py" in panels.html() and not first.done(), "another question was withdrawn"
    assert dialog.say_no() and first.result(20) is Consent.NO
    window_with(panels, "c.py")
    assert not last.done()
    panels.press(ALWAYS)
    assert last.result(20) is Consent.ALWAYS and not dialog.say_no()


def test_long_texts_are_cut_and_the_page_says_how_much_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workbench.trust.consent_dialog.MAX_TEXT_CHARACTERS", 10)
    monkeypatch.setattr("workbench.trust.consent_dialog.MAX_TOTAL_CHARACTERS", 16)
    files = [CodeFile(f"{name}.py", name * 12, name * 10 + "Z" * more) for name, more in (("a", 4), ("b", 0))]
    first, second = question_html(TrustQuestion("Push-v1", False, tuple(files))).split("<details>")[1:]
    assert "a" * 10 in first and "aZ" not in first and "4" in first.replace("a" * 12, "")
    assert "b" * 6 in second and "b" * 7 not in second.replace("b" * 12, "")


def test_a_rebuilt_page_shows_the_question_again(dialog: TrustDialog, panels: Panels) -> None:
    future = shown(dialog, panels)
    with panels.server.atomic():
        panels.server.gui.reset()
    window_with(panels, "/home/me/push.py")
    panels.press(ONCE)
    assert future.result(20) is Consent.ONCE


def test_a_withdrawn_question_or_one_during_close_is_answered_no(dialog: TrustDialog, panels: Panels) -> None:
    stop = threading.Event()
    future = shown(dialog, panels, PLAIN, stop.is_set)
    stop.set()
    assert future.result(20) is Consent.NO and not panels.shows(ALWAYS)
    future = shown(dialog, panels)
    dialog.close()
    assert future.result(20) is Consent.NO and asked(dialog).result(20) is Consent.NO


def test_the_dialog_shows_the_code_that_would_run_escaped() -> None:
    many = tuple(CodeFile(f"m{k}.py", f"{k:012}", f"# {k}\n") for k in range(300))
    evil = CodeFile("/w/<script>.py", "0123456789ab", "x = '</pre><script>alert(1)</script>\u202e'\n")
    dialog_html = question_html(TrustQuestion("Push-v1", False, (evil, *many), ("<b>",)))
    assert "<script>" not in dialog_html and "<b><" not in dialog_html and "&lt;script&gt;.py" in dialog_html
    assert "&lt;/pre&gt;" in dialog_html and "\\u202e" in dialog_html, "the text is escaped"
    assert all(part in dialog_html for one in many for part in (one.name, one.hash, one.text))
    assert "It imports these modules next to it (300)" in dialog_html
    assert "trusted" not in dialog_html and "every save" not in dialog_html
    held = (CodeFile("push.py", "0" * 12, ""), HELPER)
    dialog_html = question_html(TrustQuestion("<i>Push</i>-v1", True, held))
    assert "&lt;i&gt;Push" in dialog_html
    assert "the modules that it may import (1)" in dialog_html and "It imports" not in dialog_html


def test_changes_since_trust_was_given_are_marked_per_file() -> None:
    other = CodeFile("new.py", "1" * 12, "", Since.NEW)
    files = (PUSH, replace(HELPER, since=Since.CHANGED), other)
    dialog_html = question_html(replace(PLAIN, files=files, trusted_before=True, gone=("old.py",)))
    main, helper, new = dialog_html.split("<details>")[1:]
    assert "wb-tag" not in main and ">changed<" in helper and ">new<" in new
    assert "Changes since then are marked; gone since: old.py" in dialog_html
    assert question_html(replace(PLAIN, trusted_before=True)) != question_html(PLAIN)
