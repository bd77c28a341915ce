"""Which of the pages is shown and drawn, with pages that do nothing, and what the pages share."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import viser

from tests.drive.panels import Panels
from tests.drive.scenes import running
from tests.drive.waiting import until
from workbench.app import pages as module
from workbench.app import recording_problems, shared
from workbench.app.pages import Pages
from workbench.app.recording_problems import RecordingProblems
from workbench.app.shared import Shared
from workbench.live.process.heartbeat import Busy
from workbench.page.command import Refused
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.visitors import Visitor
from workbench.record.saving_state import KeptEpisodes, SaveStatus, Saving
from workbench.record.state import RecordingStatus

pytestmark = pytest.mark.thorough


class Shown:
    """A page that counts what is asked of it."""

    def __init__(self, which: str, dark: bool) -> None:
        self.which, self.dark = which, dark
        self.asked: list[object] = []
        self.serial = self.waits = 0
        self.fails = 0
        """Number of drawings that fail."""

    def wait(self, seen: int, timeout: float) -> int:
        self.waits += 1
        threading.Event().wait(timeout if seen == self.serial else 0)
        return self.serial

    def counted(self, visitors: int) -> None:
        if ("counted", visitors) not in self.asked:
            self.asked.append(("counted", visitors))

    def redraw(self) -> None:
        if self.fails:
            self.fails -= 1
            raise LookupError("nothing to be seen")
        self.asked.append("drawn")

    def close(self) -> None:
        self.asked.append("closed")

    def do(self, command: Any, visitor: Visitor) -> None:
        self.asked.append(command)


class House:
    """Pages on a server without browsers; `visitors` is their number."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.visitors, self.cleared, self.breaks = 1, 0, False
        self.building, self.may_build = threading.Event(), threading.Event()
        self.may_build.set()
        self.made: list[Shown] = []
        stage: Any = SimpleNamespace(framing=SimpleNamespace(follow=lambda: self.visitors), clear=self._clear)
        self.pages = Pages(server, stage, cast(Any, self._make))

    def _clear(self) -> None:
        self.cleared += 1

    def _make(self, which: str, dark: bool) -> Shown:
        self.building.set()
        assert self.may_build.wait(60)
        if self.breaks:
            raise OSError("no such page")
        self.made.append(Shown(which, dark))
        return self.made[-1]

    def drawings(self) -> int:
        return self.made[-1].asked.count("drawn")


@pytest.fixture
def house(server: viser.ViserServer) -> Iterator[House]:
    house = House(server)
    house.pages.start("live")
    yield house
    house.pages.stop()


def test_a_page_replaces_the_other_and_keeps_its_theme(house: House, panels: Panels) -> None:
    (live,) = house.made
    assert house.pages.shown == "live" and live.dark and "drawn" in live.asked
    panels.server.gui.add_html("of the live page")
    house.pages.show("live").result(30)
    assert house.made == [live], "it is shown already"
    live.dark = False
    house.pages.show("review").result(30)
    review = house.made[-1]
    assert (review.which, review.dark, house.pages.shown) == ("review", False, "review")
    assert live.asked[-1] == "closed" and house.cleared == 1 and panels.html("of the live page") == ""
    house.pages.do(cast(Any, "a command"), panels.visitor)
    assert "a command" in review.asked and "a command" not in live.asked
    house.pages.show("review", rebuild=True).result(30)
    assert [page.which for page in house.made] == ["live", "review", "review"]
    assert review.asked[-1] == "closed" and not house.made[-1].dark


def test_of_several_requests_the_newest_page_is_shown_and_rebuilt_if_any_of_its_requests_says_so(
    server: viser.ViserServer,
) -> None:
    house = House(server)
    early = [house.pages.show("review"), house.pages.show("live", rebuild=True)]
    house.pages.start("start")
    for request in early:
        request.result(30)
    assert [page.which for page in house.made] == ["start"]
    house.pages.stop()
    assert house.made[-1].asked[-1] == "closed"


def test_a_page_that_cannot_be_built_is_reported_to_who_asked_and_another_can_be_shown(house: House) -> None:
    house.breaks = True
    with pytest.raises(OSError, match="no such page"):
        house.pages.show("review").result(30)
    house.breaks = False
    house.pages.show("start").result(30)
    assert house.pages.shown == "start"


