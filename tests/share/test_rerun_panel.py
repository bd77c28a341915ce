"""Rerun's buttons and panel on a page without a browser, and the Share tab's choice of recordings."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.drive.panels import Panels
from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.machine.loop import do
from workbench.page.door.file_response import Downloads
from workbench.page.door.gated_server import GatedServer
from workbench.share import rerun_panel as module
from workbench.share.commands import CloseRerun, MakeShared, OpenInRerun
from workbench.share.panel import SharePart, rerun_files
from workbench.share.rerun_panel import RerunPages, RerunView

FIRST, SECOND = Path("/r/first.rrd"), Path("/r/second.rrd")


@pytest.fixture
def panels(gated_server: GatedServer) -> Panels:
    return Panels(gated_server.server)


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Set when rerun's viewer may be ready."""
    unpacked = threading.Event()
    unpacked.set()
    monkeypatch.setattr(module, "viewer_is_cached", unpacked.is_set)
    monkeypatch.setattr(module, "viewer_file", lambda name: unpacked.wait(TIMEOUT_SECONDS))
    return unpacked


@pytest.fixture
def made(gated_server: GatedServer, panels: Panels, unpacked: threading.Event) -> Iterator[Any]:
    """A view, the rooms that it asked for, and its pages."""
    folds: list[Callable[[bool], None]] = []

    def make_way(fold: Callable[[bool], None]) -> int:
        folds.append(fold)
        return 1000

    pages = RerunPages(gated_server, Downloads(gated_server.add_route))
    view = RerunView(gated_server.server, pages, make_way)
    panels.visitors.do = view.do
    yield SimpleNamespace(view=view, folds=folds, pages=pages)
    view.end()
    pages.unpacking.end()


def test_without_a_file_of_rerun_nothing_can_be_opened(made: Any, panels: Panels) -> None:
    made.view.draw((), chosen=1)
    assert panels.button("Open in rerun").command is None and made.folds == []
    panels.do(OpenInRerun())
    assert len(panels.client.notices) == 1 and made.folds == []
    lacking = panels.html()
    made.view.draw((), chosen=0)
    assert panels.html() != lacking, "nothing is chosen"
    made.view.draw((FIRST,), chosen=1)
    assert panels.button("Open in rerun").command == OpenInRerun()
    fits = panels.html()
    made.view.draw((FIRST, SECOND), chosen=2)
    assert panels.html() != fits, "the link to a tab is that of both files"


def test_the_panel_opens_at_the_shown_steps_and_closes(made: Any, panels: Panels) -> None:
    made.view.draw((FIRST, SECOND), moments={SECOND: 7})
    panels.do(OpenInRerun())
    until(lambda: "step 7" in panels.html(), "the panel", seen=panels.html)
    html = panels.html()
    assert panels.shows("Close rerun") and "second" in html and len(made.folds) == 1
    panels.do(OpenInRerun())
    until(lambda: len(made.folds) == 2, "the panel again")
    until(lambda: panels.html().count("<iframe") == 1, "one panel at a time", seen=panels.html)
    for folded in (True, False):
        do(lambda folded=folded: made.folds[-1](folded))
    panels.do(CloseRerun())
    until(lambda: not panels.shows("Close rerun"), "its end")
    assert "<iframe" not in panels.html()
    do(lambda: made.folds[-1](True))  # a late fold of a closed panel is no error
    panels.do(CloseRerun())


def test_while_the_viewer_is_unpacked_the_button_waits(
    made: Any, panels: Panels, unpacked: threading.Event
) -> None:
    unpacked.clear()
    made.view.draw((FIRST,))
    panels.do(OpenInRerun())

    def waits() -> bool:
        made.view.draw((FIRST,))
        return panels.button("Open in rerun").command is None

    until(waits, "the wait")
    panels.do(OpenInRerun())
    assert made.folds == []
    unpacked.set()
    until(lambda: panels.shows("Close rerun") and not waits(), "the panel")
    assert len(made.folds) == 1


def test_a_viewer_that_cannot_be_unpacked_is_said_and_tried_again(
    made: Any, panels: Panels, unpacked: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str) -> None:
        raise RuntimeError("the disk is <full>")

    unpacked.clear()
    with monkeypatch.context() as patch:
        patch.setattr(module, "viewer_file", fail)
        made.view.draw((FIRST,))
        panels.do(OpenInRerun())

        def says() -> bool:
            made.view.draw((FIRST,))
            return "&lt;full&gt;" in panels.html() and panels.button("Open in rerun").command is not None

        until(says, "the problem")
    assert made.folds == []
    unpacked.set()
    panels.do(OpenInRerun())
    until(lambda: panels.shows("Close rerun"), "the panel")
    assert not says()


# --- which recordings the Share tab uses ----------------------------------------------------------------


