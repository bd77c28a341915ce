"""From the review into a live env and back, with scripted workers and without a browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import pytest
import viser

from tests.drive.episodes import made, write
from tests.drive.panels import Panels
from tests.drive.scenes import problem
from tests.drive.session import worker_of
from tests.drive.waiting import until
from workbench.app import go_live
from workbench.app.go_live import GoLive, GoLivePart
from workbench.app.pages import Which
from workbench.app.server import App
from workbench.app.session import Session
from workbench.live.commands import PlayRun
from workbench.live.messages import TaskFailed
from workbench.machine.loop import do
from workbench.page.door.gated_server import GatedServer
from workbench.review.commands import ReturnToFirstTask
from workbench.task.description import TaskOptions
from workbench.task.reference import TaskName
from workbench.trust.clearance import Clearances, CodeToRun, NotCleared


class Consenter(Clearances):
    """Consents once `says_yes` is set; counts questions, and those that were abandoned."""

    def __init__(self) -> None:
        super().__init__()
        self.says_yes = threading.Event()
        self.asked = self.left = 0
        self.says_no = False

    def clear(self, wanted: CodeToRun, stopped: Callable[[], bool] = lambda: False) -> TaskName:
        self.asked += 1
        until(lambda: self.says_yes.is_set() or self.says_no or stopped(), "an answer")
        if self.says_no:
            raise NotCleared("a person said no")
        if stopped():
            self.left += 1
            raise NotCleared("no one waits for the answer")
        return wanted.info.task


class Desk:
    """A review with an episode of the open task (0) and one of another task (1)."""

    def __init__(self, app: App, live: Session, other: Session, panels: Panels) -> None:
        self.app, self.live, self.other, self.panels = app, live, other, panels
        self.person = Consenter()
        self.opened: list[TaskName] = []
        self.options: list[TaskOptions] = []
        self.shown: list[str] = []
        """Requested pages; none is built."""
        app.shared.pages.show = self._show
        self.go_live = GoLive(app.shared, self._make, self.person, TaskOptions())
        self.part = GoLivePart(app.shared.server, self.go_live)
        panels.visitors.do = self.part.do
        app.review_tools = replace(app.review_tools, go_live=self.go_live)

    def _make(self, task: TaskName, options: TaskOptions) -> Session:
        self.opened.append(task)
        self.options.append(options)
        return self.other

    def _show(self, which: Which, rebuild: bool = False) -> Future[None]:
        self.shown.append(which)
        return Future()

    def go(self, which: int, state: int = 2) -> None:
        opened = self.app.shared.recordings.review.view().opened[which]
        do(lambda: self.go_live.go(opened.id, state))

    def wait_for_the_live_page(self) -> None:
        """Wait for the switch to the live page; here nothing draws the review."""
        until(
            lambda: self.shown == ["live"] and not self.go_live.going(),
            "the live page",
            seen=self.go_live.going,
        )


@pytest.fixture
def server(gated_server: GatedServer) -> viser.ViserServer:
    """The review's server."""
    return gated_server.server


@pytest.fixture
def desk(
    child_process: None,
    scripted_session: Callable[..., Session],
    tmp_path: Path,
    gated_server: GatedServer,
    panels: Panels,
) -> Iterator[Desk]:
    folder = tmp_path / "recordings"
    write(folder, made(4, seed=1), pictures=False)
    write(folder, made(4, seed=2, task="Pull-v1"), pictures=False)
    live, other = scripted_session(2), scripted_session(1)

    def no_other(task: TaskName, options: TaskOptions) -> Session:
        raise AssertionError("the test opens the other session itself")

    app = App(gated_server, folder, no_other, TaskOptions(), session=live)
    library, review = app.shared.recordings.library, app.shared.recordings.review
    library.refresh()
    review.open([row.id for row in sorted(library.view().rows, key=lambda row: row.seed or 0)])
    until(lambda: len(review.view().opened) == 2, "the recordings", seen=lambda: review.view().problems)
    desk = Desk(app, live, other, panels)
    yield desk
    desk.go_live.close()
    app.close()


def test_going_live_in_the_open_task_is_immediate_and_switches_the_page_even_if_not_drawn(
    desk: Desk,
) -> None:
    desk.go(0, state=3)
    assert desk.person.asked == 0 and desk.opened == [] and desk.app.shared.session is desk.live
    until(lambda: desk.live.view().timeline.entered, "the recorded state")
    desk.wait_for_the_live_page()
    assert not desk.go_live.can_go_home()


def test_a_failure_while_going_live_shows_the_live_page_but_an_earlier_failure_does_not(desk: Desk) -> None:
    worker_of(desk.live).tell(TaskFailed(problem(), kept=True))
    worker_of(desk.live).goes_back = False
    desk.go(0)
    time.sleep(0.2)  # time in which a failure would switch the page
    assert desk.go_live.going() == "restoring Push-v1 at step 2 …" and desk.shown == []
    worker_of(desk.live).tell(TaskFailed(problem(), kept=True))
    desk.wait_for_the_live_page()


