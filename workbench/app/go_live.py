"""Continues a recording in a live env: chooses or opens a session, asks for consent, and switches the page."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import viser

from workbench.app.session import Session
from workbench.app.shared import Shared
from workbench.envs.recorded_run import RecordedRun
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.recorded_source import (
    CannotEnterRecording,
    options_of,
    reference_of,
    run_of,
    why_not_enter,
    write_source,
)
from workbench.episodes.side_files import side_files_text
from workbench.live.commands import PauseRun
from workbench.live.panels.banners import is_busy_for_a_long_time
from workbench.machine.loop import BlockingPool, begin, do
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import choice
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render, sentence
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.rescore.recordings_panel import RECORDED, TODAYS
from workbench.review.commands import ChooseLiveCode, ChooseLiveEnvs, ReturnToFirstTask
from workbench.review.view import ReviewView
from workbench.task.description import TaskOptions
from workbench.task.reference import TaskName
from workbench.trust.clearance import Clearances, CodeToRun, NotCleared

ONE, ALL = "the selected env", "all envs"
NEW_ENVS = 4
"""Number of envs of a new session if all envs get the recorded state; 1 if only the selected env does."""


_POLL_SECONDS = 0.05
"""Interval at which a transition checks `is_over`."""
_OPEN_TIMEOUT_SECONDS = 2.0
"""Maximum time that `close` waits for a session that is being opened."""
MakeSession = Callable[[TaskName, TaskOptions], Session]


@dataclass
class _Transition:
    """One transition from a recording to a live env."""

    info: EpisodeInfo
    run: RecordedRun
    state: int
    given_up: bool = False
    asks: bool = False
    """Whether `Clearances` may be asking the user for permission to run the code."""
    number: int = 0
    """Value of `TimelineView.entered` once the env has the recorded state."""
    problems: int = 0
    session: Session | None = None
    """Session that gets the recorded state; None until it is open. Set after the other fields, because
    `is_over` reads them as soon as `session` is set."""

    def is_over(self) -> bool:
        """Whether to show the live page now: the state is restored, the task failed, or the task has been
        busy for so long that the user may want to interrupt it."""
        if self.session is None:
            return False
        view = self.session.view()
        arrived = view.timeline.entered == self.number
        failed = view.problem_serial > self.problems or view.state == "stopped"
        return arrived or failed or is_busy_for_a_long_time(view)

    def words(self) -> str:
        """Text for the page: what the transition waits for."""
        task = self.info.task
        if self.session is None:
            return f"waiting for permission to run the code of {task}" if self.asks else f"opening {task} …"
        view = self.session.view()
        if view.task is None:
            doing = f"loading {task} at step {self.state}"
        else:
            doing = f"restoring {task} at step {self.state}"
        return f"{doing}: {view.activity}" if view.activity else f"{doing} …"


class GoLive:
    """Continues recordings in a live env.

    If the recording's task is already open, its selected env (or all its envs) gets the recorded state. If
    not, `GoLive` opens a session for that task. When this session is no longer needed, `GoLive` closes it,
    and removes the folder with the recorded code, if there is one. The review page stays until the live page
    has something to show. Call all methods on the loop, except `close`.

    Args:
        shared: The pages, and the open session, if any.
        make_session: Opens a session of a task with the given options.
        clearances: Decide which code named by recordings may run.
        base: Options that all opened tasks share.
    """

    def __init__(
        self,
        shared: Shared,
        make_session: MakeSession,
        clearances: Clearances,
        base: TaskOptions,
    ) -> None:
        self._shared, self._make, self._clearances, self._base = shared, make_session, clearances, base
        self._own: tuple[Session, Path | None] | None = None
        self.recorded_source, self.everywhere = False, False
        self._transition: _Transition | None = None
        self._opening = BlockingPool("go-live")
        """Asks for consent, and opens sessions."""
        self._ending = BlockingPool("end-session")

    def go(self, id: str, state: int) -> None:
        """Continue live from this state of the opened recording `id`. If a transition is in progress, only
        cancel it."""
        if self._transition is not None:
            self._give_up()
            return
        review = self._shared.recordings.review.view()
        one = next((one for one in review.opened if one.id == id), None)
        if one is None:
            return
        try:
            run = run_of(one.episode, state)
        except CannotEnterRecording as error:
            self._notify(str(error))
            return
        if self.recorded_source:
            run = replace(run, name=f"{run.name} as it was recorded")
        self._transition = transition = _Transition(one.episode.info, run, state)
        begin(self._go(transition))

    async def _go(self, transition: _Transition) -> None:
        info, recorded_source = transition.info, self.recorded_source
        try:
            why = await self._opening.run(lambda: self._clearances.refused_arguments(info))
            if why is not None:
                raise NotCleared(why)
            session = None if recorded_source else self._open_already(info)
            if session is None:
                session = await self._open(transition, recorded_source)
            if session is not None:
                await self._enter(session, transition)
        except (CannotEnterRecording, NotCleared) as error:
            if not transition.given_up:
                self._notify(sentence(str(error)))
        finally:
            if self._transition is transition:
                self._transition = None

    def _open_already(self, info: EpisodeInfo) -> Session | None:
        """The live page's session, or else the session that the user opened, if it already runs this task
        with the current code (not with recorded code); None if neither does. The live page's session is also
        returned if it has not loaded its task yet."""
        session = self._shared.session
        if session is not None and (self._own is None or self._own[1] is None):
            task = session.view().task
            if task is None or not why_not_enter(task, info):
                return session
        known = self._shared.home if self._shared.home is not session else None
        task = None if known is None else known.view().task
        return known if task is not None and not why_not_enter(task, info) else None

    async def _open(self, transition: _Transition, recorded_source: bool) -> Session | None:
        """Open another session for the recording's task. Returns None if the transition is cancelled
        meanwhile.

        Raises:
            CannotEnterRecording: the recording does not contain its code, or the code cannot be written to a
                folder.
            NotCleared: the code must not run.
        """
        info, num_envs = transition.info, NEW_ENVS if self.everywhere else 1

        def open_cleared() -> tuple[Session, Path | None] | None:
            wanted = CodeToRun(reference_of(info), info, recorded_source, followed=not recorded_source)
            options = options_of(info, num_envs, self._base)
            folder, reference = None, self._clearances.clear(wanted, lambda: transition.given_up)
            if recorded_source:
                folder, reference = write_source(info)
            if not transition.given_up:
                if self._shared.home is not None:
                    self._shared.home.do(PauseRun())
                return self._make(reference, options), folder
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            return None

        transition.asks = True
        opened = await self._opening.run(open_cleared)
        if opened is None or transition.given_up:
            if opened is not None:
                self._ending.begin(lambda: self._end(*opened))
            return None
        self._let_go()
        self._own = opened
        return opened[0]

    async def _enter(self, session: Session, transition: _Transition) -> None:
        """Put the recorded state into the env, and show the live page when the transition is over."""
        self._shared.session = session
        transition.problems = session.view().problem_serial
        transition.number = session.enter_recording(
            transition.run, self.everywhere, transition.info.source_file, transition.info.source
        )
        transition.session = session
        while self._transition is transition:
            if transition.is_over():
                self._shared.pages.show("live")
                return
            await asyncio.sleep(_POLL_SECONDS)

    def _give_up(self) -> None:
        transition, self._transition = self._transition, None
        if transition is not None:
            transition.given_up = True

    def going(self) -> str:
        """Text: what the transition waits for; empty without a transition."""
        transition = self._transition
        return "" if transition is None else transition.words()

    def review_is_back(self) -> None:
        """Cancel a transition whose session is open, because the review page is shown again."""
        if self._transition is not None and self._transition.session is not None:
            self._transition = None

    def can_go_home(self) -> bool:
        """Whether the user has opened a session, and the live page shows another one."""
        home = self._shared.home
        return home is not None and self._shared.session is not home

    def go_home(self) -> None:
        """Return to the session that the user opened; the other session ends."""
        if self._shared.home is None:
            return
        self._shared.session = self._shared.home
        self._shared.pages.show("live")
        self._let_go()

    def let_go(self) -> None:
        """Cancel a transition, and end a session that was opened here. Called when the user opens another
        task."""
        self._give_up()
        self._let_go()

    def close(self) -> None:
        """End the session opened here. The pages must have been stopped. Must not be called on the loop."""
        do(self.let_go)
        self._opening.close(_OPEN_TIMEOUT_SECONDS)
        # If a session has just opened, its cancelled transition, which runs on the loop, hands the session to
        # `_ending`: wait for that.
        do(lambda: None)
        self._ending.close()

    def _let_go(self) -> None:
        """End the session that was opened here; the caller shows another page."""
        own, self._own = self._own, None
        if own is not None:
            self._ending.begin(lambda: self._end(*own))

    def _end(self, session: Session, folder: Path | None) -> None:
        self._shared.close_session(session)
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)

    def _notify(self, text: str) -> None:
        notify_all(self._shared.server, "This recording cannot be continued", text, "red")


class GoLivePart(PagePart[ReviewView]):
    """Options of continuing live: which code, and which envs."""

    does = (ChooseLiveCode, ChooseLiveEnvs, ReturnToFirstTask)

    def __init__(self, server: viser.ViserServer, go_live: GoLive) -> None:
        self._go_live = go_live
        go_live.review_is_back()
        self._about: object = None
        """(recording id, whether its recorded code is chosen), as they were when the note below the choice of
        code was last drawn."""
        gui = server.gui
        self._folder = gui.add_folder("Continue live", expand_by_default=False, visible=False)
        with self._folder:
            self._code = choice(
                server,
                "Code",
                ChooseLiveCode,
                "code",
                (TODAYS, RECORDED),
                TODAYS,
                hint="The current code of the task, or the recorded code, opened from a temporary folder",
            )
            self._besides = gui.add_html("")
            self._envs = choice(
                server,
                "Into",
                ChooseLiveEnvs,
                "envs",
                (ONE, ALL),
                ONE,
                hint="Which envs get the recorded state",
            )
            self._home = gui.add_html("")

    def draw(self, view: ReviewView) -> None:
        home = self._go_live.can_go_home()
        self._folder.visible = bool(view.opened) or home
        self._code.show(RECORDED if self._go_live.recorded_source else TODAYS)
        self._envs.show(ALL if self._go_live.everywhere else ONE)
        back = tool("Back to the first task", ReturnToFirstTask(), tone="main")
        self._home.content = tools_html([back] if home else [])
        info = None if view.chosen is None else view.chosen.episode.info
        if self._about != (info and info.id, self._go_live.recorded_source):
            self._about = info and info.id, self._go_live.recorded_source
            words = ""
            if info is not None and self._go_live.recorded_source:
                words = side_files_text(info.source_file, info.side_files)
            self._besides.content = render("note", text=words) if words else ""

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseLiveCode(code=code):
                self._go_live.recorded_source = code == RECORDED
            case ChooseLiveEnvs(envs=envs):
                self._go_live.everywhere = envs == ALL
            case ReturnToFirstTask():
                if not self._go_live.can_go_home():
                    raise Refused("No other task is open.")
                self._go_live.go_home()