def row(name: str, success: bool | None = True, problem: str | None = None, rrd: bool = True) -> Any:
    paths = tuple(Path(f"/r/{name}{suffix}") for suffix in (".json", *((".rrd",) if rrd else ())))
    source = SimpleNamespace(stem=name)
    return SimpleNamespace(id=name, problem=problem, success_once=success, source=source, paths=paths)


class Parts:
    """The library, the table and the panels next to a `SharePart`."""

    def __init__(self) -> None:
        self.rows = {
            one.id: one
            for one in (row("a"), row("b", False), row("c", None, rrd=False), row("d", problem="it is cut"))
        }
        self.chosen: tuple[str, ...] = ()
        self.both: list[bool] = []
        self.takes_opened = False
        self.shared: Any = None
        self.rerun: tuple[Any, ...] = ()
        self.part = SharePart(
            SimpleNamespace(row=self.rows.get),  # type: ignore[arg-type]
            SimpleNamespace(selected=lambda: self.chosen),  # type: ignore[arg-type]
            SimpleNamespace(choose_opened=self.choose, draw=self.draw),  # type: ignore[arg-type]
            SimpleNamespace(draw=self.draw_rerun),  # type: ignore[arg-type]
        )

    def choose(self, both: bool) -> bool:
        self.both.append(both)
        return both and self.takes_opened

    def draw(self, chosen: Any) -> None:
        self.shared = chosen

    def draw_rerun(self, *given: Any) -> None:
        self.rerun = given

    def shown(self, *opened: str, selected: tuple[str, ...] = (), takes_opened: bool = False) -> list[str]:
        """Draw with these recordings open at steps 10, 11, ...; returns the names of the shared ones."""
        self.chosen, self.takes_opened = selected, takes_opened
        cameras = {"a": ("eye", "hand"), "b": ("hand",)}
        episodes = [
            SimpleNamespace(id=one, episode=SimpleNamespace(cameras=cameras.get(one, ()))) for one in opened
        ]
        view: Any = SimpleNamespace(opened=episodes, states=tuple(range(10, 10 + len(opened))))
        self.part.draw(view)
        return [source.stem for source in self.shared.sources]


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> Parts:
    by_name = lambda episode: dict.fromkeys(episode.cameras)  # noqa: E731
    monkeypatch.setattr("workbench.share.panel.cameras_by_name", by_name)
    return Parts()


def test_the_selected_recordings_are_shared_or_else_the_open_ones(parts: Parts) -> None:
    assert parts.shown() == [] and parts.both[-1] is False
    assert parts.shown("a") == ["a"] and not parts.shared.selected and parts.shared.in_view
    assert parts.shared.cameras == ("eye", "hand") and parts.shared.successes == 1
    assert parts.shown("a", selected=("a",)) == ["a"] and parts.both[-1] is False, "there is no choice"
    assert parts.shared.selected and parts.shared.in_view
    assert parts.shown("a", selected=("b",)) == ["b"] and parts.both[-1] is True
    assert parts.shared.selected and not parts.shared.in_view and parts.shared.cameras == ()
    assert parts.shown("a", selected=("b",), takes_opened=True) == ["a"] and not parts.shared.selected
    assert parts.shown("b", "a") == ["b", "a"] and parts.shared.cameras == ("hand", "eye")
    assert not parts.shared.in_view and parts.shared.successes == 1, "both are open"
    assert parts.shown("a", "b", selected=("a",)) == ["a"] and not parts.shared.in_view, "two are in the view"
    assert parts.shown(selected=("a", "c")) == ["a", "c"] and parts.shared.successes is None
    assert parts.shown(selected=("b", "d", "gone")) == ["b"] and parts.shared.successes == 0


def test_commands_and_the_end_of_the_page_reach_the_right_panel() -> None:
    did: list[Any] = []
    share = SimpleNamespace(do=lambda command, visitor: did.append(("share", command)))
    rerun = SimpleNamespace(
        do=lambda command, visitor: did.append(("rerun", command)), end=lambda: did.append("ended")
    )
    nothing: Any = None
    part = SharePart(nothing, nothing, share, rerun)  # type: ignore[arg-type]
    for command in (OpenInRerun(), MakeShared(), CloseRerun()):
        part.do(command, nothing)
    part.close()
    assert did == [("rerun", OpenInRerun()), ("share", MakeShared()), ("rerun", CloseRerun()), "ended"]


def test_rerun_opens_the_shared_recordings_at_the_steps_of_the_open_ones(parts: Parts) -> None:
    a, b = Path("/r/a.rrd"), Path("/r/b.rrd")
    parts.shown("b", "a", "c")
    assert parts.rerun == ((b, a), 3, {b: 10, a: 11})
    parts.shown("c", "a", selected=("a", "b"))
    assert parts.rerun == ((a, b), 2, {a: 11})
    assert rerun_files([row("a"), row("c", rrd=False)]) == (a,)