def test_another_task_is_opened_next_to_the_open_one_after_consent(desk: Desk) -> None:
    desk.live.do(PlayRun())
    until(lambda: desk.live.view().playing, "the play")
    desk.go(1)
    until(lambda: desk.person.asked, "the question")
    assert desk.go_live.going() == "waiting for permission to run the code of Pull-v1"
    assert desk.app.shared.session is desk.live and desk.opened == []
    desk.person.says_yes.set()
    until(lambda: desk.app.shared.session is desk.other, "the other session")
    assert desk.opened == ["Pull-v1"] and desk.go_live.can_go_home()
    until(lambda: not desk.live.view().playing, "the pause of the hidden task")
    until(lambda: desk.other.view().timeline.entered, "the recorded state")
    desk.wait_for_the_live_page()
    desk.part.draw(desk.app.shared.recordings.review.view())
    desk.panels.press("Back to the first task")
    assert desk.app.shared.session is desk.live and not desk.go_live.can_go_home()
    desk.part.draw(desk.app.shared.recordings.review.view())
    assert not desk.panels.shows("Back to the first task")


def test_the_choice_of_code_and_envs_is_kept_for_the_next_review(desk: Desk) -> None:
    desk.part.draw(desk.app.shared.recordings.review.view())
    assert desk.panels.field("Code").value == "today's"
    desk.panels.set("Code", "as recorded")
    desk.panels.set("Into", "all envs")
    assert desk.go_live.recorded_source and desk.go_live.everywhere
    desk.app.shared.server.gui.reset()
    desk.part = GoLivePart(desk.app.shared.server, desk.go_live)
    desk.part.draw(desk.app.shared.recordings.review.view())
    assert desk.panels.field("Code").value == "as recorded" and desk.panels.field("Into").value == "all envs"
    desk.panels.do(ReturnToFirstTask())
    assert desk.panels.client.notices == ["No other task is open."]


def test_a_second_press_cancels_going_live_and_its_question(desk: Desk) -> None:
    desk.go(1)
    until(lambda: desk.person.asked, "the question")
    desk.go(1)
    assert desk.go_live.going() == ""
    until(lambda: desk.person.left, "the abandoned question")
    assert desk.opened == [] and desk.app.shared.session is desk.live


def test_reopening_the_review_cancels_going_live(desk: Desk) -> None:
    worker_of(desk.live).goes_back = False
    desk.go(0)
    until(lambda: desk.go_live.going().startswith("restoring"), "the restore")
    GoLivePart(desk.app.shared.server, desk.go_live)
    assert desk.go_live.going() == ""


def test_the_recorded_code_is_opened_from_a_folder_that_is_removed_with_its_session(desk: Desk) -> None:
    desk.part.draw(desk.app.shared.recordings.review.view())
    desk.panels.set("Code", "as recorded")
    desk.panels.set("Into", "all envs")
    desk.person.says_yes.set()
    desk.go(0)
    until(lambda: desk.app.shared.session is desk.other, "the session of the recorded code")
    (task,), (options,) = desk.opened, desk.options
    file = Path(str(task).partition(".py")[0] + ".py")
    assert file.name == "push.py" and file.read_text() == "reward = 1\n" and options.num_envs == 4
    desk.wait_for_the_live_page()
    # The open session runs recorded code, so the current code needs the session that the user opened.
    desk.panels.set("Code", "today's")
    desk.shown.clear()
    desk.go(0)
    desk.wait_for_the_live_page()
    assert desk.app.shared.session is desk.live and len(desk.opened) == 1
    desk.panels.do(ReturnToFirstTask())
    do(desk.go_live.let_go)
    until(lambda: not file.parent.exists(), "the end of the folder")
    assert desk.other.view().state is not None


def test_a_refusal_is_told_and_changes_nothing(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(go_live, "notify_all", lambda server, title, text, *_: told.append(text))
    desk.person.says_no = True
    for count in (1, 2):
        desk.go(1)
        until(lambda count=count: len(told) == count and not desk.go_live.going(), "the notice")
    assert desk.opened == [] and desk.shown == [] and desk.app.shared.session is desk.live
    desk.go(0, state=99)
    assert len(told) == 3 and not desk.go_live.going(), "there is no such state"


def test_reopening_the_review_does_not_cancel_a_question(desk: Desk) -> None:
    desk.go(1)
    until(lambda: desk.person.asked, "the question")
    GoLivePart(desk.app.shared.server, desk.go_live)
    assert desk.go_live.going()
    desk.person.says_yes.set()
    desk.wait_for_the_live_page()
    assert desk.app.shared.session is desk.other and desk.options[0].num_envs == 1