def test_a_press_while_another_page_is_built_is_refused(house: House, panels: Panels) -> None:
    command: Any = "a command"
    house.building.clear()
    house.may_build.clear()
    shown = house.pages.show("review")
    assert house.building.wait(60)
    with pytest.raises(Refused):
        house.pages.do(command, panels.visitor)
    house.may_build.set()
    shown.result(60)
    house.pages.do(command, panels.visitor)
    assert [command in page.asked for page in house.made] == [False, True]


def test_a_page_without_visitors_is_not_drawn_but_knows_it(house: House) -> None:
    house.visitors = 0
    (live,) = house.made
    until(lambda: ("counted", 0) in live.asked, "the count")
    before, waits = house.drawings(), live.waits
    until(lambda: live.waits > waits + 12, "some rounds")
    assert house.drawings() == before
    house.visitors = 2
    until(lambda: ("counted", 2) in live.asked and house.drawings() > before, "a drawing")


def test_a_drawing_that_fails_is_reported_and_tried_again(
    house: House, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "RETRY_SECONDS", 0.01)
    told: list[str] = []
    monkeypatch.setattr(module, "notify_all", lambda server, title, *_: told.append(title))
    before = house.drawings()
    house.made[-1].fails = 2
    house.made[-1].serial += 1
    until(lambda: not house.made[-1].fails and house.drawings() > before, "a drawing after the failures")
    assert len(told) == 2 and "nothing to be seen" in caplog.text


# --- what a recording saved ------------------------------------------------------------------------------

Told = list[tuple[str, str | None]]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    """(text, colour) of each notice that pages are shown."""
    notices: Told = []

    def notify(
        server: object, title: str, text: str, color: str | None = "orange", seconds: float = 0.0
    ) -> None:
        notices.append((text, color))

    for one in (recording_problems, shared):
        monkeypatch.setattr(one, "notify_all", notify)
    return notices


class StubSession:
    """A session with these statuses, one after the other; each is seen once, the last again and again."""

    def __init__(self, *statuses: RecordingStatus) -> None:
        self._left = list(statuses)

    def view(self) -> Any:
        status = self._left.pop(0) if len(self._left) > 1 else self._left[0]
        return running(2, recording=status)

    @property
    def is_seen(self) -> bool:
        return len(self._left) == 1


def reports(*statuses: RecordingStatus) -> list[str]:
    """The messages for the terminal about these successive statuses."""
    session, notices = StubSession(RecordingStatus(), *statuses, statuses[-1]), list[str]()
    watching = RecordingProblems(cast(Any, None), lambda: cast(Any, session), notices.append)
    until(lambda: session.is_seen, "the last status")
    watching.close()
    return notices


IDLE = RecordingStatus(folder="/kept")


def test_each_recording_that_ends_is_reported_once(told: Told) -> None:
    first, same = replace(IDLE, since=1.0, saved=2), replace(IDLE, since=2.0, saved=2)
    assert reports(first, first, same, same) == []
    assert [("2 episodes" in text, "/kept" in text, color) for text, color in told] == [
        (True, True, None)
    ] * 2
    told.clear()
    reports(replace(IDLE, since=1.0, saved=0))
    assert len(told) == 1 and "/kept" not in told[0][0]


def test_each_problem_is_reported_once_on_the_page_and_in_the_terminal(told: Told) -> None:
    def full() -> str:
        return "".join(["disk ", "full"])  # another object each time

    first, again = replace(IDLE, problem=full()), replace(IDLE, problem=full())
    assert reports(first, first, again) == ["disk full"] * 2
    assert told == [("disk full", "red")] * 2


def test_a_saving_that_fails_or_is_refused_is_reported(told: Told) -> None:
    failed = SaveStatus(failed=True, message="no space left")
    refused = SaveStatus(failed=True, message="nothing to save yet", refused_at=3)
    done = SaveStatus(message="saved")
    assert reports(
        replace(IDLE, saving=failed), replace(IDLE, saving=failed), replace(IDLE, saving=done)
    ) == ["no space left"]
    assert told == [("no space left", "red")]
    told.clear()
    assert reports(replace(IDLE, saving=refused)) == []
    assert told == [("nothing to save yet", "orange")]
    told.clear()
    both = replace(IDLE, problem="no space left", saving=failed)
    assert reports(both) == ["no space left"] and len(told) == 1, "one reason is told once"


