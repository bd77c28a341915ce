from __future__ import annotations

from dataclasses import replace

from tests.drive.panels import Panels
from tests.ui.scenes import EMPTY, problem, running
from workbench.session.process.heartbeat import Busy, busy_at
from workbench.ui.live.banners import SHOWN_AFTER, Banner, BusyBanner, banner_html, busy_html
from workbench.ui.live.status_line import status_values
from workbench.ui.widgets.templates import render

EVIL = "<img src=x onerror=alert(1)><script>alert(2)</script>"
LOOP = Busy(6.4, "in evaluate", "/home/me/push.py", 88, "while True:", "Traceback ...")


def a_banner(panels: Panels) -> tuple[BusyBanner, list[str]]:
    asked: list[str] = []
    return BusyBanner(
        panels.server, lambda: asked.append("interrupt"), lambda: asked.append("restart")
    ), asked


def test_says_what_takes_long_where_and_for_how_long() -> None:
    html = busy_html(LOOP, running(2))
    assert all(word in html for word in ("PushEnv", "in evaluate", "6 s", "push.py:88", "while True:"))


def test_everything_of_the_author_s_is_escaped() -> None:
    evil = Busy(6.0, EVIL, f"/{EVIL}.py", 1, EVIL, EVIL)
    html = busy_html(evil, EMPTY) + render("traceback", traceback=EVIL)
    assert "<script" not in html and "<img" not in html


def test_comes_after_a_while_and_goes_when_it_is_over(panels: Panels) -> None:
    banner, _ = a_banner(panels)
    banner.draw(running(2, busy=replace(LOOP, seconds=SHOWN_AFTER - 1)))
    assert not panels.part("Busy").seen
    banner.draw(running(2, busy=LOOP))
    assert panels.part("Busy").seen and panels.shows("Interrupt") and "Traceback" not in panels.html()
    banner.draw(running(2))
    assert not panels.part("Busy").seen


def test_what_cannot_be_interrupted_offers_no_interrupt_and_shows_where_it_is(
    panels: Panels,
) -> None:
    banner, _ = a_banner(panels)
    banner.draw(running(2, busy=replace(LOOP, ignores_interrupt=True)))
    assert not panels.shows("Interrupt") and panels.shows("Restart")
    assert "Traceback ..." in panels.html()


def test_stands_instead_of_the_banner_of_a_problem(panels: Panels) -> None:
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: None)
    view = running(2, problem=problem(), problem_serial=1, state="error")
    banner.draw(replace(view, busy=LOOP))
    assert not panels.part("Problem").seen
    banner.draw(view)
    assert panels.part("Problem").seen and "KeyError" in panels.html()


def test_a_worker_that_gets_ready_is_not_the_author_s_and_leaves_the_reason_in_sight(
    panels: Panels,
) -> None:
    ready = busy_at(21.0, "warming up", "", (), ignores_interrupt=False)
    view = running(2, busy=ready, problem=problem(), problem_serial=1, state="starting", playing=False)
    busy, _ = a_banner(panels)
    died = Banner(panels.server, lambda: None, lambda: None, lambda: None)
    busy.draw(view)
    died.draw(view)
    assert not panels.part("Busy").seen and panels.part("Problem").seen
    text = render("status_line", **status_values(view))
    assert "a new worker is getting ready" in text and "busy" not in text
    assert not busy_at(21.0, "stepping", "", (), ignores_interrupt=False).getting_ready


def test_an_interrupt_is_not_called_a_failure() -> None:
    html = banner_html(
        replace(problem("Interrupted: stopped by hand after 6.1 s"), interrupted=True), running(2)
    )
    assert "was interrupted in evaluate" in html and "failed" not in html
    named = banner_html(problem("Interrupted: what the author calls it"), running(2))
    assert "was interrupted" not in named


def test_a_worker_s_death_says_when_all_is_back(panels: Panels) -> None:
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: None)
    died = replace(problem("the worker process was killed by SIGSEGV"), stage="worker")
    view = running(2, problem=died, problem_serial=1, state="starting", playing=False)
    banner.draw(view)
    while_away = panels.html()
    banner.draw(replace(view, state="paused"))
    assert panels.html() != while_away


def test_the_status_line_says_busy_with_what_and_claims_no_rate() -> None:
    text = render("status_line", **status_values(running(4, busy=LOOP)))
    assert "busy" in text and "in evaluate for 6 s" in text and "steps/s" not in text


def test_the_status_line_lets_the_renderer_s_own_words_stand() -> None:
    drawing = Busy(25.0, "drawing", drawing=True)
    view = running(4, busy=drawing, state="loading", activity="compiling the renderer's shaders, once")
    text = render("status_line", **status_values(view))
    assert "compiling" in text and "busy" not in text
