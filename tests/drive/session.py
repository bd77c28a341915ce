"""How tests use a session: open one, do what a page does, see what a page sees.

`live_session` has a real worker on a real task. In `fake_worker_session` the test plays the worker and sends its events: no
process, no renderer. Both give the same `Session`; only this file uses its private names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tests.drive.scenes import camera as scene_camera
from tests.drive.scenes import description, step_of, table_scene
from tests.drive.waiting import until
from workbench.app.session import Session
from workbench.cameras.view import StudioCamera, StudioView
from workbench.checks.profile import ProfileJobs
from workbench.checks.state import CheckJobs
from workbench.envs.camera_data import CameraKey
from workbench.envs.step_result import StepResult
from workbench.live.commands import PauseRun, SetSeed, Step
from workbench.live.events import MomentShown, PastPicturesWanted
from workbench.live.history.moments import History, Moment
from workbench.live.messages import Event, Inspect, Loaded, ReloadReport, Request, Status
from workbench.live.process.supervisor import Death, End, ProcessMemory, Supervisor, WorkerOptions
from workbench.live.timeline_commands import StepBack, StepForward
from workbench.live.view import SessionView
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.state import BeginRescoring, RescoreEffect, RescoreView
from workbench.task.description import Restored, Stepped, TaskDescription, TaskOptions

TASKS = Path(__file__).parents[2] / "tasks"
BASE: CameraKey = ("sensor", "base_camera")
PEOPLE: CameraKey = ("human", "render_camera")
Kind = TypeVar("Kind")


# --- open ----------------------------------------------------------------------------------------------


@contextmanager
def live_session(
    task: Path | str,
    recordings: Path,
    num_envs: int = 2,
    seed: int = 0,
    draw: bool = False,
    worker: WorkerOptions | None = None,
    **env_kwargs: object,
) -> Iterator[Session]:
    """A session at the first moment of the task, closed afterwards; needs the fixture `child_process`.

    Args:
        draw: use a renderer, whose shaders take each worker some seconds.
    """
    if not draw:
        env_kwargs = {"render_backend": "none", **env_kwargs}
    options = TaskOptions(num_envs=num_envs, seed=seed, env_kwargs=env_kwargs)
    session = Session(str(task), options, recordings=recordings, worker=worker)
    try:
        wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
        yield session
    finally:
        session.close()


class FakeWorker:
    """Replaces `Supervisor`: stores the requests that it is sent."""

    pid = None
    load_pending = False
    vitals = ProcessMemory()

    def __init__(self, options: WorkerOptions, warm_up: object, **callbacks: Any) -> None:
        self.first_requests: Callable[[], list[Request]] = callbacks["first_requests"]
        self.on_event: Callable[[Event], None] = callbacks["on_event"]
        self.on_death: Callable[[Death], None] = callbacks["on_death"]
        self.sent: list[Request] = []
        self.replaced = 0

    def start(self) -> None:
        """Does nothing: `FakeWorkerSession.greet` returns the first requests."""

    def send(self, request: Request) -> None:
        self.sent.append(request)

    def replace(self) -> None:
        self.replaced += 1

    def interrupt(self) -> None:
        """Does nothing: it is never busy."""

    def reset_deaths(self) -> None:
        """Does nothing: it never dies by itself."""

    def stop(self) -> None:
        """Does nothing: it has no thread."""


def hold_saving(session: Session) -> None:
    """Save no episode of the session: the test sends the events of the saving jobs."""
    session._past_saver.begin = lambda effect, placed: None


class FakeWorkerSession:
    """A session whose worker is the test: `asked` returns the worker's requests, `tell` sends its events."""

    def __init__(self, session: Session, worker: FakeWorker) -> None:
        self.session, self.worker = session, worker
        self.rescored: list[object] = []
        """Loads that the session asked to rescore the past with; nothing is rescored."""
        session._past_rescorer.perform = self._rescore
        self._elapsed = np.zeros(0, np.int32)
        self._number = 0

    @property
    def view(self) -> SessionView:
        return self.session.view()

    @property
    def replaced(self) -> int:
        """How often the session asked to replace the worker."""
        return self.worker.replaced

    def asked(self, kind: type[Kind]) -> list[Kind]:
        """Requests of this kind since the last call of this method; drops those of other kinds."""
        sent = self.worker.sent[:]
        self.worker.sent.clear()
        return [request for request in sent if isinstance(request, kind)]

    def _rescore(self, effect: RescoreEffect) -> None:
        if isinstance(effect, BeginRescoring):
            self.rescored.append(effect.load)

    def greet(self) -> list[Request]:
        """The first requests to a new worker."""
        return self.worker.first_requests()

    def tell(self, *events: Event) -> None:
        for event in events:
            self.worker.on_event(event)

    def die(self, death: Death | None = None) -> None:
        self.worker.on_death(DEATH if death is None else death)

    def load(
        self, level: str | None = None, num_envs: int = 3, same_scene: bool = False, **changes: Any
    ) -> None:
        """The worker reports that a version was loaded.

        Args:
            level: reload level; None for the first version and for one that was restored.
            changes: fields of its `TaskDescription`.
        """
        options = changes.pop("options", None)
        geometry, poses = table_scene(num_envs)
        task: TaskDescription = replace(description(geometry, (scene_camera(),)), **changes)
        report: Any = None if level is None else ReloadReport(level, "", same_scene=same_scene)  # type: ignore[arg-type]
        if level not in ("same", "patched", "cameras") or not len(self._elapsed):
            self._elapsed = np.zeros(num_envs, np.int32)
        first = replace(step_of(poses, success=np.zeros(num_envs, bool)), elapsed_steps=self._elapsed)
        self.tell(Loaded(task, first, {"import": 1.0}, report, options))

    def step(self, count: int = 1, **more: Any) -> None:
        """Control steps of all envs; `more` as `moment` takes it."""
        for _ in range(count):
            self._elapsed = self._elapsed + 1
            self._add(moment(self._elapsed, number=self._number, **more))

    def reset(self, envs: Sequence[int] | None = None, **more: Any) -> None:
        """A reset of these envs, or of all."""
        envs = range(len(self._elapsed)) if envs is None else envs
        self._jump(envs, np.zeros(len(envs), np.int32), **more)

    def back(self, envs: tuple[int, ...], source: tuple[int, ...], origin: int, **restored: Any) -> None:
        """The envs go to the states of the `source` envs at the moment with serial `origin`."""
        at = moment_at(self.session, origin)
        undoes, success = restored.pop("undoes", None), restored.pop("success", ())
        told = Restored(envs, source, origin, undoes, restored.pop("not_carried", {}), **restored)
        elapsed = np.ones(len(envs), np.int32) if at is None else at.step.elapsed_steps[list(source)]
        self._jump(envs, elapsed, restored=told, success=success)

    def resume(self) -> None:
        """A replacement worker resumes at the last moment."""
        self._jump(range(len(self._elapsed)), self._elapsed, resumed=True)

    def play(self, steps: int) -> None:
        """Load, reset all envs, step, and report that the simulation plays."""
        self.load()
        self.reset()
        self.step(steps)
        self.tell(Status(True, 20.0, 1.0))

    def _jump(self, envs: Sequence[int], elapsed: NDArray[np.int32], **more: Any) -> None:
        self._elapsed = self._elapsed.copy()
        self._elapsed[list(envs)] = elapsed
        self._add(moment(self._elapsed, tuple(envs), number=self._number, **more))

    def _add(self, event: Stepped) -> None:
        self._number += 1
        self.tell(event)