# --- sessions that end -------------------------------------------------------------------------------------


class Ending:
    """A session that is being closed: what it saves before and after."""

    def __init__(self, before: Saving, after: Saving) -> None:
        self._before, self._after = before, after
        self.closed: list[bool] = []
        self.while_closing: Callable[[], object] = lambda: None

    def saving(self) -> Saving:
        return self._after if self.closed else self._before

    def close(self, finish_saving: bool = False) -> None:
        self.while_closing()
        self.closed.append(finish_saving)


@pytest.fixture
def house_of(gated_server: GatedServer, tmp_path: Path) -> Iterator[Callable[..., Shared]]:
    made: list[Shared] = []

    def make(session: Any = None, *tasks: Path) -> Shared:
        made.append(Shared(gated_server, tmp_path, cast(Any, None), session, tasks, (), lambda text: None))
        return made[-1]

    yield make
    for one in made:
        one.close()


def saving(unsaved: int, **status: Any) -> Saving:
    kept = status.pop("kept", KeptEpisodes())
    made = Saving(status=SaveStatus(**status), kept=kept)
    return cast(
        Any, SimpleNamespace(unsaved=unsaved, status=made.status, kept=made.kept, text=f"{unsaved} episode")
    )


@pytest.mark.parametrize(
    ("before", "after", "notices"),
    [
        (saving(0), saving(0), []),
        (saving(2), saving(0), ["orange", None]),
        (saving(2), saving(2, failed=True, message="no space"), ["orange", "red"]),
        (saving(2), saving(0, kept=KeptEpisodes(failed=1, why="no space")), ["orange", "red"]),
        (saving(2, kept=KeptEpisodes(failed=1)), saving(0, kept=KeptEpisodes(failed=1)), ["orange", None]),
        (saving(2), saving(1), ["orange"]),
    ],
)
def test_what_becomes_of_the_episodes_of_a_closed_session_is_told(
    house_of: Callable[..., Shared], told: Told, before: Saving, after: Saving, notices: list[str | None]
) -> None:
    pages, session = house_of(), Ending(before, after)
    during: list[object] = []
    session.while_closing = lambda: during.extend([pages.saving_text(), set(pages.sessions)])
    pages.close_session(cast(Any, session))
    assert session.closed == [before.unsaved > 0]
    assert [color for _, color in told] == notices
    assert all("no space" in text for text, color in told if color == "red")
    if before.unsaved:
        assert "2 episode" in str(during[0]) and during[1] == {session}
    assert pages.sessions == set() and pages.saving_text() == ""


def test_the_task_files_are_those_of_the_command_and_the_open_one(
    house_of: Callable[..., Shared], tmp_path: Path
) -> None:
    view = running(1)
    assert view.task is not None
    opened = replace(view, task=replace(view.task, file="/home/me/push.py"))
    session = SimpleNamespace(view=lambda: opened)
    given = tmp_path / "given.py"
    assert house_of(None, given).task_files() == (given,)
    assert house_of(session, given).task_files() == (Path("/home/me/push.py"), given)
    session.view = lambda: replace(view, task=None)
    assert house_of(session, given).task_files() == (given,)


def test_the_machine_is_idle_only_while_nothing_runs(
    house_of: Callable[..., Shared], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared, "MIN_FREE_BYTES", 0)
    view = running(1, state="paused", playing=False)
    session = SimpleNamespace(view=lambda: view)
    pages = house_of(session)
    assert house_of().is_idle()
    for state, busy, idle in (
        ("paused", None, True),
        ("error", None, True),
        ("stopped", None, True),
        ("running", None, False),
        ("loading", None, False),
        ("paused", Busy(3.0, "in evaluate"), False),
    ):
        session.view = lambda state=state, busy=busy: replace(view, state=cast(Any, state), busy=busy)
        assert pages.is_idle() is idle, (state, busy)
    session.view = lambda: view
    assert pages.is_idle()
    monkeypatch.setattr(shared, "MIN_FREE_BYTES", 1 << 60)
    assert not pages.is_idle(), "there is no memory for more"