@contextmanager
def fake_worker_session(
    recordings: Path,
    task: Any = "push.py",
    num_envs: int = 3,
    worker: type[FakeWorker] = FakeWorker,
    **more: Any,
) -> Iterator[FakeWorkerSession]:
    """A session without a process, see `FakeWorkerSession`. `more` goes to `Session`."""
    made: list[FakeWorker] = []

    def make_worker(*arguments: Any, **named: Any) -> Supervisor:
        made.append(worker(*arguments, **named))
        return made[-1]  # type: ignore[return-value]

    session = Session(task, TaskOptions(num_envs), recordings=recordings, make_worker=make_worker, **more)
    try:
        yield FakeWorkerSession(session, made[0])
    finally:
        session.close()


DEATH = Death("was killed by SIGSEGV", End.DIED, "stepping", "", False)


def moment(
    elapsed: NDArray[np.int32],
    jumped: tuple[int, ...] = (),
    success: tuple[int, ...] = (),
    fail: tuple[int, ...] = (),
    truncated: tuple[int, ...] = (),
    number: int = 0,
    reward: Sequence[float] | None = None,
    evaluate: dict[str, NDArray] | None = None,
    **more: Any,
) -> Stepped:
    """The event that a worker sends for a step; poses and actions are different for each moment and env."""
    count = len(elapsed)
    poses = _poses(count).copy()
    poses[..., 0] = np.arange(count)[:, None] + number / 1000
    masks = [np.isin(np.arange(count), list(envs)) for envs in (success, fail, truncated, jumped)]
    entries: dict[str, Any] = {"success": masks[0], "fail": masks[1]} if evaluate is None else evaluate
    step = StepResult(
        elapsed_steps=elapsed.astype(np.int32),
        reward=np.array(elapsed if reward is None else reward, np.float32),
        terminated=masks[0] | masks[1],
        truncated=masks[2],
        evaluate=entries,
        poses=poses,
        action=None if jumped else np.arange(count * 2, dtype=np.float32).reshape(count, 2) + 100 * number,
    )
    return Stepped(step, masks[3], number=number, **{"snapshot": b"body %d" % number, **more})


@cache
def _poses(count: int) -> NDArray[np.float32]:
    return table_scene(count)[1]


# --- do ------------------------------------------------------------------------------------------------


def step(session: Session, count: int = 1) -> SessionView:
    """Step all envs `count` times, one control step at a time."""
    view = session.view()
    for _ in range(count):
        # The shown moment also changes when the view returns from the past.
        last = session.view().timeline.last
        session.do(Step())
        view = wait_until(session, lambda view, n=last: view.timeline.last > n, "a step")
    return view


def start_over(session: Session, seed: int) -> SessionView:
    """Start new episodes of all envs with this seed, paused and live; the session keeps the seed."""
    session.do(PauseRun())
    before = session.view().timeline.last
    session.do(SetSeed(seed=seed))

    def was_reset(view: SessionView) -> bool:
        if view.playing or view.timeline.last <= before:
            return False
        newest = moment_at(session, view.timeline.last)
        # Compare the seed: a reset that was already in progress arrives first.
        return newest is not None and newest.seeds is not None and newest.seeds[0] == seed

    return wait_until(session, was_reset, "the reset")


def save(session: Session, file: Path, text: str) -> SessionView:
    """Save the file and wait until this text runs."""
    file.write_text(text)
    return runs(session, text)


def runs(session: Session, text: str) -> SessionView:
    """Wait until this text runs, paused or playing; return the view."""

    def reached(view: SessionView) -> bool:
        return (
            view.task is not None
            and text in view.task.source.values()
            and view.problem is None
            and not view.stale
            and view.state in ("paused", "running")
        )

    return wait_until(session, reached, "the saved version")


def jump(session: Session, ask: Callable[[], object]) -> SessionView:
    """The view after the jump that `ask` requests."""
    last = session.view().timeline.last
    ask()
    return wait_until(session, lambda v: v.timeline.last > last, "the jump")


def seek(session: Session, serial: int | None) -> None:
    """Show the moment with this serial; live if None."""
    session.dispatch(MomentShown(serial))


def seek_by(session: Session, steps: int) -> None:
    """Press the right arrow key `steps` times; the left one if negative."""
    for _ in range(abs(steps)):
        session.do(StepForward() if steps > 0 else StepBack())


def worker_of(session: Session) -> Any:
    """What `make_worker` made, or the supervisor."""
    return session._worker


def after_worker_reply(session: Session) -> SessionView:
    """The view after the worker has handled every earlier request: it has answered an inspection."""
    before = session.view().inspection
    worker_of(session).send(Inspect(0, ("joints",)))
    return wait_until(session, lambda view: view.inspection is not before, "an answer of the worker")


def draw_past(session: Session) -> None:
    """Draw the missing pictures of the shown moment now, as happens when a slider comes to rest."""
    session.dispatch(PastPicturesWanted(session.look(lambda run: run.stands_at)))


def stop_watching(session: Session) -> None:
    """Stop the file watcher."""
    session._watcher.stop()


# --- see -----------------------------------------------------------------------------------------------


def wait_until(session: Session, reached: Callable[[SessionView], object], what: str) -> SessionView:
    """The first view for which `reached` holds."""

    def seen() -> str:
        view = session.view()
        return f"state {view.state}, problem {view.problem}, {view.printed.texts[-10:]}"

    def wanted() -> SessionView | None:
        view = session.view()
        return view if reached(view) else None

    return until(wanted, what, seen=seen)


def history_of(session: Session) -> History:
    """The session's history of the running scene."""
    past = session.look(lambda run: run.past)
    assert past is not None
    return past.history


def moment_at(session: Session, serial: int) -> Moment | None:
    """The moment with this serial in the history."""
    past = session.look(lambda run: run.past)
    return None if past is None else past.history.at(serial)


def moments_of(session: Session) -> list[Moment]:
    """All moments in the history, oldest first."""
    view = session.view().timeline
    found = (moment_at(session, serial) for serial in range(view.first, view.last + 1))
    return [one for one in found if one is not None]


def work_with(session: Session, background: Any) -> None:
    """Check rules and time steps with `background` instead of a process."""
    session._checks = CheckJobs(background, session._dispatch)
    session._profiles = ProfileJobs(background, session._dispatch)


def background_pid(session: Session) -> int | None:
    """Pid of the process that rescores, checks and draws the past."""
    return session._background.pid


def moved(view: SessionView) -> set[CameraKey]:
    """Cameras whose pose differs from the file's."""
    return {camera.key for camera in view.of(StudioView).cameras if camera.moved}


def camera(session: Session, key: CameraKey) -> StudioCamera:
    found = session.view().of(StudioView).camera(key)
    assert found is not None
    return found


def in_studio(what: Callable[[StudioView], object]) -> Callable[[SessionView], object]:
    return lambda view: what(view.of(StudioView))


def rescored(rescorer: Rescorer, *states: str) -> RescoreView:
    """Wait until rescoring is in one of these states; return its view."""

    def wanted() -> RescoreView | None:
        view = rescorer.view
        return view if view.state in states else None

    return until(wanted, " or ".join(states), 120.0, seen=lambda: rescorer.view)
